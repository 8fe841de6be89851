"""Sections of the table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from typing import Any

import numpy as np
import torch

from neuspring.core.artifacts import Twin
from results.published.bench.crowds import by_batch, by_topologies, of_search, softer
from results.published.bench.memory import growth
from results.published.bench.ours import Ours, reference_frame
from results.published.bench.rows import KINDS, Bench, Entry, agree, frame_of, timed
from results.published.bench.scenes import CASES, box, sheet, shortened
from results.published.bench.simulators import Simulator, distances
from results.published.bench.table import Row

TOGETHER = 16
"""Twins per call in the first section."""


def frames(bench: Bench) -> list[Row]:
    """Rows for a frame of two boxes: one twin, several together, the peer, and on a CPU the NumPy specification."""
    rows = []
    for case in ("a",) if bench.quick else ("a", "c") if bench.on_gpu else ("a", "b"):
        twin, hands = box(*CASES[case])
        entries = list(_company(bench, case, twin, hands))
        if case == "a" and not bench.on_gpu:
            entries.append(Entry(f"{case}: forward, NumPy in float64", twin, reference_frame(twin, hands), entries[0].name))
        rows += timed(bench, "frame", entries)
        agree(bench, entries)
    return rows


def _company(bench: Bench, case: str, twin: Twin, hands: np.ndarray) -> Iterator[Entry]:
    for kind, gradient in KINDS:
        alone = f"{case}: {kind}"
        yield Entry(alone, twin, frame_of(bench.ours, twin, hands, gradient))
        crowd = bench.ours.together(softer(twin, TOGETHER), hands, gradient=gradient)
        yield Entry(f"{alone}, {TOGETHER} together", twin, crowd, alone, TOGETHER)
        if bench.peer:
            yield Entry(f"{alone}, {bench.peer.name}", twin, frame_of(bench.peer, twin, hands, gradient), alone)


def by_nodes(bench: Bench) -> list[Row]:
    """Rows for boxes with more and more nodes."""
    sizes = (500, 5_000) if bench.quick else (500, 1_000, 2_000, 5_000, 10_000, 20_000, 50_000)
    return _scaling(bench, "nodes", [(f"{size:,} nodes", box(size, 20, 22)) for size in sizes])


def _scaling(bench: Bench, section: str, scenes: Sequence[tuple[str, tuple[Twin, np.ndarray]]]) -> list[Row]:
    """Rows forward and with gradients; the first scene is the reference."""
    rows = []
    for kind, gradient in KINDS:
        entries = [Entry(f"{name}, {kind}", twin, frame_of(bench.ours, twin, hands, gradient)) for name, (twin, hands) in scenes]
        rows += timed(bench, section, [entries[0], *(replace(entry, reference=entries[0].name) for entry in entries[1:])])
    return rows


def by_contacts(bench: Bench) -> list[Row]:
    """Rows for a folded sheet with self-collision, and notes on the growth of time with the nodes."""
    rows: list[Row] = []
    grown: dict[str, list[Row]] = {}
    for size in (2_000,) if bench.quick else (2_000, 4_300, 8_600):
        twin, hands = sheet(size, 67)
        for row in timed(bench, "collision", list(_company(bench, f"sheet of {size:,}", twin, hands))):
            rows.append(row)
            grown.setdefault(row.name.partition(": ")[2], []).append(row)
        if bench.peer:
            _note_contacts(bench, bench.peer, twin, hands)
    for name, group in grown.items():
        if len(group) > 1:
            bench.notes.append(f"collision, {name}, {bench.device}: time grows as nodes to the power of {exponent(group):.2f}")
    return rows


def exponent(rows: Sequence[Row]) -> float:
    """p in least time ~ nodes^p, by least squares of the logarithms."""
    return float(np.polyfit(np.log([row.nodes for row in rows]), np.log([row.least for row in rows]), 1)[0])


def _note_contacts(bench: Bench, peer: Simulator, twin: Twin, hands: np.ndarray) -> None:
    """Add a note on how many nodes agree after a part of a frame; contacts amplify rounding."""
    substeps, tolerance = 15, 1e-7
    pair = [frame_of(simulator, shortened(twin, substeps), hands, False) for simulator in (bench.ours, peer)]
    for frame in pair:
        frame.run()
    apart = distances(*pair)
    found = f"{np.mean(apart < tolerance):.1%} of the nodes agree to {tolerance:.0e} m after {substeps} substeps"
    bench.notes.append(f"sheet of {len(apart):,} nodes, {peer.name}, {bench.device}: {found}, all to {apart.max():.0e} m")


def memory(bench: Bench) -> list[Row]:
    """Rows for memory of a gradient through many frames: with states between frames, and with states of every substep."""
    count = 15 if bench.quick else 150
    # A new process, because freed memory of an old one would hide the growth.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        between, every = process.submit(rises, bench.device, count).result()
    (nodes, substeps, _), springs = CASES["a"], len(box(*CASES["a"])[0].topology.springs)
    first, second = f"gradient of {count} frames", f"gradient of {count} frames, every substep kept"
    common: dict[str, Any] = {"section": "memory", "device": bench.device, "nodes": nodes, "springs": springs, "substeps": substeps}
    rows = [Row(name=name, median=rise, least=rise, unit="MiB", **common) for name, rise in ((first, between), (second, every))]
    rows = [rows[0], replace(rows[1], ratio=every / between, reference=first)] if between > 0 else rows
    return rows


def rises(device: str, count: int) -> tuple[float, float]:
    """Rise of memory, MiB, of a gradient through `count` frames: states between frames, and states of every substep."""
    torch.set_num_threads(1)
    ours, (twin, hands) = Ours(device), box(*CASES["a"])
    substeps = twin.simulation.substeps
    # Up and down, so that the controllers stay near the object.
    path = hands[[k % 2 for k in range(count + 1)]]
    step = np.arange(count * substeps + 1)
    frame, share = step // substeps, (step % substeps / substeps)[:, None, None]
    fine = path[frame] * (1 - share) + path[np.minimum(frame + 1, count)] * share
    found = []
    for body, hands_path in ((twin, path), (shortened(twin, 1), fine)):
        # Exclude permanent allocations of the first frames.
        ours.chain(body, hands_path[:3])()
        found.append(growth(ours.chain(body, hands_path), device))
    return found[0], found[1]


SECTIONS: dict[str, Callable[[Bench], list[Row]]] = {
    "frame": frames,
    "nodes": by_nodes,
    "batch": by_batch,
    "topologies": by_topologies,
    "search": of_search,
    "collision": by_contacts,
    "memory": memory,
}
ON_CUDA = ("frame", "batch", "topologies", "search", "collision")
"""Default sections on CUDA, which end within two minutes."""
