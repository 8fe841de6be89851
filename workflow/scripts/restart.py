"""Where the error of the future comes from: twins restarted from what was observed at the split.

python workflow/scripts/restart.py RESULTS_FOLDER DATA_SET METHOD [METHOD ...]

The workflow's rollout carries what went wrong in all training frames into the future. Here the same twin starts again in the
first frame after the split, with nodes and velocities made from the markers there as in frame 0; what is left is the model's
own error over as many frames. RESULTS_FOLDER must have been made with config/data/mocap.yaml.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pandas as pd

from neuspring import config
from neuspring.core.artifacts import Observations, Twin
from neuspring.data import mocap
from neuspring.experiments.benchmark import Benchmark, fit_of
from neuspring.scores import metrics
from neuspring.twin.motion import initial_velocity
from neuspring.twin.rollout import roll_out
from neuspring.twin.transfer import rebase

ROOT = Path(__file__).resolve().parents[2]


def benchmark_of(data_set: Path, methods: list[str]) -> Benchmark:
    """The study of config/data/mocap.yaml, on its own scenarios alone."""
    values = config.read_yaml(ROOT / "config/config.yaml")
    config.merge(values, config.read_yaml(ROOT / "config/data/mocap.yaml"))
    config.merge(values, {"methods": methods, "compare_with": None, "data_root": str(data_set), "transfers": None})
    return Benchmark.of(values, ROOT)


def restarted(benchmark: Benchmark, observations: Observations) -> Observations:
    """The same recording from its first frame after the split on."""
    name, settings = observations.scenario.name, benchmark.config.mocap
    file = benchmark.data_path(name)
    assert file is not None
    start = settings.start + settings.stride * observations.scenario.train_end
    return mocap.read(benchmark.scenarios[name], file, replace(settings, start=start))


def scores(results: Path, benchmark: Benchmark, name: str, method: str, seed: int) -> pd.DataFrame:
    """The workflow's scores of one run, and those of its restarted twin (task `restarted`)."""
    again = restarted(benchmark, Observations.load(results / name / "observations.npz"))
    row = benchmark.methods[method]
    folder = benchmark.fit_of_method[method] if row.fit else f"search-{row.searched}"
    trained = bool(row.fit and fit_of(benchmark.config, row, method).rest_length_bound)
    twin = rebase(Twin.load(results / name / folder / str(seed) / "twin.npz"), again, keep_lengths=trained)
    velocity = initial_velocity(again, twin.simulation.initial_velocity)
    trajectory = roll_out(twin, again.controller_points, "cpu", velocity=velocity)
    frames = range(1, again.scenario.frame_count)
    original = pd.read_parquet(results / name / method / str(seed) / "scores.parquet")
    return pd.concat([original, metrics.score_tasks(trajectory, again, method, seed, {"restarted": frames})])


def main(results: Path, data_set: Path, methods: list[str]) -> None:
    """Print the mean track error of every method over training frames, the future, and the future from a restart, mm."""
    benchmark = benchmark_of(data_set, methods)
    runs = [(n, m, s) for n in benchmark.config.scenarios for m in methods for s in benchmark.config.seeds]
    runs = [(n, m, s) for n, m, s in runs if (results / n / m / str(s) / "scores.parquet").exists()]
    if not runs:
        raise SystemExit(f"{results}: no SCENARIO/METHOD/SEED/scores.parquet here; run the workflow first")
    table = pd.concat([scores(results, benchmark, *run) for run in runs], ignore_index=True)
    table = table[table["metric"] == "track_error"].assign(mm=1e3 * table["value"])
    tasks = ["reconstruction", "future", "restarted"]
    each = table.pivot_table(index=["scenario", "method"], columns="task", values="mm", sort=False)[tasks]
    print(each.round(1).to_string(), end="\n\n")
    print(each.groupby("method", sort=False).mean().round(2).to_string())
    print(f"{len(runs)} runs")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])
