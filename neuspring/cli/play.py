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


def play(a: Namespace) -> None:
    """`neuspring play`: serves until Ctrl-C."""
    from neuspring.perception.annotate.guard import is_loopback
    from neuspring.play.page import Page
    from neuspring.play.results import find
    from neuspring.play.serve import address, start

    found = find(a.results)
    server = start(a.host, a.port)
    page = Page(server, found)
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
