"""The command `play`."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Annotated

from neuspring.cli.options import Positional, arg
from neuspring.core.errors import InputError


def play(
    results: Annotated[
        Positional[tuple[Path, ...]],
        arg(help="results/<scenario>, or runs <scenario>/<method>/<seed> of one scenario; by default the sample twin"),
    ] = (),
    host: Annotated[str, arg(help="address to listen at; by default only this machine can connect")] = "127.0.0.1",
    port: Annotated[int, arg(help="port to listen at; 0: any free port")] = 8080,
    frame: Annotated[int, arg(help="first frame to show")] = 0,
    no_open: Annotated[bool, arg(help="print the address without opening a browser")] = False,
) -> None:
    """Show runs of a results folder in the browser, and pull their twins with the mouse; stop with Ctrl-C."""
    from neuspring.core.web import is_loopback, open_page
    from neuspring.data.sample import sample_twin
    from neuspring.extensions.play.page import Page
    from neuspring.extensions.play.serve import address, start
    from neuspring.report.shown import find

    found = find(results or (sample_twin(),))
    frames = found.observations.scenario.frame_count
    if not 0 <= frame < frames:
        raise InputError("--frame", f"must be 0 to {frames - 1} for {found.folder.name}", frame)
    pages: list[Page] = []

    def go_to(chosen: int) -> None:
        for page in pages:
            page.show(chosen)

    server = start(host, port, go_to, found.folder.name)
    page = Page(server, found)
    page.show(frame)
    pages.append(page)
    print(f"Play {found.folder.name} at {address(server)} (stop with Ctrl-C)", flush=True)
    print("To pull the twin, press Start under Live, then pull it with the mouse.", flush=True)
    if not is_loopback(host):
        print("Everyone who can reach this address can see and move the scene. An SSH tunnel to 127.0.0.1 is safer.", flush=True)
    if not no_open:
        open_page(address(server))
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        print("\nStopped.", flush=True)
    finally:
        page.close()
        server.stop()
