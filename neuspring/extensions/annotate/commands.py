"""The command `annotate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from neuspring.cli.options import Positional, arg


def annotate(
    capture: Annotated[Positional[Path], arg(help="folder with capture.json")],
    host: Annotated[str, arg(help="address to listen at; the default is for this machine alone")] = "127.0.0.1",
    port: Annotated[int, arg(help="0: any that is free")] = 8765,
    no_open: Annotated[bool, arg(help="print the address, and open no browser")] = False,
) -> None:
    """Mark object, controllers and person of a capture in the browser; serves until Ctrl-C."""
    from neuspring.core.web import is_loopback, open_page
    from neuspring.data.capture import Capture
    from neuspring.extensions.annotate.server import Server

    server = Server(Capture.load(capture), host, port)
    print(f"Annotate {capture} at {server.url} (stop with Ctrl-C)", flush=True)
    if not is_loopback(host):
        print("Anybody who can read this network's traffic can read the address; an SSH tunnel to 127.0.0.1 is safer.", flush=True)
    if not no_open:
        open_page(server.url)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        print("\nStopped. Marks are saved.", flush=True)
    finally:
        server.close()
