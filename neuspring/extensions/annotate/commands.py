"""The command `annotate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from neuspring.cli.options import Positional, arg


def annotate(
    capture: Annotated[Positional[Path], arg(help="folder with capture.json")],
    host: Annotated[str, arg(help="address to listen at; by default only this machine can connect")] = "127.0.0.1",
    port: Annotated[int, arg(help="port to listen at; 0: any free port")] = 8765,
    no_open: Annotated[bool, arg(help="print the address without opening a browser")] = False,
) -> None:
    """Annotate object, hands and person of a capture in the browser, and carry them through the video; stop with Ctrl-C."""
    from neuspring.core.web import is_loopback, open_page
    from neuspring.data.capture import Capture
    from neuspring.extensions.annotate.server import Server

    server = Server(Capture.load(capture), host, port)
    print(f"Annotate {capture} at {server.url} (stop with Ctrl-C)", flush=True)
    if not is_loopback(host):
        print("The address is sent unencrypted over the network. Use 127.0.0.1 and an SSH tunnel to protect it.", flush=True)
    if not no_open:
        open_page(server.url)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        print("\nStopped. Annotations are saved.", flush=True)
    finally:
        server.close()
