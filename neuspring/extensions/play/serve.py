"""A viser server that listens exactly at the given host and port, and answers only its own pages."""

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
"""Address of the page, optionally with a frame, and with a scenario that must be the shown one."""
FILE_HEADERS = {"X-Content-Type-Options": "nosniff", "X-Frame-Options": "DENY", "Referrer-Policy": "no-referrer"}
"""Headers of all files of the page."""
PAGE_HEADERS = {"Cache-Control": "no-store"}
"""Headers of the page itself. A browser that caches it for its back button keeps the connection, and with it a grabbed node."""


def start(
    host: str, port: int, asked: Callable[[int], object] = lambda frame: None, scenario: str | None = None
) -> viser.ViserServer:
    """Start a server at host and port (0: any free port); `asked` receives the frame of addresses /?frame=<number>.

    Addresses with &scenario=<name> are refused if the name is not `scenario`, the shown one; None accepts all names. Raises
    InputError if it cannot listen there, or without viser.
    """
    needed("viser")
    import viser

    _require_free(host, port)
    # This variable would override the port.
    os.environ.pop("_VISER_PORT_OVERRIDE", None)
    with _guarded(host, asked, scenario) as used, contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label=SERVER_LABEL, verbose=False)
    if not used:
        server.stop()
        raise InputError("viser", "must be a version whose requests can be checked", viser.__version__, "Install viser >=1.1,<2.")
    if port and server.get_port() != port:
        server.stop()
        raise _taken(host, port, "another program uses it now")
    # Otherwise a page could request viser to publish this server through a tunnel.
    server.request_share_url = lambda verbose=True: None  # type: ignore[method-assign]
    server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="large")
    return server


def address(server: viser.ViserServer) -> str:
    """Address to open in the browser."""
    host = server.get_host()
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}/"


def asked_frame(path: str, scenario: str | None) -> int | None:
    """Frame of an address /?frame=<number>, optionally with &scenario=<name>; None for other addresses.

    Raises Refused if the name is not `scenario`, the shown one.
    """
    visit = VISIT.fullmatch(path)
    if visit is None or not visit[1]:
        return None
    if visit[2] and scenario and visit[2] != scenario:
        text = f"This player shows {scenario}. Run `neuspring play` on the folder of {visit[2]}, then follow the link again."
        raise Refused(404, text)
    return int(visit[1])


def _is_visit(request: Any) -> bool:
    """True if a user follows a link to the page, for example from a report, in a window that no other site embeds.

    Other parameters are refused, because they can connect viser's page to another server and show its content.
    """
    headers = request.headers
    navigates = (headers.get("Sec-Fetch-Mode"), headers.get("Sec-Fetch-Dest")) == ("navigate", "document")
    return navigates and "Upgrade" not in headers and VISIT.fullmatch(request.path) is not None


def _require_free(host: str, port: int) -> None:
    """Raise InputError if the port is not free: viser would use the next port, or wait forever."""
    if not 0 <= port < 65536:
        raise InputError("--port", "must be 0 to 65535", port)
    try:
        family, kind, proto, _, target = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except (OSError, UnicodeError) as error:
        rule, received = "must be an address of this machine", f"{host}: {error}"
        raise InputError("--host", rule, received, "Omit it to use 127.0.0.1.") from error
    with socket.socket(family, kind, proto) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(target)
            probe.listen()
        except OSError as error:
            raise _taken(host, port, error.strerror) from error


def _taken(host: str, port: int, reason: object) -> InputError:
    remedy = "Stop the other program, or choose another port; --port 0 selects a free one."
    return InputError(f"--port {port}", f"{host}:{port} must be free", reason, remedy)


@contextlib.contextmanager
def _guarded(host: str, asked: Callable[[int], object], scenario: str | None) -> Iterator[list[bool]]:
    """Servers started inside check Host and Origin of each request; the yielded list stays empty if none was started.

    viser has no hook for this check. Without it, any web page in the user's browser could reach the server, by its address or by
    DNS rebinding.
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
