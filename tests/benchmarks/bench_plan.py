"""Does the plan predict? `python -m tests.benchmarks.bench_plan RESULTS [--spacing 0.01]`, RESULTS made with config/data/toy.yaml.

First each toy job is predicted from the rates of the other scenes. Then the rates of all predict a search and a fit of a cloth with
a node every `spacing` meters: from its settings alone, and from the springs and substeps that turned out. Both run here, in one
thread. Their seconds are those of the CPU, so that other work on the machine counts less.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from neuspring import config
from neuspring.config import Config, ScenarioRow
from neuspring.core.job_records import SPRING_UPDATES, read_jobs
from neuspring.core.records import StageRecord
from neuspring.data.expected import Expected
from neuspring.data.synthetic import toy
from neuspring.experiments.benchmark import Benchmark
from neuspring.experiments.needs import Needs
from neuspring.experiments.plan import History
from neuspring.experiments.size import expected_size
from neuspring.stages import fit, observe, search
from tests.support.project import ROOT

FRAMES, ROLLOUTS, EPOCHS = 30, 22, 5
SIDE = 0.28


def cloth(spacing: float) -> toy.Shape:
    """The toy cloth with other distances between its nodes."""
    whole, count = toy.cloth(), round(SIDE / spacing) + 1
    across, down = np.meshgrid(np.linspace(-0.14, 0.14, count), np.linspace(0.4, 0.12, count), indexing="ij")
    nodes = np.stack([across.ravel(), np.zeros(across.size), down.ravel()], axis=1)
    seen = np.add.outer(np.arange(count), np.arange(count)).ravel() % 2 == 0
    return replace(whole, tracked=nodes[seen], surface=nodes[~seen], radius=2.25 * spacing)


def toys(results: Path) -> None:
    """Print expected over actual seconds of each toy job, from the median rate of the other scenes: median and range."""
    values = config.read_yaml(ROOT / "config" / "config.yaml")
    config.merge(values, config.read_yaml(ROOT / "config" / "data" / "toy.yaml"))
    jobs = [job for job in read_jobs(results) if job.unit]
    with tempfile.TemporaryDirectory() as empty:
        needs = Needs(Benchmark.of(values | {"results": empty}, ROOT), "cpu")
        for rule in ("search", "fit", "rollout"):
            settings, counts = [], []
            for job in (each for each in jobs if each.rule == rule):
                others = [each for each in jobs if each.rule == rule and each.scenario != job.scenario]
                rate = statistics.median(each.last.seconds / each.work for each in others)
                _, scenario, name, _ = job.name.split("/")
                work, _ = needs.amount(rule, SimpleNamespace(scenario=scenario, search=name, method=name))
                settings.append(rate * (work or 0.0) / job.last.seconds)
                counts.append(rate * job.work / job.last.seconds)
            texts = (f"{statistics.median(each):.2f} ({min(each):.2f} to {max(each):.2f})" for each in (settings, counts))
            print(f"toy {rule}, {len(counts)} jobs: {' from the settings, '.join(texts)} from the counts")


def main() -> None:
    """Print predicted and actual seconds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path)
    parser.add_argument("--spacing", type=float, default=0.01)
    a = parser.parse_args()
    torch.set_num_threads(1)
    toys(a.results)
    rates = History.of(a.results).rates
    shape = cloth(a.spacing)
    toy.SHAPES["dense"] = lambda: shape
    # Radii go with the distance between nodes, as in config/data/toy.yaml.
    radius = 2.25 * a.spacing
    values = {
        "search": {
            "rollouts": ROLLOUTS,
            "ranges": {"object_radius": [a.spacing / 2, 2.5 * a.spacing]},
            "start": {"object_radius": radius, "stiffness": 1e4},
        },
        "fit": {"epochs": EPOCHS},
        "toy": {"frames": FRAMES},
    }
    settings = config.parse(Config, values, "bench_plan")
    nodes = len(shape.tracked) + len(shape.surface)
    body = Expected(nodes=nodes, spacing=a.spacing, frames=FRAMES, controllers=len(shape.hands))
    springs, substeps = expected_size(body, settings.search, settings.simulation)
    print(f"{nodes} nodes; from the settings {springs:.0f} springs, {substeps:.0f} substeps")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        row = ScenarioRow(
            scenario="dense", source="toy", category="cloth", path="dense/shake/smooth", self_collision=False, ground=True
        )
        observe.run(row, settings, folder / "observations.npz")
        (folder / "search").mkdir()
        (folder / "fit").mkdir()
        train = int(toy.TRAIN_FRACTION * FRAMES) - 1
        for stage, count in (("search", ROLLOUTS), ("fit", EPOCHS)):
            record = folder / stage / f"{stage}.json"
            clock = time.process_time()
            if stage == "search":
                search.run(folder / "observations.npz", settings, 1, 0, "cpu", record)
            else:
                fit.run(folder / "observations.npz", folder / "search" / "search.json", settings, "springs", "cpu", record)
            seconds = time.process_time() - clock
            facts = StageRecord.load(record).facts
            rate = rates[stage, "cpu", ""]
            planned = rate * count * train * springs * substeps / 1e9
            counted = rate * facts[SPRING_UPDATES] / 1e9
            print(
                f"{stage}: {facts['springs']} springs, {facts['substeps']} substeps; {seconds:.1f} s. Expected: {planned:.1f} s"
                f" ({planned / seconds:.2f}) from the settings, {counted:.1f} s ({counted / seconds:.2f}) from these counts"
            )


if __name__ == "__main__":
    main()
