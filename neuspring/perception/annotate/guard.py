"""Which requests are answered: those of the page that this server gave out, opened by who has the token.

A page of another site can make a browser send requests here, and can point a name of its own at this address (DNS rebinding). So
the Host header must name this machine, what a browser says about a request's origin must agree with it, and every answer beyond
the page itself needs the token, which is in the printed address alone.
"""

from __future__ import annotations

import hmac
import ipaddress
import socket
from email.message import Message
from urllib.parse import urlsplit

TOKEN_HEADER = "X-NeuSpring-Token"
LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
MOST_BYTES = 2_000_000
"""Largest body of a request."""
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Of every answer."""


class Refused(Exception):
    """A request that is not answered: an HTTP status and a sentence."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status, self.text = status, text


def is_loopback(host: str) -> bool:
    """Whether an address or name means this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_host(header: str | None, bound: str) -> None:
    """Refuse a Host header that is not a name of this machine; `bound` is the address that the server listens at."""
    name = _host_name(header)
    if name is None:
        raise Refused(400, "A Host header is required.")
    if name in LOOPBACK_NAMES or name == bound.lower():
        return
    if not is_loopback(bound) and (_is_address(name) or name in {socket.gethostname().lower(), socket.getfqdn().lower()}):
        return
    raise Refused(403, "The Host header names another machine. Open the address that neuspring annotate printed.")


def check_origin(headers: Message) -> None:
    """Refuse what a browser sends for a page of another site."""
    origin, site = headers.get("Origin"), headers.get("Sec-Fetch-Site")
    if origin is not None and urlsplit(origin).netloc.lower() != (headers.get("Host") or "").lower():
        raise Refused(403, "Requests of other sites are refused.")
    if site not in (None, "same-origin", "none"):
        raise Refused(403, "Requests of other sites are refused.")


def check_token(headers: Message, token: str) -> None:
    """Refuse who does not have the token."""
    if not hmac.compare_digest((headers.get(TOKEN_HEADER) or "").encode(), token.encode()):
        raise Refused(401, "The token is missing or of an earlier start. Open the address that neuspring annotate printed.")


def body_length(headers: Message) -> int:
    """Bytes of a JSON body. Refuses other kinds, unknown lengths and large ones."""
    if (headers.get("Content-Type") or "").split(";")[0].strip().lower() != "application/json":
        raise Refused(415, "JSON is required.")
    length = headers.get("Content-Length") or ""
    if headers.get("Transfer-Encoding") or not (length.isascii() and length.isdecimal()):
        raise Refused(411, "A Content-Length is required.")
    if len(length) > 12 or int(length) > MOST_BYTES:
        raise Refused(413, f"At most {MOST_BYTES} bytes are taken.")
    return int(length)


def _host_name(header: str | None) -> str | None:
    """The name or address of a Host header, without port and brackets."""
    if not header:
        return None
    try:
        return urlsplit(f"//{header}").hostname
    except ValueError:
        return None


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
