"""The sections of the table: what is measured, and in which company."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuspring.core.artifacts import Twin
from tests.benchmarks import bench_start, work
from tests.benchmarks.limits import Limits
from tests.benchmarks.memory import growth
from tests.benchmarks.ours import Ours
from tests.benchmarks.scenes import CASES, box, sheet, shortened
from tests.benchmarks.simulators import Frame, Simulator, Times, distances, gradient_difference, take_turns
from tests.benchmarks.table import Row

TOGETHER = 16
"""Twins of one call in the first section: the lanes of a vector."""


@dataclass(frozen=True)
class Bench:
    """What a section measures with."""

    device: str
    limits: Limits
    ours: Ours
    peer: Simulator | None = None
    quick: bool = False
    notes: list[str] = field(default_factory=list)
    """What a reader of the table should know of this run."""

    def clock(self, actions: dict[str, Callable[[], object]]) -> dict[str, Times]:
        """Times of actions that take turns."""
        return take_turns(actions, self.device, rounds=5 if self.quick else 9, seconds=2.0 if self.quick else 5.0)


@dataclass(frozen=True)
class Entry:
    """A row to be."""

    name: str
    twin: Twin
    frame: Frame
    reference: str = ""
    batch: int = 1

    @property
    def work(self) -> work.Work:
        """Least work of a spring and substep."""
        return work.FORWARD_BACKWARD if self.frame.gradient else work.FORWARD

    @property
    def counts(self) -> tuple[int, int, int, int]:
        """Nodes, springs, substeps, twins."""
        return len(self.twin.topology.nodes), len(self.twin.topology.springs), self.twin.simulation.substeps, self.batch


def timed(bench: Bench, section: str, entries: Sequence[Entry]) -> list[Row]:
    """The rows of entries that take turns. Ratios are in time per spring, substep and twin."""
    times = bench.clock({entry.name: entry.frame.run for entry in entries})
    named = {entry.name: entry for entry in entries}
    rows = []
    for entry in entries:
        mine, (nodes, springs, substeps, batch) = times[entry.name], entry.counts
        row = Row(
            section=section, name=entry.name, device=bench.device, median=1e3 * mine.median, least=1e3 * mine.least,
            nodes=nodes, springs=springs, substeps=substeps, batch=batch,
        )  # fmt: skip
        if not entry.twin.simulation.self_collision:
            # What contacts cost is not in this count.
            bandwidth, arithmetic = entry.work.shares(mine.median, *entry.counts, bench.limits)
            row = replace(row, bandwidth=bandwidth, arithmetic=arithmetic)
        if entry.reference:
            other = named[entry.reference]
            ratio, scale = mine.over(times[other.name]), np.prod(other.counts[1:]) / np.prod(entry.counts[1:])
            median, least = float(scale * ratio.median), float(scale * ratio.least)
            row = replace(row, ratio=median, least_ratio=least, reference=other.name)
        rows.append(row)
    return rows


def population(twin: Twin, count: int) -> list[Twin]:
    """Twins of one topology, each softer than the one before, down to half the stiffness."""
    materials = [replace(twin.material, stiffness=twin.material.stiffness * scale) for scale in np.linspace(1, 0.5, count)]
    return [replace(twin, material=material) for material in materials]


def together(bench: Bench, twin: Twin, hands: np.ndarray, count: int, *, gradient: bool) -> Frame | None:
    """`count` twins in one call; None, with a note, where the engine cannot."""
    try:
        return bench.ours.together(population(twin, count), hands, gradient=gradient)
    except NotImplementedError as error:
        bench.notes.append(f"left out on {bench.device}: {error}")
        return None


def frames(bench: Bench) -> list[Row]:
    """A frame of both boxes: one twin alone, several together, the peer."""
    rows = []
    for case in ("a",) if bench.quick else CASES:
        twin, hands = box(*CASES[case])
        entries = list(_company(bench, case, twin, hands))
        rows += timed(bench, "frame", entries)
        _agree(bench, entries)
    return rows


def _company(bench: Bench, case: str, twin: Twin, hands: np.ndarray) -> Iterator[Entry]:
    for kind, gradient in (("forward", False), ("forward + backward", True)):
        alone = f"{case}: {kind}"
        yield Entry(alone, twin, _frame(bench.ours, twin, hands, gradient))
        crowd = together(bench, twin, hands, TOGETHER, gradient=gradient)
        if crowd:
            yield Entry(f"{alone}, {TOGETHER} together", twin, crowd, alone, TOGETHER)
        if bench.peer:
            yield Entry(f"{alone}, {bench.peer.name}", twin, _frame(bench.peer, twin, hands, gradient), alone)


def _frame(simulator: Simulator, twin: Twin, hands: np.ndarray, gradient: bool) -> Frame:
    return simulator.forward_backward(twin, hands) if gradient else simulator.forward(twin, hands)


def _agree(bench: Bench, entries: Sequence[Entry]) -> None:
    """Note how far positions and gradients of frames that ran are from those of their references."""
    named = {entry.name: entry for entry in entries}
    for entry in entries:
        if entry.reference:
            frame, other = entry.frame, named[entry.reference].frame
            found = f"positions agree with those of the twin alone to {distances(frame, other).max():.1e} m"
            if frame.gradient and other.gradient:
                found += f", gradients to {gradient_difference(frame, other):.1e} of their norm"
            bench.notes.append(f"{entry.name}, {bench.device}: {found}")


def by_nodes(bench: Bench) -> list[Row]:
    """More nodes of a box."""
    sizes = (500, 5_000) if bench.quick else (500, 1_000, 2_000, 5_000, 10_000, 20_000, 50_000)
    return _scaling(bench, "nodes", [(f"{size:,} nodes", box(size, 20, 22)) for size in sizes])


def by_neighbours(bench: Bench) -> list[Row]:
    """More springs per node of a box of 2,000 nodes."""
    sizes = (8, 32) if bench.quick else (8, 16, 32, 64)
    scenes = [box(2000, 67, size) for size in sizes]
    names = [f"{len(twin.topology.springs) / len(twin.topology.nodes):.0f} springs per node" for twin, _ in scenes]
    return _scaling(bench, "springs", list(zip(names, scenes, strict=True)))


def by_substeps(bench: Bench) -> list[Row]:
    """More substeps of the small box."""
    counts = (67, 667) if bench.quick else (67, 200, 667, 2000)
    return _scaling(bench, "substeps", [(f"{count:,} substeps", box(400, count, 22)) for count in counts])


def _scaling(bench: Bench, section: str, scenes: Sequence[tuple[str, tuple[Twin, np.ndarray]]]) -> list[Row]:
    """Forward alone and with its gradient; the first scene is the reference."""
    rows = []
    for kind, gradient in (("forward", False), ("forward + backward", True)):
        entries = [Entry(f"{name}, {kind}", twin, _frame(bench.ours, twin, hands, gradient)) for name, (twin, hands) in scenes]
        rows += timed(bench, section, [entries[0], *(replace(entry, reference=entries[0].name) for entry in entries[1:])])
    return rows


def by_batch(bench: Bench) -> list[Row]:
    """More twins in a call, on the small box."""
    twin, hands = box(*CASES["a"])
    rows = []
    for kind, gradient in (("forward", False), ("forward + backward", True)):
        entries: list[Entry] = []
        for count in (1, 16) if bench.quick else (1, 4, 16, 64):
            frame = together(bench, twin, hands, count, gradient=gradient)
            if frame is None:
                break
            entries.append(Entry(f"{count} together, {kind}", twin, frame, entries[0].name if entries else "", count))
        if entries:
            rows += timed(bench, "batch", entries)
    return rows


def by_contacts(bench: Bench) -> list[Row]:
    """A sheet folded onto itself, with self-collision."""
    rows = []
    for size in (2_000,) if bench.quick else (2_000, 4_300, 8_600):
        twin, hands = sheet(size, 67)
        rows += timed(bench, "collision", list(_company(bench, f"sheet of {size:,}", twin, hands)))
        if bench.peer:
            _touch_alike(bench, bench.peer, twin, hands)
    return rows


def _touch_alike(bench: Bench, peer: Simulator, twin: Twin, hands: np.ndarray) -> None:
    """Note how many nodes agree after a part of a frame. Rounding decides whether two nodes just touch, and contacts amplify it."""
    substeps, tolerance = 15, 1e-7
    pair = [_frame(simulator, shortened(twin, substeps), hands, False) for simulator in (bench.ours, peer)]
    for frame in pair:
        frame.run()
    apart = distances(*pair)
    found = f"{np.mean(apart < tolerance):.1%} of the nodes agree to {tolerance:.0e} m after {substeps} substeps"
    bench.notes.append(f"sheet of {len(apart):,} nodes, {peer.name}, {bench.device}: {found}, all to {apart.max():.0e} m")


def memory(bench: Bench) -> list[Row]:
    """A gradient through many frames: with the states between frames, and with those of every substep."""
    count = 15 if bench.quick else 150
    # In a process of its own, whose memory nothing else has used and given back.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        between, every = process.submit(rises, bench.device, count).result()
    (nodes, substeps, _), springs = CASES["a"], len(box(*CASES["a"])[0].topology.springs)
    first, second = f"gradient of {count} frames", f"gradient of {count} frames, every substep kept"
    common: dict[str, Any] = {"section": "memory", "device": bench.device, "nodes": nodes, "springs": springs, "substeps": substeps}
    rows = [Row(name=name, median=rise, least=rise, unit="MiB", **common) for name, rise in ((first, between), (second, every))]
    return [rows[0], replace(rows[1], ratio=every / between, reference=first)] if between > 0 else rows


def rises(device: str, count: int) -> tuple[float, float]:
    """MiB by which memory rises during a gradient through `count` frames: of states between frames, of states of every substep."""
    torch.set_num_threads(1)
    ours, (twin, hands) = Ours(device), box(*CASES["a"])
    substeps = twin.simulation.substeps
    # Up and down again: the hands stay near the body.
    path = hands[[k % 2 for k in range(count + 1)]]
    step = np.arange(count * substeps + 1)
    frame, share = step // substeps, (step % substeps / substeps)[:, None, None]
    fine = path[frame] * (1 - share) + path[np.minimum(frame + 1, count)] * share
    found = []
    for body, way in ((twin, path), (shortened(twin, 1), fine)):
        # What the first frames allocate for good is no part of the growth.
        ours.chain(body, way[:3])()
        found.append(growth(ours.chain(body, way), device))
    return found[0], found[1]


def start(bench: Bench) -> list[Row]:
    """A job from start to end, and a crowd of them without compiled kernels. On the CPU alone."""
    if bench.device != "cpu":
        return []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        command = bench_start.tiny(folder)
        times = Times(tuple(bench_start.alone(folder, command, 1 if bench.quick else 3)))
        found = {"a job alone": times}
        if not bench.quick:
            found["16 jobs at once, no kernels yet"] = Times((bench_start.crowd(folder, command)[0],))
    return [
        Row(section="start", name=name, device="cpu", median=its.median, least=its.least, unit="s") for name, its in found.items()
    ]


SECTIONS: dict[str, Callable[[Bench], list[Row]]] = {
    "frame": frames,
    "nodes": by_nodes,
    "springs": by_neighbours,
    "substeps": by_substeps,
    "batch": by_batch,
    "collision": by_contacts,
    "memory": memory,
    "start": start,
}
