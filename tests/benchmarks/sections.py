"""The sections of the table: what is measured, and in which company."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuspring.core.artifacts import Twin
from neuspring.twin.fit import fit
from neuspring.twin.search import search
from tests.benchmarks.crowds import GENERATION, by_batch, by_topologies, of_search, softer
from tests.benchmarks.memory import growth
from tests.benchmarks.ours import Ours, reference_frame
from tests.benchmarks.plush import observations, problem
from tests.benchmarks.rows import KINDS, Bench, Entry, agree, frame_of, timed
from tests.benchmarks.scenes import CASES, box, sheet, shortened
from tests.benchmarks.simulators import Simulator, Times, distances
from tests.benchmarks.table import Row
from tests.benchmarks.tracking import by_runs
from tests.support import small

TOGETHER = 16
"""Twins of one call in the first section: the lanes of a vector."""
EVERY_MULTIPROCESSOR = 132
"""Twins of one call that fill an H100 or H200 with blocks."""
TALKING = """import logging, sys
from neuspring.cli.main import main
from neuspring.core import device
device.start_warp()
device.wp.config.log_level = logging.INFO
sys.exit(main())"""
"""The program whose Warp says which modules it compiled and which it found."""


def frames(bench: Bench) -> list[Row]:
    """A frame of two boxes: one twin alone, several together, the peer, and on a CPU the specification of the small one."""
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
        if bench.on_gpu:
            yield Entry(f"{alone}, a block", twin, frame_of(bench.blocks, twin, hands, gradient), alone)
            for count in (TOGETHER, EVERY_MULTIPROCESSOR):
                crowd = bench.blocks.together(softer(twin, count), hands, gradient=gradient)
                yield Entry(f"{alone}, {count} blocks", twin, crowd, alone, count)
        if bench.peer:
            yield Entry(f"{alone}, {bench.peer.name}", twin, frame_of(bench.peer, twin, hands, gradient), alone)


def by_nodes(bench: Bench) -> list[Row]:
    """More nodes of a box."""
    sizes = (500, 5_000) if bench.quick else (500, 1_000, 2_000, 5_000, 10_000, 20_000, 50_000)
    return _scaling(bench, "nodes", [(f"{size:,} nodes", box(size, 20, 22)) for size in sizes])


def by_neighbors(bench: Bench) -> list[Row]:
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
    for kind, gradient in KINDS:
        entries = [Entry(f"{name}, {kind}", twin, frame_of(bench.ours, twin, hands, gradient)) for name, (twin, hands) in scenes]
        rows += timed(bench, section, [entries[0], *(replace(entry, reference=entries[0].name) for entry in entries[1:])])
    return rows


def by_contacts(bench: Bench) -> list[Row]:
    """A sheet folded onto itself, with self-collision; a note says how time grows with the nodes."""
    rows: list[Row] = []
    grown: dict[str, list[Row]] = {}
    for size in (2_000,) if bench.quick else (2_000, 4_300, 8_600):
        twin, hands = sheet(size, 67)
        for row in timed(bench, "collision", list(_company(bench, f"sheet of {size:,}", twin, hands))):
            rows.append(row)
            grown.setdefault(row.name.partition(": ")[2], []).append(row)
        if bench.peer:
            _touch_alike(bench, bench.peer, twin, hands)
    for name, its in grown.items():
        if len(its) > 1:
            bench.notes.append(f"collision, {name}, {bench.device}: time grows as nodes to the power of {exponent(its):.2f}")
    return rows


def exponent(rows: Sequence[Row]) -> float:
    """p of least time ~ nodes^p, by least squares of the logarithms."""
    return float(np.polyfit(np.log([row.nodes for row in rows]), np.log([row.least for row in rows]), 1)[0])


def _touch_alike(bench: Bench, peer: Simulator, twin: Twin, hands: np.ndarray) -> None:
    """Note how many nodes agree after a part of a frame. Rounding decides whether two nodes just touch, and contacts amplify it."""
    substeps, tolerance = 15, 1e-7
    pair = [frame_of(simulator, shortened(twin, substeps), hands, False) for simulator in (bench.ours, peer)]
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
    rows = [rows[0], replace(rows[1], ratio=every / between, reference=first)] if between > 0 else rows
    for name, run in () if bench.quick else WORKS.items():
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
            rise, nodes = process.submit(run, bench.device).result()
        rows.append(Row(section="memory", name=name, device=bench.device, nodes=nodes, median=rise, least=rise, unit="MiB"))
    return rows


def memory_of_search(device: str) -> tuple[float, int]:
    """MiB by which memory rises during a search of the plush, and its nodes."""
    case = problem(4 * GENERATION, device)
    return growth(lambda: search(case, 0), device), len(case.labels)


def memory_of_fit(device: str) -> tuple[float, int]:
    """The same of a fit of the plush, three epochs."""
    case = small.fit_problem(observations(), device=device)
    return growth(lambda: fit(case), device), len(case.twin.topology.nodes)


def memory_of_cloths(device: str) -> tuple[float, int]:
    """The same of a frame and its gradient of TOGETHER cloths of full size with self-collision."""
    twin, hands = sheet(8_600, 67)
    ours, twins = Ours(device), softer(twin, TOGETHER)
    return growth(lambda: ours.together(twins, hands, gradient=True).run(), device), len(twin.topology.nodes)


WORKS = {
    "search of a plush": memory_of_search,
    "fit of a plush": memory_of_fit,
    f"gradient of a frame of {TOGETHER} cloths": memory_of_cloths,
}
"""Work whose memory is measured, each in a process of its own."""


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
    """A rollout of a tiny scene from start to end, whose own work is negligible: alone, and 16 at once, first without kernels.

    On the CPU alone.
    """
    if bench.device != "cpu":
        return []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        command = _tiny_rollout(folder)
        times = []
        for _ in range(1 if bench.quick else 3):
            begin = time.perf_counter()
            run = [sys.executable, "-m", "neuspring", *command, str(folder / "alone.json")]
            subprocess.run(run, check=True, capture_output=True)
            times.append(time.perf_counter() - begin)
        found = {"a job alone": Times(tuple(times))}
        if not bench.quick:
            for name in ("16 jobs at once, no kernels yet", "16 jobs at once"):
                seconds, text = _crowd(folder, command, 16)
                found[name] = Times((seconds,))
                counts = f"{text.count('(compiled)')} kernels compiled, {text.count('(cached)')} found in the cache"
                bench.notes.append(f"{name}: {counts}")
    more = {"device": "cpu", "unit": "s"}
    return [Row(section="start", name=name, median=its.median, least=its.least, **more) for name, its in found.items()]


def _tiny_rollout(folder: Path) -> list[str]:
    """The command line of a rollout of a tiny scene, which is made here, but for its output."""
    (folder / "settings.yaml").write_text(json.dumps({"toy": {"frames": 5}, "search": {"rollouts": 2}}))
    options = ["--settings", str(folder / "settings.yaml")]
    observations, search = folder / "observations.npz", folder / "search.json"
    observe = ["observe", "--scenario", "toy_rope_lift_smooth", *options, "--output", str(observations)]
    find = ["search", "--observations", str(observations), *options, "--device", "cpu", "--output", str(search)]
    for command in (observe, find):
        subprocess.run([sys.executable, "-m", "neuspring", *command], check=True, capture_output=True)
    return ["rollout", "--observations", str(observations), "--learned", str(search), "--device", "cpu", "--output"]


def _crowd(folder: Path, command: list[str], jobs: int) -> tuple[float, str]:
    """Seconds until all jobs that start at once with an empty kernel cache have ended, and what they printed."""
    environment = os.environ | {"WARP_CACHE_PATH": str(folder / "cache")}
    begin = time.perf_counter()
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", TALKING, *command, str(folder / f"{index}.json")],
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )
        for index in range(jobs)
    ]  # fmt: skip
    outputs = [process.communicate()[0] for process in processes]
    assert all(process.returncode == 0 for process in processes), outputs[0]
    return time.perf_counter() - begin, "".join(outputs)


SECTIONS: dict[str, Callable[[Bench], list[Row]]] = {
    "frame": frames,
    "nodes": by_nodes,
    "springs": by_neighbors,
    "substeps": by_substeps,
    "batch": by_batch,
    "topologies": by_topologies,
    "search": of_search,
    "collision": by_contacts,
    "memory": memory,
    "start": start,
    "tracking": by_runs,
}
ON_CUDA = ("frame", "batch", "topologies", "search", "collision")
"""Sections of a run on CUDA, which is to end within two minutes; the others on demand."""
