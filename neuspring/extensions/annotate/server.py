"""Server of `neuspring annotate`: the page, and its requests for JSON and images.

Requests must come from pages of this server (core/web.py). All requests under /api/ need the token, which only the printed
address contains. The server finds each camera and frame in the capture, so no address gives access to another file.
"""

from __future__ import annotations

import errno
import hmac
import json
import logging
import secrets
import socket
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from neuspring.core.errors import InputError
from neuspring.core.web import Refused, check_host, check_origin
from neuspring.data.capture import HANDS, OBJECT, PERSON, Capture
from neuspring.extensions.annotate.masks import MasksMode
from neuspring.extensions.annotate.shared import Busy, Stale

STATIC_FOLDER = Path(__file__).parent / "static"
"""The only static files that the server sends."""
TOKEN_HEADER = "X-NeuSpring-Token"
MOST_REQUEST_BYTES = 2_000_000
"""Largest body of a request, bytes."""
ANNOTATE_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Headers of all responses."""
LABEL_COLORS = {OBJECT: (0, 200, 160), HANDS: (255, 140, 0), PERSON: (150, 160, 255)}
"""RGB of each label, as in the legend of the page."""
INSIDE_OPACITY, BORDER_OPACITY = 90, 255
"""Opacity inside a mask and on its border, 0 to 255."""
JPEG_QUALITY = 95
ANSWERS: dict[type[Exception], int] = {Stale: 409, Busy: 409, InputError: 422}
"""HTTP status of each exception that a request can raise."""


class Server:
    """HTTP server: call `serve_forever()`, then `shutdown()` from another thread, and `close()`."""

    def __init__(
        self,
        capture: Capture,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
    ) -> None:
        """Listen at host and port; 0: any free port. Raises InputError for an unusable address or a damaged file."""
        self.capture, self.host, self.token = capture, host, token or secrets.token_urlsafe(16)
        self.masks = MasksMode(capture)
        self.masks.document.read()
        self._socket = _listen(host, port)
        self.port: int = self._socket.getsockname()[1]
        app = Starlette(
            routes=[
                Route("/api/state", self._state),
                Route("/api/masks", lambda _: JSONResponse(self.masks.plain())),
                Route("/api/job", lambda _: JSONResponse(self.masks.job.plain())),
                Route("/api/color/{camera}/{frame:int}", self._color),
                Route("/api/overlay/{source}/{camera}/{frame:int}", self._overlay),
                Route("/api/marks", self._write, methods=["POST"]),
                Route("/api/preview", self._preview, methods=["POST"]),
                Route("/api/carry", self._carry, methods=["POST"]),
                Route("/api/stop", self._stop, methods=["POST"]),
                Route("/api/masks/save", lambda _: JSONResponse({"cameras": self.masks.save()}), methods=["POST"]),
                Mount("/", StaticFiles(directory=STATIC_FOLDER, html=True)),
            ],
            middleware=[Middleware(BaseHTTPMiddleware, dispatch=self._answer)],
            exception_handlers={HTTPException: lambda _, error: _problem(error.status_code, "This address does not exist.")},  # type: ignore[attr-defined]
        )
        options: dict[str, Any] = {"lifespan": "off", "ws": "none", "access_log": False, "log_config": None, "server_header": False}
        self._uvicorn = uvicorn.Server(uvicorn.Config(app, **options, proxy_headers=False, timeout_graceful_shutdown=5))

    @property
    def url(self) -> str:
        """Address to open; the token is in its fragment, which servers do not log."""
        name = f"[{self.host}]" if ":" in self.host else self.host
        if self.host in ("0.0.0.0", "::", ""):
            name = socket.gethostname()
        return f"http://{name}:{self.port}/#{self.token}"

    def serve_forever(self) -> None:
        """Answer requests until `shutdown`; Ctrl-C raises KeyboardInterrupt."""
        self._uvicorn.run(sockets=[self._socket])

    def shutdown(self) -> None:
        """Stop `serve_forever`."""
        self._uvicorn.should_exit = True

    def close(self) -> None:
        """Free the port, stop background work, and wait for its end."""
        self._socket.close()
        self.masks.job.stop()
        self.masks.job.join()

    async def _answer(self, request: Request, go_on: Callable[[Request], Awaitable[Response]]) -> Response:
        """Check the request, read its body, and answer; refusals and errors become a status and a sentence."""
        try:
            check_host(request.headers.get("Host"), self.host)
            if request.scope["path"].startswith("/api/"):
                check_origin(request.headers)
                if not hmac.compare_digest(request.headers.get(TOKEN_HEADER, "").encode(), self.token.encode()):
                    text = "The token is missing or from an earlier start. Open the address that neuspring annotate printed."
                    raise Refused(401, text)
                if request.method == "POST":
                    request.state.values = await _body(request)
            answer = await go_on(request)
        except Refused as refused:
            answer = _problem(refused.status, refused.text)
        except tuple(ANSWERS) as error:
            text = "Another tab or program changed the file after this page read it." if isinstance(error, Stale) else str(error)
            answer = _problem(next(status for kind, status in ANSWERS.items() if isinstance(error, kind)), text)
        except Exception as error:  # the page shows the error, the terminal its traceback
            logging.getLogger(__name__).exception("a request failed")
            answer = _problem(500, f"{type(error).__name__}: {error}. The terminal shows the traceback.")
        answer.headers.update(ANNOTATE_HEADERS)
        return answer

    def _frame(self, camera: object, frame: object) -> tuple[str, int]:
        """Camera and frame of a request. Raises Refused if the capture does not contain them."""
        if not isinstance(camera, str) or camera not in self.capture.cameras:
            raise Refused(404, "The capture has no such camera.")
        if not isinstance(frame, int) or not 0 <= frame < self.capture.frame_count or not self.capture.has(camera, frame):
            raise Refused(404, "This camera has no such frame.")
        return camera, frame

    def _state(self, _: Request) -> Response:
        """The capture and its annotations."""
        description = self.capture.description
        cameras = [
            {"name": entry.name, "width": entry.width, "height": entry.height, "missing": list(entry.missing)}
            for entry in description.cameras
        ]
        values = {
            "name": description.name,
            "folder": str(self.capture.folder),
            "frames": description.frame_count,
            "frame_rate": description.frame_rate,
            "cameras": cameras,
            "masks": self.masks.plain(),
        }
        return JSONResponse(values)

    def _color(self, request: Request) -> Response:
        """A frame as JPEG."""
        color = self.capture.color(*self._frame(request.path_params["camera"], request.path_params["frame"]))
        bgr = np.ascontiguousarray(color[..., ::-1])
        return Response(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes(), media_type="image/jpeg")

    def _overlay(self, request: Request) -> Response:
        """Overlay of the masks of a frame; `source` is carried or saved."""
        camera, frame = self._frame(request.path_params["camera"], request.path_params["frame"])
        labels = self.masks.labels(camera, frame, request.path_params["source"])
        if labels is None:
            raise Refused(404, "This frame has no mask.")
        return Response(overlay_png(labels), media_type="image/png")

    def _preview(self, request: Request) -> Response:
        """Overlay of the mask of one annotated frame, from its own annotations."""
        values = request.state.values
        labels = self.masks.preview(*self._frame(values.get("camera"), values.get("frame")))
        return Response(overlay_png(labels), media_type="image/png")

    def _write(self, request: Request) -> Response:
        values = request.state.values
        return JSONResponse({"revision": self.masks.write(values.get("revision"), values.get("marks"))})

    def _carry(self, request: Request) -> Response:
        """Start to carry the annotations of the named cameras."""
        cameras = request.state.values.get("cameras")
        if not isinstance(cameras, list) or not all(isinstance(name, str) and name in self.capture.cameras for name in cameras):
            raise Refused(404, "The capture has no such camera.")
        self.masks.carry(cameras)
        return JSONResponse(self.masks.job.plain())

    def _stop(self, _: Request) -> Response:
        self.masks.job.stop()
        return JSONResponse(self.masks.job.plain())


def overlay_png(labels: np.ndarray) -> bytes:
    """Labels [H, W] as a transparent PNG: opaque on borders, translucent inside."""
    image = np.zeros((*labels.shape, 4), np.uint8)
    for label, (red, green, blue) in LABEL_COLORS.items():
        mask = (labels == label).astype(np.uint8)
        core = cv2.erode(mask, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=1)
        image[mask > 0] = (blue, green, red, BORDER_OPACITY)
        image[core > 0] = (blue, green, red, INSIDE_OPACITY)
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


async def _body(request: Request) -> dict[str, Any]:
    """JSON object of a request. Raises Refused for other types, and for unknown or large lengths before reading."""
    headers = request.headers
    if headers.get("Content-Type", "").split(";")[0].strip().lower() != "application/json":
        raise Refused(415, "The body must be JSON.")
    length = headers.get("Content-Length", "")
    if "Transfer-Encoding" in headers or not length.isdecimal():
        raise Refused(411, "A Content-Length is required.")
    if int(length) > MOST_REQUEST_BYTES:
        raise Refused(413, f"The body must have at most {MOST_REQUEST_BYTES} bytes.")
    try:
        values = json.loads(await request.body())
    except (ValueError, RecursionError) as error:
        raise Refused(400, f"The body must be JSON: {error}.") from error
    if not isinstance(values, dict):
        raise Refused(400, "The body must be a JSON object.")
    return values


def _problem(status: int, text: str) -> Response:
    return JSONResponse({"error": text}, status)


def _listen(host: str, port: int) -> socket.socket:
    """Open a socket at an address. Raises InputError."""
    try:
        if ":" in host:
            return socket.create_server((host, port), family=socket.AF_INET6, dualstack_ipv6=socket.has_dualstack_ipv6())
        return socket.create_server((host, port))
    except (OSError, OverflowError) as error:
        number = getattr(error, "errno", None)
        if number == errno.EADDRINUSE:
            remedy = "Stop the program that uses it, or choose another port; --port 0 selects a free one."
            raise InputError("--port", "must be a free port", port, remedy) from error
        if isinstance(error, OverflowError):
            raise InputError("--port", "must be 0 to 65535", port) from error
        if number in (errno.EACCES, errno.EPERM):
            raise InputError("--port", "must be permitted to you", port, "Choose a port above 1023.") from error
        remedy = "Use 127.0.0.1 for this machine only, or 0.0.0.0 for all networks."
        raise InputError("--host", "must be an address of this machine", host, remedy) from error
