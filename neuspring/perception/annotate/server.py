"""The server of `neuspring annotate`: the page, and what it asks for, as JSON and images."""

from __future__ import annotations

import errno
import json
import logging
import secrets
import socket
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any, TypeAlias
from urllib.parse import urlsplit

from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.perception.annotate import guard
from neuspring.perception.annotate.document import Stale
from neuspring.perception.annotate.guard import Refused
from neuspring.perception.annotate.job import Busy
from neuspring.perception.annotate.masks import Masks, Method
from neuspring.perception.annotate.pointing import Foreign, Pointing
from neuspring.perception.annotate.routes import GET, POST, Desk

SCRIPTS = ("api", "app", "doubt", "edits", "masks", "messages", "paint", "pen", "rows", "timeline", "tracks", "view")
PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/style.css": ("style.css", "text/css; charset=utf-8"),
    **{f"/{name}.js": (f"{name}.js", "text/javascript; charset=utf-8") for name in SCRIPTS},
    "/favicon.ico": ("icon.svg", "image/svg+xml"),
}
"""The only files that are given out, by path."""
PATIENCE = 60.0
"""Seconds that a connection may be silent."""
Answer: TypeAlias = tuple[int, str, bytes]
STATUS: tuple[tuple[type[Exception], int], ...] = ((Stale, 409), (Busy, 409), (Foreign, 428), (InputError, 422))


class Server(ThreadingHTTPServer):
    """`Server(capture, method)`; then `serve_forever()`, from another thread `shutdown()`, and `close()`."""

    daemon_threads = True

    def __init__(self, capture: Capture, method: Method, host: str = "127.0.0.1", port: int = 0, token: str | None = None) -> None:
        """Listen; port 0: any that is free. Raises InputError for an address that cannot be had, or a damaged file."""
        self.host, self.token = host, token or secrets.token_urlsafe(16)
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        masks = Masks(capture, method)
        masks.document.read()
        try:
            super().__init__((host, port), Handler)
        except (OSError, OverflowError) as error:
            raise _unusable(host, port, error) from error
        self.desk = Desk(capture, masks, Pointing(capture))
        try:
            self.desk.pointing.document.read()
        except InputError:
            self.server_close()
            self.desk.pointing.close()
            raise

    @property
    def url(self) -> str:
        """The address to open, with the token."""
        name = f"[{self.host}]" if ":" in self.host else self.host
        if self.host in ("0.0.0.0", "::", ""):
            name = socket.gethostname()
        return f"http://{name}:{self.server_address[1]}/#{self.token}"

    def close(self) -> None:
        """Free the port, stop the work, and wait for its end."""
        self.server_close()
        self.desk.masks.job.stop()
        self.desk.masks.job.join()
        self.desk.pointing.close()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A tab that was closed in the middle of an answer is no error."""
        logging.getLogger(__name__).debug("a connection broke", exc_info=True)


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    protocol_version = "HTTP/1.1"
    timeout = PATIENCE
    server: Server

    def do_GET(self) -> None:
        """The page, or something of `routes.GET`."""
        self._answer(self._get)

    def do_POST(self) -> None:
        """Something of `routes.POST`."""
        self._answer(self._post)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: requests are many and say nothing."""

    def version_string(self) -> str:
        return "neuspring"

    def _answer(self, get: Callable[[], Answer]) -> None:
        try:
            guard.check_host(self.headers.get("Host"), self.server.host)
            status, kind, content = get()
        except Refused as refused:
            self.close_connection = True  # its body was not read
            status, kind, content = _problem(refused.status, refused.text)
        except tuple(kind for kind, _ in STATUS) as error:
            code = next(code for kind, code in STATUS if isinstance(error, kind))
            text = "The file changed in another tab or program since this page read it." if isinstance(error, Stale) else str(error)
            status, kind, content = _problem(code, text)
        except Exception as error:  # the page must say so, and the terminal where
            logging.getLogger(__name__).exception("a request failed")
            status, kind, content = _problem(500, f"{type(error).__name__}: {error}. The terminal shows where.")
        self.send_response(status)
        for name, value in guard.HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(content)

    def _get(self) -> Answer:
        path = urlsplit(self.path)
        if path.path in PAGE:
            name, kind = PAGE[path.path]
            return 200, kind, files("neuspring.perception.annotate").joinpath("static", name).read_bytes()
        guard.check_origin(self.headers)
        guard.check_token(self.headers, self.server.token)
        for pattern, answer in GET:
            if found := pattern.fullmatch(path.path):
                return _content(answer(self.server.desk, *found.groups()))
        raise Refused(404, "There is nothing at this address.")

    def _post(self) -> Answer:
        guard.check_origin(self.headers)
        guard.check_token(self.headers, self.server.token)
        answer = POST.get(self.path)
        if answer is None:
            raise Refused(404, "There is nothing at this address.")
        length = guard.body_length(self.headers)
        try:
            values = json.loads(self.rfile.read(length))
        except (ValueError, RecursionError) as error:
            raise Refused(400, f"The body must be JSON: {error}.") from error
        if not isinstance(values, dict):
            raise Refused(400, "A JSON object is required.")
        return _content(answer(self.server.desk, values))


def _content(value: Any) -> Answer:
    """JSON values, or an image."""
    if isinstance(value, bytes):
        return 200, "image/png" if value.startswith(b"\x89PNG") else "image/jpeg", value
    return 200, "application/json", json.dumps(value, allow_nan=False).encode()


def _problem(status: int, text: str) -> Answer:
    return status, "application/json", json.dumps({"error": text}).encode()


def _unusable(host: str, port: int, error: Exception) -> InputError:
    """The next move for an address that cannot be listened at."""
    number = getattr(error, "errno", None)
    if number == errno.EADDRINUSE:
        rule, remedy = (
            "must be a free port",
            "Another program listens there. Stop it, or choose another port; --port 0 takes any free one.",
        )
        return InputError("--port", rule, port, remedy)
    if isinstance(error, OverflowError):
        return InputError("--port", "must be 0 to 65535", port)
    if number in (errno.EACCES, errno.EPERM):
        return InputError("--port", "must be one that you may use", port, "Choose one above 1023.")
    return InputError(
        "--host", "must be an address of this machine", host, "127.0.0.1 is for this machine alone, 0.0.0.0 for all networks."
    )
