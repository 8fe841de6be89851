"""Checks of HTTP requests: a local server answers only requests of its own pages.

A page of another site can make a browser send requests to this server, also under its own host name (DNS rebinding). Therefore
the Host header must name this machine, and the origin that the browser reports must match the Host header.
"""

from __future__ import annotations

import ipaddress
import os
import socket
import sys
import webbrowser
from collections.abc import Mapping
from urllib.parse import urlsplit

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")


class Refused(Exception):
    """A rejected request: an HTTP status and a sentence."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status, self.text = status, text


def is_loopback(host: str) -> bool:
    """True if an address or name is reachable only from this machine."""
    address = _address(host)
    return host == "localhost" if address is None else address.is_loopback


def open_page(url: str) -> None:
    """Open an address in the user's browser if there is a display."""
    # Without a display, webbrowser may start a text browser in this terminal.
    if sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(url)


def check_host(header: str | None, bound: str) -> None:
    """Raise Refused if the Host header does not name this machine; `bound` is the address on which the server listens."""
    try:
        name = urlsplit(f"//{header}").hostname if header else None
    except ValueError:
        name = None
    if name is None:
        raise Refused(400, "A Host header is required.")
    if name in LOOPBACK_NAMES or name == bound.lower():
        return
    if not is_loopback(bound) and (_address(name) or name in {socket.gethostname().lower(), socket.getfqdn().lower()}):
        return
    raise Refused(403, "The Host header names another machine. Open the address that this program printed.")


def check_origin(headers: Mapping[str, str]) -> None:
    """Raise Refused for a request that a browser sends for a page of another site."""
    origin, site = headers.get("Origin"), headers.get("Sec-Fetch-Site")
    foreign = origin is not None and urlsplit(origin).netloc.lower() != (headers.get("Host") or "").lower()
    if foreign or site not in (None, "same-origin", "none"):
        raise Refused(403, "Requests from other sites are refused.")


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None
