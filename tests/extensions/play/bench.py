"""The playground's live mode: `python -m tests.extensions.play.bench [--nodes N ...] [--seconds S] [--frames N] [--runs RUN ...]`.

For each size a box of random points (`scenes.py`, 100 substeps per frame of 1/30 s) is pulled by a mouse that moves 60 times per
second. Columns: one frame of the simulation alone, and one with its drawing, in ms of processor time (medians), so that other work
does not count; then as it was in real time: frames per second, and the time from a move of the mouse until the scene with its
effect was handed to viser. No browser is open: what it costs depends on its machine.

`--frames N` then lets the smallest twin run N frames as fast as it can, and says how memory grows; half an hour at 30 frames/s are
54,000 frames.

`--runs RESULTS/SCENARIO/METHOD/SEED ...` measures finished runs instead, while a headless Chromium on this machine draws them by
software and a mouse pulls their highest node.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from neuspring.core.artifacts import Trajectory, Twin
from neuspring.core.records import Recorder
from neuspring.extensions.play.controls import MOST_FRAMES
from neuspring.extensions.play.live import Live
from neuspring.extensions.play.page import Page
from neuspring.extensions.play.player import Player
from neuspring.extensions.play.serve import address, start
from neuspring.extensions.play.simulator import Simulator, StartState
from neuspring.report.shown import find
from tests.benchmarks.memory import resident_mib
from tests.benchmarks.scenes import box
from tests.support import scenarios
from tests.support.browser import Browser
from tests.support.pointing import WINDOW, pixel, settled, until
from tests.support.pointing import pull as mouse

NODES = (100, 400, 1000, 2000, 5000)
SUBSTEPS, NEIGHBORS = 100, 22
MOVES = 60
"""Moves of the mouse per second."""
FEWEST = 12
"""Frames that a row is the median of, at least."""
SAMPLES = 10
"""Of memory."""
PATIENCE = 300.0
"""With a browser that draws by software, s."""


class Timed(Live):
    """A live twin that remembers the processor time of its frames, s."""

    spent: list[float]

    def _step(self, frame_time: float) -> None:
        begun = time.thread_time()
        super()._step(frame_time)
        self.__dict__.setdefault("spent", []).append(time.thread_time() - begun)


class Hurried(Live):
    """A live twin that does not wait for real time."""

    def _wait(self, seconds: float) -> None:
        time.sleep(0)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, nargs="+", default=NODES)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--frames", type=int, default=0)
    parser.add_argument("--runs", type=Path, nargs="+", default=())
    a = parser.parse_args()
    for run in a.runs:
        print(browsed(run, a.seconds), flush=True)
    if a.runs:
        return
    print("nodes  springs | processor time of a frame, ms: simulation  with drawing | frames/s of 30  mouse to scene, ms")
    for nodes in a.nodes:
        print(row(nodes, a.seconds), flush=True)
    if a.frames:
        grow(min(a.nodes), a.frames)


def row(nodes: int, seconds: float) -> str:
    """Frame rate and latency of one size."""
    twin, _ = box(nodes, SUBSTEPS, NEIGHBORS)
    simulator, hands = Simulator(twin), twin.topology.controllers
    times = []
    for frame in range(32):
        begun = time.thread_time()
        simulator.step(hands, 0, twin.topology.nodes[0] + np.array([0, 0, 0.001 * frame]))
        times.append(time.thread_time() - begun)
    with tempfile.TemporaryDirectory() as folder:
        live, close = running(Timed, twin, Path(folder))
        pull(live, seconds)
        while len(live.__dict__.get("spent", ())) < FEWEST:
            pull(live, 1.0)
        # The first frames load kernels.
        alone, whole = (1e3 * float(np.median(values[2:])) for values in (times, live.spent))
        text = f"{live.rate:14.1f}  {1e3 * live.latency:18.0f}"
        close()
    return f"{nodes:5d}  {len(twin.topology.springs):7d} | {alone:42.1f}  {whole:12.1f} | {text}"


def grow(nodes: int, frames: int) -> None:
    """Memory over many frames; recordings end after MOST_FRAMES, so that it may rise until then and not later."""
    twin, _ = box(nodes, SUBSTEPS, NEIGHBORS)
    with tempfile.TemporaryDirectory() as folder:
        live, close = running(Hurried, twin, Path(folder))
        begun = time.monotonic()
        print(f"\n{nodes} nodes as fast as they can; a recording is kept for {MOST_FRAMES} frames")
        print("  frame   memory, MiB", flush=True)
        for wanted in np.linspace(frames / SAMPLES, frames, SAMPLES).astype(int):
            while live.simulator.frame < wanted:
                pull(live, 0.5)
            print(f"{live.simulator.frame:7d}  {resident_mib():12.0f}", flush=True)
        print(f"{time.monotonic() - begun:.0f} s; {live.message}")
        close()


def browsed(run: Path, seconds: float) -> str:
    """Frame rate and latency of a run that a browser shows."""
    found = find([run])
    server = start("127.0.0.1", 0)
    page = Page(server, found)
    try:
        with Browser(served=True, webgl=True, patience=PATIENCE) as browser:
            browser.open(address(server), *WINDOW)
            until(server.get_clients, PATIENCE)
            page.panel.start(found.shown[0])
            live = page.panel.live
            assert live is not None
            # The first frames load kernels.
            until(lambda: live.simulator.frame > 5, PATIENCE)
            x = live.simulator.positions
            node = int(np.argmax(x[:, 2] * (1 if found.observations.scenario.up == "+z" else -1)))
            x_mouse, y_mouse = pixel(settled(server, browser), x[node])
            with mouse(browser, x_mouse, y_mouse, 20, -20):
                until(lambda: live.simulator.grabbed >= 0, PATIENCE)
                frame, begun, rates, delays = live.simulator.frame, time.monotonic(), [], []
                while time.monotonic() < begun + seconds:
                    time.sleep(0.1)
                    right = 20 + 10 * np.sin(6 * time.monotonic())
                    browser._mouse("mouseMoved", x_mouse + right, y_mouse - 20, 0, buttons=1)
                    rates.append(live.rate)
                    delays.append(live.latency)
                reached = (live.simulator.frame - frame) / (time.monotonic() - begun)
        graph = live.simulator.twin.topology
        size = f"{len(graph.nodes)} nodes, {len(graph.springs)} springs, {live.simulator.twin.simulation.substeps} substeps"
        wanted = found.observations.scenario.frame_rate
        slow = 1e3 * float(np.median(delays))
        return f"{run}: {size}; {reached:.1f} frames/s of {wanted:g} (least {min(rates):.1f}); mouse to scene {slow:.0f} ms"
    finally:
        page.close()
        server.stop()


def running(kind: type[Live], twin: Twin, folder: Path):
    """A live twin on a server without browsers, and what ends both."""
    found = find([written(twin, folder)])
    server = start("127.0.0.1", 0)
    player = Player(server.scene, found)
    player.hide(True)
    live = kind(server, player, found.runs[0], StartState())

    def close() -> None:
        live.close()
        server.stop()

    return live, close


def written(twin: Twin, folder: Path) -> Path:
    """The twin as a run of a scenario."""
    x, hands = twin.topology.nodes, twin.topology.controllers
    frames = 5
    still = {"object_points": np.tile(x, (frames, 1, 1)), "controller_points": np.tile(hands, (frames, 1, 1))}
    still |= {"surface_points": np.zeros((0, 3)), "interior_points": np.zeros((0, 3))}
    scenarios.observations(frames, len(x), **still).save(folder / "box" / "observations.npz")
    place = folder / "box" / "neuspring" / "0"
    place.mkdir(parents=True)
    twin.save(place / "twin.npz")
    record = Recorder("rollout", place / "rollout.json")
    files = record.beside(trajectory="trajectory.npz")
    Trajectory(positions=still["object_points"], frame_count=frames).save(files["trajectory"])
    record.save(files)
    return folder / "box"


def pull(live: Live, seconds: float) -> None:
    """Move a grabbed node up and down for some seconds."""
    place = live.simulator.positions[0].copy()
    live.grab.take(1, "node", 0, place)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        live.grab.pull(1, place + np.array([0, 0, 0.01 * np.sin(6 * time.monotonic())]))
        time.sleep(1 / MOVES)
    live.grab.release(1)


if __name__ == "__main__":
    main()
