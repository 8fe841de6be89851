"""The command play: runs of a results folder in the browser, and twins that can be pulled."""

from __future__ import annotations

import threading
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from neuspring.core.errors import InputError

if TYPE_CHECKING:
    from neuspring.play.controls import Controls
    from neuspring.play.page import Page
    from neuspring.play.results import Run, Scene


def play_options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring play`."""
    parser.add_argument(
        "results", type=Path, nargs="+", help="results/<scenario>, or runs <scenario>/<method>/<seed> of one scenario"
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at; the default is for this machine alone")
    parser.add_argument("--port", type=int, default=8080, help="0: any that is free")
    parser.add_argument("--frame", type=int, default=0, help="frame to begin with")
    parser.add_argument(
        "--save", type=Path, default=Path(), metavar="FOLDER", help="where recordings are saved; default: this folder"
    )
    parser.add_argument("--replay", type=Path, metavar="FILE", help="show a saved recording again")
    parser.add_argument("--compare", action="store_true", help="with --replay: print how the other twins move under it, and end")
    parser.add_argument("--video", type=Path, metavar="FILE.mp4", help="with --replay: write it as a video, and end")
    parser.add_argument("--camera", help="with --video: a camera of the capture; default: a view from the side")


def play(a: Namespace) -> None:
    """`neuspring play`: serves until Ctrl-C."""
    from neuspring.play.controls import load_controls, pulled_run
    from neuspring.play.results import find

    found = find(a.results)
    frames = found.observations.scenario.frame_count
    if not 0 <= a.frame < frames:
        raise InputError("--frame", f"{found.folder.name} has the frames 0 to {frames - 1}", a.frame)
    controls = load_controls(a.replay) if a.replay else None
    own = pulled_run(found, controls, a.replay) if controls else None
    if controls is not None and own is not None and (a.compare or a.video):
        _evaluate(a, found, own, controls)
        return
    for name in ("compare", "video", "camera"):
        if getattr(a, name):
            raise InputError(f"--{name}", "a recording is required", "none", "Give it with --replay FILE.")
    _serve(a, found, own, controls)


def _evaluate(a: Namespace, found: Scene, own: Run, controls: Controls) -> None:
    """Print the comparison, write the video."""
    from neuspring.play.controls import comparison
    from neuspring.play.video import write_video

    if a.compare:
        for line in comparison(found, controls, own):
            print(line, flush=True)
    if a.video:
        video = write_video(found, own, controls, a.video, a.camera)
        print(f"Wrote {video.path}: {video.frames} frames, {video.kind}" + (f" ({video.reason})" if video.reason else ""))


def _serve(a: Namespace, found: Scene, own: Run | None, controls: Controls | None) -> None:
    """The page, until Ctrl-C."""
    from neuspring.perception.annotate.guard import is_loopback
    from neuspring.play.page import Page
    from neuspring.play.serve import address, start

    pages: list[Page] = []

    def go_to(frame: int) -> None:
        for page in pages:
            page.show(frame)

    server = start(a.host, a.port, go_to, found.folder.name)
    page = Page(server, found, a.save)
    page.show(a.frame)
    pages.append(page)
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
