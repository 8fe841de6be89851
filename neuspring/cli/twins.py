"""Commands on twins: play, export."""

from __future__ import annotations

import importlib
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from neuspring.cli.options import Positional, arg
from neuspring.core.errors import InputError

if TYPE_CHECKING:
    from neuspring.extensions.play.page import Page

FORMATS = {
    "npz": ("plain.write", "", "{name}_npz"),
    "ply": ("ply.write", "0", "{name}"),
    "newton": ("simulators.write_newton", "", "{name}_newton"),
    "mujoco": ("simulators.write_mujoco", "", "{name}_mujoco"),
    "usd": ("usd.write", "", "{name}.usdc"),
}
"""Format -> module and function of neuspring.extensions.exports, frames by default (all where empty), what is written by default."""


def export(
    twin: Annotated[Positional[Path], arg(help="a run's folder, results/<scenario>/<method>/<seed>, or a twin.npz")],
    to: Annotated[Literal["npz", "ply", "newton", "mujoco", "usd"], arg(help="format")],
    output: Annotated[Path | None, arg(help="file or folder to write; by default it is named after the run")] = None,
    frames: Annotated[str | None, arg(help="FIRST, FIRST:STOP or FIRST:STOP:STEP; all by default, of ply frame 0")] = None,
    rate: Annotated[float | None, arg(help="time codes per second (usd); the capture's frames per second by default")] = None,
) -> None:
    """A twin -> USD, PLY, Newton, MuJoCo, or npz with a JSON description."""
    from neuspring.extensions.exports.source import chosen_frames, read_source

    writer, default, name = FORMATS[to]
    module, _, function = writer.partition(".")
    if rate is not None and to != "usd":
        raise InputError("--rate", "is for usd", f"--to {to}", "Leave it out: the files say the time of each frame.")
    source = read_source(twin)
    chosen = chosen_frames(frames, source, default)
    target = output or Path("export") / name.format(name=source.name)
    own = {"rate": rate} if to == "usd" else {}
    for path in getattr(importlib.import_module(f"neuspring.extensions.exports.{module}"), function)(source, chosen, target, **own):
        print(f"Wrote {path}")


def play(
    results: Annotated[
        Positional[tuple[Path, ...]], arg(help="results/<scenario>, or runs <scenario>/<method>/<seed> of one scenario")
    ],
    host: Annotated[str, arg(help="address to listen at; the default is for this machine alone")] = "127.0.0.1",
    port: Annotated[int, arg(help="0: any that is free")] = 8080,
    frame: Annotated[int, arg(help="frame to begin with")] = 0,
    save: Annotated[Path, arg(help="folder where recordings are saved")] = Path(),
    replay: Annotated[Path | None, arg(help="show a saved recording again")] = None,
    compare: Annotated[bool, arg(help="with --replay: print how the other twins move under it, and end")] = False,
) -> None:
    """Runs of a results folder in the browser, until Ctrl-C; twins that can be pulled by hand."""
    from neuspring.extensions.play.controls import comparison, load_controls, pulled_run
    from neuspring.extensions.play.results import find

    found = find(results)
    frames = found.observations.scenario.frame_count
    if not 0 <= frame < frames:
        raise InputError("--frame", f"{found.folder.name} has the frames 0 to {frames - 1}", frame)
    controls = load_controls(replay) if replay else None
    own = pulled_run(found, controls, replay) if controls and replay else None
    if compare:
        if controls is None or own is None:
            raise InputError("--compare", "a recording is required", "none", "Give it with --replay FILE.")
        for line in comparison(found, controls, own):
            print(line, flush=True)
        return
    from neuspring.core.web import is_loopback
    from neuspring.extensions.play.page import Page
    from neuspring.extensions.play.serve import address, start

    pages: list[Page] = []

    def go_to(chosen: int) -> None:
        for page in pages:
            page.show(chosen)

    server = start(host, port, go_to, found.folder.name)
    page = Page(server, found, save)
    page.show(frame)
    pages.append(page)
    if own is not None:
        page.panel.start(own.name, controls)
    print(f"Play {found.folder.name} at {address(server)} (stop with Ctrl-C)", flush=True)
    if not is_loopback(host):
        print("Everybody who can reach this address sees and moves the scene; an SSH tunnel to 127.0.0.1 is safer.", flush=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        print("\nStopped.", flush=True)
    finally:
        page.close()
        server.stop()
