"""Errors of twins of the paper's scenes and PhysTwin's released errors, in mm: a table per scene, and errors over time.

    python -m results.published.scenes.make RESULTS --output OUT [--methods ...]

RESULTS is a folder of results with scenarios CASE_points, CASE_film or CASE_both (`results.published.scenes.captures`).
OUT/summary.md contains the tables, OUT/scores.csv a row per run, OUT/CASE.png the errors by frame and by annotated point.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from neuspring.core.artifacts import Observations, Trajectory
from neuspring.core.files import write_text
from neuspring.core.run_folder import RunFolder
from neuspring.core.table import Table
from neuspring.draw.sheet import save
from neuspring.report.blocks import markdown
from neuspring.scores.paper import released
from neuspring.scores.table import collect

CONFIG = Path(__file__).parents[3] / "config"
ROWS = (CONFIG / "rows" / "ours.yaml",)

MM = 1e3
PHYSTWIN = "PhysTwin (released)"
SEEN = {
    "points": "the controllers, 320 nodes and nine annotated points of training frames",
    "film": "one color camera and the controllers; annotated points are only for scores",
    "both": "one color camera, the controllers, 320 nodes and the annotated points of training frames",
}
"""End of the scenario's name -> input of the methods."""
METRICS = {"track_error": "track error", "track_error_bound": "bound track error", "iou": "IoU"}
TASKS = {"reconstruction": "training", "future": "future"}
NOTE = """\
Track errors in mm, as in PhysTwin's evaluation (the nearest node in frame 0), and bound to the surrounding nodes (0 for every
rigid motion). ±: standard deviation over seeds. `..._pooled` saw the training frames of all scenes; `..._unseen` saw those of the
other scenes, and frame 0 and the controllers of this scene. PhysTwin had three RGBD cameras and dense tracks; its numbers are
from its released evaluation of these frames. Our nine annotated points were not compared with the released file."""
UNLEARNED = ("static", "controller_lbs")
"""Methods that learn nothing; their errors would compress the figures."""
COLUMNS = ["case", "saw", "method", "seed", "task", "metric", "value"]


def cases(results: Path) -> dict[str, list[str]]:
    """Case -> inputs of the methods, for the scenarios in a folder of results."""
    found: dict[str, list[str]] = {}
    for path in sorted(results.glob("*/observations.npz")):
        case, _, saw = path.parent.name.rpartition("_")
        if saw in SEEN:
            found.setdefault(case, []).append(saw)
    return found


def scores(results: Path, methods: Sequence[str]) -> pd.DataFrame:
    """One row per run, task and metric (`COLUMNS`), lengths in mm. PhysTwin has the seed -1."""
    rows: list[dict[str, object]] = []
    for case, every in cases(results).items():
        for saw in every:
            folder = results / f"{case}_{saw}"
            seeds = sorted({int(path.name) for path in folder.glob("*/*") if path.name.isdecimal()})
            table = collect(results, [folder.name], methods, seeds).finished
            for run in table[table["metric"].isin(list(METRICS))].itertuples():
                value = (MM if run.unit == "m" else 1.0) * run.value
                rows.append(dict(zip(COLUMNS, (case, saw, run.method, run.seed, run.task, run.metric, value), strict=True)))
        known = released()
        for row in known[(known["scenario"] == case) & (known["metric"] == "track_error")].itertuples():
            rows.append(dict(zip(COLUMNS, (case, "", PHYSTWIN, -1, row.task, row.metric, MM * row.value), strict=True)))
    return pd.DataFrame(rows, columns=COLUMNS)


def tables(scored: pd.DataFrame, methods: Sequence[str]) -> Iterator[str]:
    """A table per case and input, with a row for PhysTwin."""
    pairs = [(metric, task) for metric in METRICS for task in TASKS]
    for (case, saw), part in scored[scored["saw"] != ""].groupby(["case", "saw"], sort=False):
        own = pd.concat([part, scored[(scored["case"] == case) & (scored["saw"] == "")]])
        shown = [pair for pair in pairs if ((own["metric"] == pair[0]) & (own["task"] == pair[1])).any()]
        rows = []
        for method in [*methods, PHYSTWIN]:
            values = own[own["method"] == method]
            if len(values):
                numbers = [values[(values["metric"] == metric) & (values["task"] == task)]["value"] for metric, task in shown]
                rows.append([method, *map(_spread, numbers, shown), "" if method == PHYSTWIN else str(values["seed"].nunique())])
        heads = ["method", *(f"{METRICS[metric]}, {TASKS[task]}" for metric, task in shown), "seeds"]
        yield markdown([Table.of_texts(heads, rows, f"{case}: {SEEN[str(saw)]}")])


