"""Figures of a run: errors over time, losses, predicted against observed points, and the twin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from neuspring.core.artifacts import Observations, Scenario, Trajectory, Twin
from neuspring.draw.painter import DrawingStyle, Painter
from neuspring.draw.scene import ShownRun, ShownScene, chosen_frames
from neuspring.draw.sheet import place, save
from neuspring.draw.strip import strip_figure
from neuspring.draw.twin import LEGEND_ROOM, TwinPicture, histogram, twin_figure
from neuspring.scores.metrics import errors_per_frame, metrics_of
from neuspring.twin.body import lines_of

RUN_FIGURES = ("errors.png", "motion.png", "losses.png", "topology.png", "stiffness.png")
IMAGE_SCORES = "image_scores.png"
PLOTTED_MM = 1e3
RUN_WIDTH, COUNTED_LEGEND, HISTOGRAM, FOOT = 10.0, 1.9, 3.4, 0.8
"""Width of figures of motion and twins, of a legend with counts, of the histogram, and below the histogram, inches."""
FROM_ABOVE = 75.0
"""Elevation of the second view of a twin, degrees."""
LOG_FROM = 3.0
"""A loss has a log axis if its largest value is at least this many times its smallest."""
SERIES = {
    "search": (("cost", "candidates"), ("best_cost", "best so far")),
    "fit": (("loss", "frames trained on"), ("tail_loss", "held-back frames")),
    "train": (("loss", "training loss"),),
}
"""Stage to the metrics of its history that are drawn, and their labels."""
LOSS_AXES = {"search": ("rollout", "training cost"), "fit": ("epoch", "loss [m$^2$]"), "train": ("step", "loss")}
"""Stage to the labels of its axes. Baselines train by epochs or iterations, on squared distances or silhouettes."""


def run_figures(
    observations: Observations,
    trajectory: Trajectory | None,
    histories: Mapping[str, pd.DataFrame],
    method: str,
    folder: Path,
    *,
    errors: Mapping[str, np.ndarray] | None = None,
    twin: Twin | None = None,
    searched: float | None = None,
) -> list[Path]:
    """Draw the figures of a run, and return the files.

    errors.png and motion.png need a trajectory, losses.png a history, topology.png and stiffness.png the run's last twin.
    `errors` are those of `metrics.errors_per_frame`, m, computed here if not given. `searched` is the homogeneous stiffness that
    the search found, N, marked among the twin's.
    """
    title, drawn = f"{observations.scenario.name}, {method}", list[Path]()
    # A picture of an earlier result must not stay beside this one's.
    for name in (*RUN_FIGURES, IMAGE_SCORES):
        (folder / name).unlink(missing_ok=True)

    def keep(name: str, figure: Figure) -> None:
        drawn.append(save(figure, folder / name))

    if trajectory is not None and len(trajectory.positions):
        keep("errors.png", _errors(observations, errors or errors_per_frame(trajectory.positions, observations), title))
        keep("motion.png", motion_figure(observations, trajectory, method))
    if histories:
        keep("losses.png", losses_figure(histories, title))
    if twin is not None:
        take, lines = ShownRun(title, twin.topology.nodes[None], twin), lines_of(twin)
        label = f"{title}: {len(twin.topology.nodes)} nodes, {len(lines.pairs)} {lines.kinds}"
        two_sides = _from_two_sides(observations, take, label, "region")
        keep("topology.png", twin_figure(two_sides, RUN_WIDTH, COUNTED_LEGEND))
        if lines.inner:
            keep("stiffness.png", stiffness_figure(observations, take, searched))
    return drawn


def _errors(observations: Observations, values: Mapping[str, np.ndarray], title: str) -> Figure:
    figure, axis = plt.subplots(figsize=(7, 3.2), layout="constrained")
    seconds = np.arange(len(values["track_error"])) / observations.scenario.frame_rate
    for metric, label, color in (
        ("track_error", "track error (Euclidean)", "tab:blue"),
        ("track_error_bound", "track error of bound points", "tab:green"),
        ("chamfer", "Chamfer distance (L1)", "tab:orange"),
    ):
        axis.plot(seconds, PLOTTED_MM * values[metric], label=label, color=color)
    shade_future(axis, observations.scenario, label="future")
    axis.set(xlabel="time [s]", ylabel="error [mm]", title=title, ylim=(0, None), xlim=(0, None))
    axis.legend(frameon=False)
    return figure


def shade_future(axis: Axes, scenario: Scenario, label: str = "") -> None:
    """Gray behind the future, which no method has seen, on an axis of seconds."""
    axis.axvspan(scenario.train_end / scenario.frame_rate, scenario.frame_count / scenario.frame_rate, color="0.92", label=label)


def image_scores_figure(frames: pd.DataFrame, scenario: Scenario, method: str, folder: Path) -> Path:
    """Draw image_scores.png: every metric of pictures over time, from rows frame, camera, metric, value; returns the file."""
    shown = [metric for metric in metrics_of("pictures") if metric.name in set(frames["metric"])]
    size = (7, 1.5 * len(shown) + 0.8)
    figure, axes = plt.subplots(len(shown), 1, figsize=size, layout="constrained", sharex=True, squeeze=False)
    for axis, metric in zip(axes[:, 0], shown, strict=True):
        values = frames[frames["metric"] == metric.name].groupby("frame")["value"].mean()
        axis.plot(values.index / scenario.frame_rate, values, color="tab:blue")
        shade_future(axis, scenario)
        axis.set(ylabel=metric.label, xlim=(0, None))
    axes[0, 0].set_title(f"{scenario.name}, {method} (gray: future)")
    axes[-1, 0].set_xlabel("time [s]")
    return save(figure, folder / IMAGE_SCORES)


def losses_figure(histories: Mapping[str, pd.DataFrame], title: str) -> Figure:
    """A panel per stage that learns; a search leaves out candidates that could not be simulated."""
    figure, axes = plt.subplots(1, len(histories), figsize=(3.6 * len(histories) + 1, 3.2), layout="constrained", squeeze=False)
    for axis, (stage, history) in zip(axes[0], histories.items(), strict=True):
        for metric, label in SERIES[stage]:
            if len(rows := history[history["metric"] == metric]):
                single = "." if metric == "cost" or len(rows) == 1 else ""
                axis.plot(rows["step"], rows["value"], ls="" if metric == "cost" else "-", marker=single, ms=4, label=label)
        axis.set(title=stage, xlabel=LOSS_AXES[stage][0], ylabel=LOSS_AXES[stage][1])
        search = stage == "search"
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
        if axis.lines:
            axis.legend(frameon=False, fontsize=8)
    figure.suptitle(title)
    return figure


def motion_figure(observations: Observations, trajectory: Trajectory, method: str) -> Figure:
    """A strip of a few frames: observed points, predicted nodes, and their distances, as `neuspring draw strip --as nodes`."""
    scenario, take = observations.scenario, ShownRun(method, trajectory.positions)
    frames = sorted({*chosen_frames(scenario, len(take.positions)), *chosen_frames(scenario, scenario.frame_count)})
    scene = ShownScene.from_side(observations, [take], frames)
    return strip_figure(Painter(scene, [take], frames, DrawingStyle(error="distance")), RUN_WIDTH)


def _from_two_sides(observations: Observations, take: ShownRun, label: str, *quantities: str) -> TwinPicture:
    """The twin in frame 0 from its broad side, and from above."""
    columns = [
        (ShownScene.from_side(observations, [take], [0]), replace(take, label=label)),
        (ShownScene.from_side(observations, [take], [0], elevation=FROM_ABOVE), replace(take, label="from above")),
    ]
    return TwinPicture(columns, 0, quantities)  # type: ignore[arg-type]


def stiffness_figure(observations: Observations, take: ShownRun, searched: float | None) -> Figure:
    """The body's lines in frame 0 colored by stiffness in two views, and their histogram with the searched stiffness [N] marked.

    The body must have a line.
    """
    assert take.twin is not None
    lines = lines_of(take.twin)
    stiffness = lines.stiffness[: lines.inner].astype(float)
    body = _from_two_sides(observations, take, f"{take.label}: {len(stiffness)} {lines.about}", "stiffness")
    figure = twin_figure(body, RUN_WIDTH + HISTOGRAM, LEGEND_ROOM + HISTOGRAM)
    high = figure.get_figheight()
    axis = place(figure, RUN_WIDTH + 0.6, FOOT, HISTOGRAM - 0.9, max(high - FOOT - 0.1, 0.5))
    histogram(axis, stiffness, body.norm, searched)
    axis.set_ylabel(lines.kind)
    return figure
