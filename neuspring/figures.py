"""Pictures of a run: error over time, losses, and predicted against observed points."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from neuspring.artifacts import Observations, Trajectory, write_atomically
from neuspring.metrics import chamfer_per_frame, track_error_per_frame

DPI = 110


def run_figures(
    observations: Observations, trajectory: Trajectory | None, histories: Mapping[str, pd.DataFrame], method: str, folder: Path
) -> list[Path]:
    """Draw what a run has: errors.png and motion.png (with a trajectory), losses.png (with a history). Returns the files."""
    title = f"{observations.scenario.name}, {method}"
    made = []
    if trajectory is not None:
        made.append(_save(_errors(observations, trajectory, title), folder / "errors.png"))
        made.append(_save(_motion(observations, trajectory, title), folder / "motion.png"))
    if histories:
        made.append(_save(_losses(histories, title), folder / "losses.png"))
    return made


def _save(figure: Figure, path: Path) -> Path:
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=DPI, format="png"))
    plt.close(figure)
    return path


def _errors(observations: Observations, trajectory: Trajectory, title: str) -> Figure:
    figure, axis = plt.subplots(figsize=(7, 3.2), layout="constrained")
    seconds = np.arange(len(trajectory.positions)) / observations.scenario.frame_rate
    for label, values, colour in (
        ("track error (Euclidean)", track_error_per_frame(trajectory.positions, observations), "tab:blue"),
        ("Chamfer distance (L1)", chamfer_per_frame(trajectory.positions, observations), "tab:orange"),
    ):
        axis.plot(seconds, 1e3 * values, label=label, color=colour)
    split = observations.scenario.train_end / observations.scenario.frame_rate
    axis.axvspan(split, observations.scenario.frame_count / observations.scenario.frame_rate, color="0.92", label="future")
    axis.set(xlabel="time [s]", ylabel="error [mm]", title=title, ylim=(0, None), xlim=(0, None))
    axis.legend(frameon=False)
    return figure


def _losses(histories: Mapping[str, pd.DataFrame], title: str) -> Figure:
    figure, axes = plt.subplots(1, len(histories), figsize=(3.6 * len(histories) + 1, 3.2), layout="constrained", squeeze=False)
    for axis, (stage, history) in zip(axes[0], histories.items(), strict=True):
        for metric in ("cost", "best_cost", "loss"):
            rows = history[history["metric"] == metric]
            if len(rows):
                axis.plot(rows["step"], rows["value"], ".", ms=3) if metric == "cost" else axis.plot(
                    rows["step"], rows["value"], label=metric.replace("_", " ")
                )
        best = history.loc[history["metric"].isin(["best_cost", "loss"]), "value"]
        axis.set(
            yscale="log",
            xlabel="rollout" if stage == "search" else "epoch",
            ylabel="training cost" if stage == "search" else "training loss [m$^2$]",
            title=stage,
        )
        if stage == "search":
            # Diverged candidates carry a penalty far above the picture.
            axis.set_ylim(best.min() / 1.5, min(best.max(), 1e3) * 3)
    figure.suptitle(title)
    return figure


def _motion(observations: Observations, trajectory: Trajectory, title: str) -> Figure:
    """Observed points over predicted nodes at rest, at the split, and at the end, seen from the side with most extent."""
    last = len(trajectory.positions) - 1
    chosen = sorted({0, min(observations.scenario.train_end - 1, last), last})
    spread = np.ptp(observations.nodes, axis=0)
    across = 0 if spread[0] >= spread[1] else 1
    flip = 1.0 if observations.scenario.up == "+z" else -1.0
    figure, axes = plt.subplots(1, len(chosen), figsize=(3.4 * len(chosen), 3.4), layout="constrained", sharex=True, sharey=True)
    for axis, frame in zip(np.atleast_1d(axes), chosen, strict=True):
        _scatter(axis, trajectory.positions[frame], across, flip, s=4, color="0.6", label="predicted nodes")
        seen = observations.object_points[frame][observations.object_visibility[frame]]
        _scatter(axis, seen, across, flip, s=6, color="tab:blue", label="observed points")
        _scatter(axis, observations.controller_points[frame], across, flip, s=14, color="tab:red", label="controllers")
        part = "training" if frame < observations.scenario.train_end else "future"
        axis.set(title=f"frame {frame} ({part})", xlabel="xy"[across] + " [m]", aspect="equal")
    np.atleast_1d(axes)[0].set_ylabel("height [m]")
    np.atleast_1d(axes)[0].legend(frameon=False, fontsize=7)
    figure.suptitle(title)
    return figure


def _scatter(axis: Any, points: np.ndarray, across: int, flip: float, **style: Any) -> None:
    axis.scatter(points[:, across], flip * points[:, 2], linewidths=0, **style)