def _spread(values: pd.Series, shown: tuple[str, str]) -> str:
    digits = 3 if shown[0] == "iou" else 1
    if values.empty:
        return ""
    text = f"{values.mean():.{digits}f}"
    return f"{text} ± {values.std(ddof=1):.{digits}f}" if len(values) > 1 and values.std(ddof=1) > 0 else text


def curves(results: Path, case: str, saw: str, methods: Sequence[str]) -> Figure:
    """Errors of the annotated points, mm: mean by frame, and each point in the future; means over seeds of methods that learn."""
    methods = [method for method in methods if method not in UNLEARNED]
    observed = Observations.load(results / f"{case}_{saw}" / "observations.npz")
    tracks, end = observed.tracks.astype(float), observed.scenario.train_end
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.0), layout="constrained", width_ratios=(1.5, 1))
    for number, method in enumerate(methods):
        errors = []
        for folder in sorted((results / f"{case}_{saw}" / method).glob("*")):
            run = RunFolder.of(folder)
            trajectory = run.trajectory
            if trajectory is not None:
                errors.append(MM * point_errors(trajectory, tracks))
        if not errors:
            continue
        mean, color = np.mean(errors, axis=0), f"C{number}"
        seen = np.isfinite(mean).sum(axis=1)
        by_frame = np.where(seen > 0, np.nansum(mean, axis=1) / np.maximum(seen, 1), np.nan)
        left.plot(by_frame, color=color, lw=1.3, label=method)
        later = mean[end:]
        known = np.isfinite(later).any(axis=0)
        places = np.flatnonzero(known) + (number - len(methods) / 2) * 0.8 / len(methods)
        right.bar(places, np.nanmean(later[:, known], axis=0), width=0.8 / len(methods), color=color)
    known_errors = released()
    for row in known_errors[(known_errors["scenario"] == case) & (known_errors["metric"] == "track_error")].itertuples():
        span = (0, end) if row.task == "reconstruction" else (end, len(tracks) - 1)
        label = f"{PHYSTWIN}, mean" if row.task == "future" else None
        left.plot(span, [MM * row.value] * 2, color="k", ls="--", lw=1.0, label=label)
    left.axvspan(end, len(tracks) - 1, color="tab:orange", alpha=0.12, lw=0, label="future")
    left.set(xlabel="frame", ylabel="track error [mm]", xlim=(0, len(tracks) - 1), ylim=(0, None))
    right.set(xlabel="annotated point, mean over the future", xticks=range(tracks.shape[1]), ylim=(0, None))
    for axis in (left, right):
        axis.grid(axis="y", color="0.92")
        axis.set_axisbelow(True)
    left.legend(frameon=False, fontsize=8)
    figure.suptitle(f"{case}: {SEEN[saw]}", fontsize=9)
    return figure


def point_errors(trajectory: Trajectory, tracks: np.ndarray) -> np.ndarray:
    """Error [T, K], m, of each track [T, K, 3] from the node that is nearest in frame 0; NaN without annotation."""
    from scipy.spatial import cKDTree

    positions, first = trajectory.positions.astype(float), np.isfinite(tracks[0]).all(axis=1)
    nearest = np.zeros(tracks.shape[1], int)
    nearest[first] = cKDTree(positions[0]).query(tracks[0, first])[1]
    errors = np.linalg.norm(positions[:, nearest] - tracks[: len(positions)], axis=2)
    errors[:, ~first] = np.nan
    missing = np.full((len(tracks) - len(errors), errors.shape[1]), np.nan)
    return np.concatenate([errors, missing])


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--methods", nargs="+", help="default: all with runs, in the order of config/methods.yaml")
    a = parser.parse_args()
    from neuspring.experiments.benchmark import read_methods

    found = {path.name for path in a.results.glob("*/*") if any(path.glob("*/run.json"))}
    methods = a.methods or [name for name in read_methods(CONFIG / "methods.yaml", ROWS) if name in found]
    scored = scores(a.results, methods)
    a.output.mkdir(parents=True, exist_ok=True)
    write_text(a.output / "scores.csv", scored.to_csv(index=False, float_format="%.4f"))
    lines = ["# The paper's own scenes, in millimeters", NOTE, *tables(scored, methods)]
    write_text(a.output / "summary.md", "\n\n".join(lines) + "\n")
    for case, every in cases(a.results).items():
        for saw in every:
            save(curves(a.results, case, saw, methods), a.output / f"{case}_{saw}.png")
    print(a.output / "summary.md")


if __name__ == "__main__":
    main()
