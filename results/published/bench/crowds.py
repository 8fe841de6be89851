"""Sections with several twins at once: one topology, different topologies, candidates of a search."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import warp as wp

from neuspring.core.artifacts import Twin
from neuspring.core.device import load
from neuspring.physics import frame
from neuspring.physics.lanes import LANE_WIDTH
from neuspring.physics.union import Union
from neuspring.twin import trials
from neuspring.twin.candidates import SearchProblem
from neuspring.twin.search import SearchResult, search
from results.published.bench.plush import problem
from results.published.bench.rows import KINDS, Bench, Entry, agree, frame_of, timed
from results.published.bench.scenes import CASES, box
from results.published.bench.simulators import Frame, Times
from results.published.bench.table import Row

GENERATION = 11
"""Candidates of a generation: the default of CMA-ES for 12 variables."""


def softer(twin: Twin, count: int) -> list[Twin]:
    """Twins of one topology with decreasing stiffness, down to half."""
    materials = [replace(twin.material, stiffness=twin.material.stiffness * scale) for scale in np.linspace(1, 0.5, count)]
    return [replace(twin, material=material) for material in materials]


def by_batch(bench: Bench) -> list[Row]:
    """Rows for 1 to 64 twins in one call, on the small box."""
    twin, hands = box(*CASES["a"])
    rows = []
    for kind, gradient in KINDS:
        entries: list[Entry] = []
        for count in (1, 16) if bench.quick else (1, 4, 8, 16, 64):
            made = bench.ours.together(softer(twin, count), hands, gradient=gradient)
            entries.append(Entry(f"{count} together, {kind}", twin, made, entries[0].name if entries else "", count))
        rows += timed(bench, "batch", entries)
    return rows


def by_topologies(bench: Bench) -> list[Row]:
    """Rows for twins with the nodes of the small box and different topologies, one by one and in one call."""
    nodes, substeps, _ = CASES["a"]
    count = 64 if bench.on_gpu else 16
    scenes = [box(nodes, substeps, size) for size in np.linspace(16, 32, count).astype(int)]
    twins, hands = [twin for twin, _ in scenes], scenes[0][1]
    own = round(statistics.mean([len(twin.topology.springs) for twin in twins]))
    every = Union([twin.topology for twin in twins]).springs
    bench.notes.append(f"{count} topologies, {bench.device}: {own:,} springs on average, {every:,} in the union")
    rows = []
    for kind, gradient in KINDS:
        first, second = f"{count} topologies one by one, {kind}", f"{count} topologies together, {kind}"
        crowd = bench.ours.together(twins, hands, gradient=gradient)
        entries = [
            Entry(first, twins[0], one_by_one(bench, twins, hands, gradient), "", count, own),
            Entry(second, twins[0], crowd, first, count, own),
        ]
        rows += timed(bench, "topologies", entries)
        agree(bench, entries)
    return rows


def one_by_one(bench: Bench, twins: Sequence[Twin], hands: np.ndarray, gradient: bool) -> Frame:
    """A frame of each twin with its own solver; positions and gradient are those of the first twin."""
    frames = [frame_of(bench.ours, twin, hands, gradient) for twin in twins]

    def run() -> None:
        for each in frames:
            each.run()

    return replace(frames[0], run=run)


def of_search(bench: Bench) -> list[Row]:
    """Rows for a search on a plush, seconds per rollout, including creation and scoring of candidates.

    On a CPU the cost of a candidate must not depend on the other lanes. On CUDA only one generation is compared, because the next
    one depends on every cost.
    """
    rollouts = GENERATION if bench.quick or bench.on_gpu else 4 * GENERATION
    alone = "one by one" if bench.on_gpu else "one by one, one thread"
    variants = {alone: {"together": 1}}
    if bench.on_gpu:
        variants |= {f"{GENERATION} in one launch": {}}
    else:
        variants |= {"in lanes, one thread": {}, f"in lanes, {os.cpu_count()} threads": {"threads": os.cpu_count() or 1}}
    case = problem(rollouts, bench.device)
    warm(bench.device)
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    searches: dict[str, SearchResult] = {}
    for _ in range(1 if bench.quick else 2):
        for name, changes in variants.items():
            begin = time.perf_counter()
            searches[name] = search(replace(case, **changes), 0)
            seconds[name].append((time.perf_counter() - begin) / rollouts)
    compare_costs(bench, searches, alone)
    add_notes(bench, case, searches[alone], {name: min(spent) for name, spent in seconds.items()})
    rows = []
    for name, spent in seconds.items():
        times = Times(tuple(spent))
        row = Row(
            section="search",
            name=name,
            device=bench.device,
            median=times.median,
            least=times.least,
            unit="s",
            nodes=len(case.labels),
        )
        if name != alone:
            ratio = times.over(Times(tuple(seconds[alone])))
            row = replace(row, ratio=ratio.median, least_ratio=ratio.least, reference=alone)
        rows.append(row)
    return rows


def compare_costs(bench: Bench, searches: dict[str, SearchResult], alone: str) -> None:
    """Compare costs of all candidates with those of the search one by one: equal bit for bit on a CPU, close on CUDA."""
    reference_costs = searches[alone].trace["cost"].to_numpy()
    for name, result in searches.items():
        costs = result.trace["cost"].to_numpy()
        if not bench.on_gpu:
            assert np.array_equal(costs, reference_costs), f"{name}: costs differ from those one by one"
        elif name != alone:
            apart = np.abs(costs / reference_costs - 1).max()
            bench.notes.append(f"search, {name}, {bench.device}: costs within {apart:.1e} of those one by one")


def add_notes(bench: Bench, case: SearchProblem, result: SearchResult, seconds: dict[str, float]) -> None:
    """Add notes on the size of the search and on the speed of its variants (fastest round)."""
    trace = result.trace
    frames = case.observations.scenario.train_end - 1
    updates = frames * float((trace["springs"] * trace["substeps"]).mean())
    first = next(iter(seconds.values()))
    size = f"mean: {trace['springs'].mean():,.0f} springs and {trace['substeps'].mean():.0f} substeps"
    bench.notes.append(f"search, {bench.device}: {len(trace)} rollouts of {len(case.labels)} nodes over {frames} frames, {size}")
    for name, spent in seconds.items():
        each = f"{1e9 * spent / updates:.1f} ns per spring, substep and candidate, {first / spent:.2f} times as fast"
        bench.notes.append(f"search, {bench.device}, {name}: {each}")


def warm(device: str) -> None:
    """Compile the kernels of a search; they depend on the widths of its groups."""
    widths = (1,) if device != "cpu" else (1, LANE_WIDTH)
    for width in widths:
        made = frame.kernels(wp.float32, width, width == 1)
        frame_kernels = [made.begin, made.substep] if device != "cpu" else [made.forward]
        for kernel in (*frame_kernels, *trials.kernels(width)):
            load(kernel, device)
