"""The command annotate: masks and tracks of a capture by hand, in a browser."""

from __future__ import annotations

import os
import sys
import webbrowser
from argparse import ArgumentParser, Namespace
from pathlib import Path

from neuspring.cli import options as shared


def annotate_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring annotate`."""
    parser.add_argument("capture", type=Path, help="folder with capture.json")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at; the default is for this machine alone")
    parser.add_argument("--port", type=int, default=8765, help="0: any that is free")
    parser.add_argument("--no-open", action="store_true", help="print the address, and open no browser")
    shared.add_settings(parser)


def annotate(a: Namespace) -> None:
    """`neuspring annotate`: serves until Ctrl-C."""
    from neuspring.data.capture import Capture
    from neuspring.perception.annotate.guard import is_loopback
    from neuspring.perception.annotate.server import Server

    settings = shared.read_settings(a.settings).perception.segment.marks
    server = Server(Capture.load(a.capture), settings, a.host, a.port)
    print(f"Annotate {a.capture} at {server.url} (stop with Ctrl-C)", flush=True)
    if not is_loopback(a.host):
        print("Anybody who can read this network's traffic can read the address; an SSH tunnel to 127.0.0.1 is safer.", flush=True)
    if not a.no_open and _has_display():
        webbrowser.open(server.url)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        print("\nStopped. Marks and clicks are saved.", flush=True)
    finally:
        server.close()


def _has_display() -> bool:
    """Whether a window can be opened: without one, webbrowser may start a text browser in this terminal."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
