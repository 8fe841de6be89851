"""A viser server that listens where it is told, at the port it is told, and answers this machine's own pages alone."""

from __future__ import annotations

import contextlib
import io
import os
import re
import socket
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from neuspring.core.errors import InputError
from neuspring.core.extras import needed
from neuspring.core.web import Refused, check_host, check_origin

if TYPE_CHECKING:
    import viser

SERVER_LABEL = "NeuSpring"
VISIT = re.compile(r"/(?:\?frame=([0-9]{1,9})(?:&scenario=([A-Za-z0-9_.-]{1,200}))?)?")
"""The page, and a frame of it, perhaps of a scenario that must be the one that is shown."""
FILE_HEADERS = {"X-Content-Type-Options": "nosniff", "X-Frame-Options": "DENY", "Referrer-Policy": "no-referrer"}
"""Headers of every file of the page."""
PAGE_HEADERS = {"Cache-Control": "no-store"}
"""Headers of the page itself: a browser that kept it for its button "back" would keep its connection, and with it what is held."""


def start(
    host: str, port: int, asked: Callable[[int], object] = lambda frame: None, scenario: str | None = None
) -> viser.ViserServer:
    """A running server at host and port (0: any that is free); `asked` gets the frame of an address that ends in /?frame=<number>.

    `scenario` is the one that is shown: an address that ends in &scenario=<name> of another one is refused. None: all are answered.
    Raises InputError where it cannot listen there, or without viser.
    """
    needed("viser")
    import viser

    _require_free(host, port)
    # viser takes another port from this variable, whatever it is told.
    os.environ.pop("_VISER_PORT_OVERRIDE", None)
    with _guarded(host, asked, scenario) as used, contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label=SERVER_LABEL, verbose=False)
    if not used:
        server.stop()
        raise InputError("viser", "this version cannot be told whom to answer", viser.__version__, "Install viser >=1.1,<2.")
    if port and server.get_port() != port:
        server.stop()
        raise _taken(host, port, "another program has just taken it")
    # A page could ask viser to publish this server through a tunnel.
    server.request_share_url = lambda verbose=True: None  # type: ignore[method-assign]
    server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="large")
    return server


def address(server: viser.ViserServer) -> str:
    """Address to open in a browser."""
    host = server.get_host()
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}/"


def asked_frame(path: str, scenario: str | None) -> int | None:
    """The frame that an address asks for, if it asks for a frame and for nothing more than its scenario.

    Raises Refused where that is not `scenario`, the one that is shown.
    """
    found = VISIT.fullmatch(path)
    if found is None or not found[1]:
        return None
    if found[2] and scenario and found[2] != scenario:
        text = f"This player shows {scenario}. Run `neuspring play` on the folder of {found[2]}, then follow the link again."
        raise Refused(404, text)
    return int(found[1])


def _is_visit(request: Any) -> bool:
    """True where a person follows a link to the page, from a report for instance: a window of its own, no frame of another site.

    Other parameters are refused: viser's page takes from them where it connects to, and shows what it gets from there.
    """
    headers = request.headers
    navigates = (headers.get("Sec-Fetch-Mode"), headers.get("Sec-Fetch-Dest")) == ("navigate", "document")
    return navigates and "Upgrade" not in headers and VISIT.fullmatch(request.path) is not None


def _require_free(host: str, port: int) -> None:
    """Raise InputError where nobody could listen: viser would take the next port, or wait forever."""
    if not 0 <= port < 65536:
        raise InputError("--port", "must lie between 0 and 65535", port)
    try:
        family, kind, proto, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except (OSError, UnicodeError) as error:
        rule, told = "must be an address of this machine", f"{host}: {error}"
        raise InputError("--host", rule, told, "Leave it out for 127.0.0.1.") from error
    with socket.socket(family, kind, proto) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(place)
            probe.listen()
        except OSError as error:
            raise _taken(host, port, error.strerror) from error


def _taken(host: str, port: int, reason: object) -> InputError:
    remedy = "Stop the other program, or choose another: --port 0 takes any that is free."
    return InputError(f"--port {port}", f"it must be possible to listen at {host}:{port}", reason, remedy)


@contextlib.contextmanager
def _guarded(host: str, asked: Callable[[int], object], scenario: str | None) -> Iterator[list[bool]]:
    """Servers that are started inside check each request's Host and Origin; the list is empty if none was started.

    viser has no place for such a check. Without it any page of the web that this browser shows could reach the server, by its
    address or by a name of its own that points here (DNS rebinding).
    """
    from websockets.asyncio import server as module

    original, used = module.serve, []

    def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        used.append(True)

        def checked(connection: Any, request: Any) -> Any:
            try:
                check_host(request.headers.get("Host"), host)
                if not _is_visit(request):
                    check_origin(request.headers)
            except Refused as refused:
                return connection.respond(refused.status, "Open the address that neuspring play printed.\n")
            try:
                frame = asked_frame(request.path, scenario)
            except Refused as refused:
                return connection.respond(refused.status, f"{refused}\n")
            if frame is not None:
                asked(frame)
            if (answer := process_request(connection, request)) is not None:
                answer.headers.update(FILE_HEADERS)
                if answer.headers.get("Content-Type", "").startswith("text/html"):
                    answer.headers.update(PAGE_HEADERS)
            return answer

        return original(*arguments, process_request=checked, **options)

    module.serve = serve  # type: ignore[assignment,misc]
    try:
        yield used
    finally:
        module.serve = original  # type: ignore[misc]
