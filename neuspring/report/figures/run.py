"""Figures of a run: errors over time, losses, predicted against observed points, and the twin (`figures.twin`)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from neuspring.core.artifacts import Observations, Scenario, Trajectory, Twin
from neuspring.report.figures.twin import CONTROLLER, stiffness_figure, topology_figure
from neuspring.report.figures.views import View, limits, point_size, readable, sample, save, side_view, widest_axis
from neuspring.scores.metrics import PICTURES, errors_per_frame, track_error_per_frame

NAMES = ("errors.png", "motion.png", "losses.png", "topology.png", "stiffness.png")
IMAGE_SCORES = "image_scores.png"
MM = 1e3
PANEL, HEIGHTS = 3.1, (1.1, 3.1)
"""Width of a panel of motion.png, and the least and greatest height, inches."""
MOST_ERRORS = 400
"""More error lines than this in one panel would hide the points."""
LOG_FROM = 3.0
"""A loss has a log axis if its largest value is at least this many times its smallest."""
SERIES = {
    "search": (("cost", "candidates"), ("best_cost", "best so far")),
    "fit": (("loss", "frames trained on"), ("tail_loss", "held-back frames")),
    "train": (("loss", "training loss"),),
}
"""Stage to the metrics of its history that are drawn, and their labels."""
AXES = {"search": ("rollout", "training cost"), "fit": ("epoch", "loss [m$^2$]"), "train": ("step", "loss")}
"""Stage to the labels of its axes. Baselines train by epochs or iterations, on squared distances or silhouettes."""


def run_figures(
    observations: Observations,
    trajectory: Trajectory | None,
    histories: Mapping[str, pd.DataFrame],
    method: str,
    folder: Path,
    *,
    twin: Twin | None = None,
    searched: float | None = None,
) -> list[Path]:
    """Draw the figures of a run, and return the files.

    errors.png and motion.png need a trajectory, losses.png a history, topology.png and stiffness.png the run's last twin.
    `searched` is the homogeneous stiffness that the search found, N, marked among the twin's.
    """
    title = f"{observations.scenario.name}, {method}"
    paths = []
    # A picture of an earlier result must not stay beside this one's.
    for name in (*NAMES, IMAGE_SCORES):
        (folder / name).unlink(missing_ok=True)
    if trajectory is not None and len(trajectory.positions):
        paths.append(save(_errors(observations, trajectory, title), folder / "errors.png"))
        paths.append(save(_motion(observations, trajectory, title), folder / "motion.png"))
    if histories:
        paths.append(save(_losses(histories, title), folder / "losses.png"))
    if twin is not None:
        paths.append(save(topology_figure(twin, title), folder / "topology.png"))
        if twin.topology.object_spring_count:
            paths.append(save(stiffness_figure(twin, searched, title), folder / "stiffness.png"))
    return paths


def _errors(observations: Observations, trajectory: Trajectory, title: str) -> Figure:
    figure, axis = plt.subplots(figsize=(7, 3.2), layout="constrained")
    seconds = np.arange(len(trajectory.positions)) / observations.scenario.frame_rate
    values = errors_per_frame(trajectory.positions, observations)
    for metric, label, color in (
        ("track_error", "track error (Euclidean)", "tab:blue"),
        ("track_error_bound", "track error of bound points", "tab:green"),
        ("chamfer", "Chamfer distance (L1)", "tab:orange"),
    ):
        axis.plot(seconds, MM * values[metric], label=label, color=color)
    split = observations.scenario.train_end / observations.scenario.frame_rate
    axis.axvspan(split, observations.scenario.frame_count / observations.scenario.frame_rate, color="0.92", label="future")
    axis.set(xlabel="time [s]", ylabel="error [mm]", title=title, ylim=(0, None), xlim=(0, None))
    axis.legend(frameon=False)
    return figure


def image_scores_figure(frames: pd.DataFrame, scenario: Scenario, method: str, folder: Path) -> Path:
    """Draw image_scores.png: every metric of pictures over time, from rows frame, camera, metric, value; returns the file."""
    shown = [metric for metric in PICTURES if metric.name in set(frames["metric"])]
    figure, axes = plt.subplots(
        len(shown), 1, figsize=(7, 1.5 * len(shown) + 0.8), layout="constrained", sharex=True, squeeze=False
    )
    for axis, metric in zip(axes[:, 0], shown, strict=True):
        values = frames[frames["metric"] == metric.name].groupby("frame")["value"].mean()
        axis.plot(values.index / scenario.frame_rate, values, color="tab:blue")
        axis.axvspan(scenario.train_end / scenario.frame_rate, scenario.frame_count / scenario.frame_rate, color="0.92")
        axis.set(ylabel=metric.label, xlim=(0, None))
    axes[0, 0].set_title(f"{scenario.name}, {method} (gray: future)")
    axes[-1, 0].set_xlabel("time [s]")
    return save(figure, folder / IMAGE_SCORES)


def _losses(histories: Mapping[str, pd.DataFrame], title: str) -> Figure:
    figure, axes = plt.subplots(1, len(histories), figsize=(3.6 * len(histories) + 1, 3.2), layout="constrained", squeeze=False)
    for axis, (stage, history) in zip(axes[0], histories.items(), strict=True):
        search = stage == "search"
        for metric, label in SERIES[stage]:
            rows = history[history["metric"] == metric]
            if len(rows):
                single = "." if metric == "cost" or len(rows) == 1 else ""
                axis.plot(rows["step"], rows["value"], ls="" if metric == "cost" else "-", marker=single, ms=4, label=label)
        axis.set(title=stage, xlabel=AXES[stage][0], ylabel=AXES[stage][1])
        _scale(axis, history, search)
        if axis.lines:
            axis.legend(frameon=False, fontsize=8)
    figure.suptitle(title)
    return figure


def _scale(axis: Axes, history: pd.DataFrame, search: bool) -> None:
    """A log axis where values span a factor of `LOG_FROM`. A search axis leaves out candidates that could not be simulated."""
    values = history.loc[history["metric"].isin(["best_cost"] if search else ["loss", "tail_loss"]), "value"]
    low, high = (values.min(), values.max()) if len(values) else (np.nan, np.nan)
    if low > 0 and (search or high >= LOG_FROM * low):
        axis.set_yscale("log")
    else:
        axis.set_ylim(0, None)
        axis.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3))
    if search and low > 0:
        # Diverged candidates carry a penalty far above the picture.
        axis.set_ylim(low / 1.5, min(high, 1e3) * 3)


def chosen_frames(scenario: Scenario, frames: int) -> dict[int, str]:
    """Frames to show, in order, and their names. The trajectory has `frames` frames; it diverged if the scenario has more."""
    last = scenario.frame_count - 1
    # Where two fall together the later entry names the frame.
    named = {
        (scenario.train_end + last) // 2: "middle of the future",
        last: "last frame",
        scenario.train_end - 1: "end of training",
        0: "start",
    }
    shown = {frame: name for frame, name in named.items() if frame < frames}
    if frames <= last:
        shown.setdefault(frames - 1, "last before divergence")
    return dict(sorted(shown.items()))


def _motion(observations: Observations, trajectory: Trajectory, title: str) -> Figure:
    """Predicted nodes, observed points and the error of each, in two side views (rows) of a few frames (columns)."""
    frames = chosen_frames(observations.scenario, len(trajectory.positions))
    first = widest_axis(observations.nodes)
    views = [side_view(axis, observations.scenario.up) for axis in (first, 1 - first)]
    shown = _shown_points(observations, trajectory, list(frames))
    bounds, heights = zip(*(_panel(view.project(shown)) for view in views), strict=True)
    size = ((PANEL + 0.35) * len(frames) + 0.5, sum(heights) + 2.1)
    figure, axes = plt.subplots(
        2, len(frames), figsize=size, layout="constrained", sharex="row", sharey="row", squeeze=False, height_ratios=heights
    )
    errors = track_error_per_frame(trajectory.positions, observations)
    for row, view, bound in zip(axes, views, bounds, strict=True):
        for axis, frame in zip(row, frames, strict=True):
            _draw_frame(axis, view, observations, trajectory, frame)
            axis.set(xlabel=view.labels[0], aspect="equal", xlim=bound[:, 0], ylim=bound[:, 1])
        row[0].set_ylabel(view.labels[1])
    for axis, (frame, name) in zip(axes[0], frames.items(), strict=True):
        axis.set_title(f"frame {frame}: {name}\n{_error_text(observations, errors, frame)}", fontsize=9)
    handles, names = axes[0][0].get_legend_handles_labels()
    readable(figure.legend(handles, names, loc="outside lower center", ncols=len(names), frameon=False, fontsize=8))
    ended = "" if trajectory.diverged_frame is None else f"; diverged in frame {trajectory.diverged_frame}"
    figure.suptitle(title + ended, fontsize=11)
    return figure


def _shown_points(observations: Observations, trajectory: Trajectory, frames: list[int]) -> np.ndarray:
    """Points [P, 3], m, that a figure of these frames must show: all observed ones, and predicted ones near them."""
    seen = [observations.object_points[frame][observations.object_visibility[frame]] for frame in frames]
    real = np.concatenate([*seen, *observations.controller_points[frames], observations.nodes])
    # A prediction far away (before it diverges) must not shrink everything else to a dot.
    reach = 0.5 * np.ptp(real, axis=0).max()
    near = np.clip(trajectory.positions[frames].reshape(-1, 3), real.min(axis=0) - reach, real.max(axis=0) + reach)
    return np.concatenate([real, near])


def _panel(flat: np.ndarray) -> tuple[np.ndarray, float]:
    """Limits [2, 2], m, and height, inches, of a panel of a fixed width that holds picture points [P, 2] at equal aspect."""
    low, high = limits(flat)
    span = np.maximum(high - low, 1e-6)
    height = float(np.clip(PANEL * span[1] / span[0], *HEIGHTS))
    half = 0.5 * np.array([PANEL, height]) / min(PANEL / span[0], height / span[1])
    middle = 0.5 * (low + high)
    return np.array([middle - half, middle + half]), height


def _draw_frame(axis: Axes, view: View, observations: Observations, trajectory: Trajectory, frame: int) -> None:
    predicted = view.project(trajectory.positions[frame])
    seen = observations.object_visibility[frame]
    observed = view.project(observations.object_points[frame][seen])
    # Node i is tracked point i.
    pairs = np.stack([observed, predicted[: len(seen)][seen]], axis=1)
    small = point_size(len(predicted))
    _scatter(axis, predicted, s=small, color="0.72", label="predicted nodes", zorder=1)
    some = f" (a random {MOST_ERRORS})" if len(pairs) > MOST_ERRORS else ""
    lines = list(pairs[sample(len(pairs), MOST_ERRORS)])
    axis.add_collection(LineCollection(lines, colors="0.3", linewidths=0.7, label=f"observed to predicted{some}", zorder=3))
    _scatter(axis, observed, s=point_size(len(observed)), color="tab:blue", label="observed points", zorder=2)
    hands = view.project(observations.controller_points[frame])
    _scatter(axis, hands, s=14, marker="D", color=CONTROLLER, label="controllers", zorder=4)
    axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.tick_params(labelsize=8)


def _error_text(observations: Observations, errors: np.ndarray, frame: int) -> str:
    """The track error of a frame in words. Unlike the metric, it is not 0 for a frame without annotation."""
    annotated = ~np.isnan(observations.tracks[frame]).any(axis=1) & ~np.isnan(observations.tracks[0]).any(axis=1)
    return f"track error {MM * errors[frame]:.1f} mm" if annotated.any() else "no annotated track"


def _scatter(axis: Axes, points: np.ndarray, **style: Any) -> None:
    axis.scatter(points[:, 0], points[:, 1], linewidths=0, **style)
