"""The command play: runs of a results folder in the browser, and twins that can be pulled."""

from __future__ import annotations

import threading
from argparse import ArgumentParser, Namespace
from pathlib import Path


def play_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring play`."""
    parser.add_argument(
        "results", type=Path, nargs="+", help="results/<scenario>, or runs <scenario>/<method>/<seed> of one scenario"
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at; the default is for this machine alone")
    parser.add_argument("--port", type=int, default=8080, help="0: any that is free")
    parser.add_argument(
        "--save", type=Path, default=Path(), metavar="FOLDER", help="where recordings are saved; default: this folder"
    )
    parser.add_argument("--replay", type=Path, metavar="FILE", help="show a saved recording again")
    parser.add_argument("--compare", action="store_true", help="with --replay: print how the other twins move under it, and end")


def play(a: Namespace) -> None:
    """`neuspring play`: serves until Ctrl-C."""
    from neuspring.core.errors import InputError
    from neuspring.perception.annotate.guard import is_loopback
    from neuspring.play.controls import load_controls
    from neuspring.play.page import Page
    from neuspring.play.results import find
    from neuspring.play.scoring import comparison, pulled_run
    from neuspring.play.serve import address, start

    found = find(a.results)
    controls = load_controls(a.replay) if a.replay else None
    own = pulled_run(found, controls, a.replay) if controls else None
    if a.compare:
        if controls is None or own is None:
            raise InputError("--compare", "a recording is required", "none", "Give it with --replay FILE.")
        print(comparison(found, controls, own))
        return
    server = start(a.host, a.port)
    page = Page(server, found, a.save)
    if own is not None:
        page.panel.start(own.name, controls)
    print(f"Play {found.folder.name} at {address(server)} (stop with Ctrl-C)", flush=True)
    if not is_loopback(a.host):
        print("Everybody who can reach this address sees and moves the scene; an SSH tunnel to 127.0.0.1 is safer.", flush=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        print("\nStopped.", flush=True)
    finally:
        page.close()
        server.stop()
