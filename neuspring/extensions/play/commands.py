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
        arg(help="results/<scenario>, or runs <scenario>/<method>/<seed> of one scenario; the sample twin by default"),
    ] = (),
    host: Annotated[str, arg(help="address to listen at; the default is for this machine alone")] = "127.0.0.1",
    port: Annotated[int, arg(help="0: any that is free")] = 8080,
    frame: Annotated[int, arg(help="frame to begin with")] = 0,
    no_open: Annotated[bool, arg(help="print the address, and open no browser")] = False,
) -> None:
    """Runs of a results folder in the browser, until Ctrl-C; twins that can be pulled by hand."""
    from neuspring.core.web import is_loopback, open_page
    from neuspring.data.sample import sample_twin
    from neuspring.extensions.play.page import Page
    from neuspring.extensions.play.serve import address, start
    from neuspring.report.shown import find

    found = find(results or (sample_twin(),))
    frames = found.observations.scenario.frame_count
    if not 0 <= frame < frames:
        raise InputError("--frame", f"{found.folder.name} has the frames 0 to {frames - 1}", frame)
    pages: list[Page] = []

    def go_to(chosen: int) -> None:
        for page in pages:
            page.show(chosen)

    server = start(host, port, go_to, found.folder.name)
    page = Page(server, found)
    page.show(frame)
    pages.append(page)
    print(f"Play {found.folder.name} at {address(server)} (stop with Ctrl-C)", flush=True)
    print("To pull the twin there: Live, Start, then take it with the mouse.", flush=True)
    if not is_loopback(host):
        print("Everybody who can reach this address sees and moves the scene; an SSH tunnel to 127.0.0.1 is safer.", flush=True)
    if not no_open:
        open_page(address(server))
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        print("\nStopped.", flush=True)
    finally:
        page.close()
        server.stop()
