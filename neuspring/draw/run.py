"""Figures of a run: errors over time, losses, predicted and observed points, and the twin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from neuspring.core.artifacts import Observations, Scenario, Trajectory, Twin
from neuspring.draw.benchmark import curves_figure
from neuspring.draw.painter import DrawingStyle, Painter
from neuspring.draw.scene import ShownRun, ShownScene, chosen_frames
from neuspring.draw.sheet import save
from neuspring.draw.strip import strip_figure
from neuspring.draw.twin import LEGEND_ROOM, TwinPicture, histogram, twin_figure
from neuspring.scores.metrics import METRICS, errors_per_frame
from neuspring.twin.body import lines_of

RUN_FIGURES = ("errors.png", "motion.png", "losses.png", "topology.png", "stiffness.png")
IMAGE_SCORES = "image_scores.png"
RUN_WIDTH, HISTOGRAM = 10.0, 3.4
"""Widths of the figures of motion and twins, and of the histogram, inches."""
FROM_ABOVE = 75.0
"""Elevation of the second view of a twin, degrees."""
DIVERGED_COST = 1e3
"""Larger costs belong to candidates whose simulation diverged."""
SERIES = {"best_cost": "best cost so far", "loss": "loss", "rollout_loss": "loss of rollouts"}
"""Drawn metrics of histories and their labels."""


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
    """Draw the figures of a run and return the files.

    - errors.png, motion.png: require a trajectory
    - losses.png: requires a history
    - topology.png, stiffness.png: require the run's last twin

    `errors` is the result of `metrics.errors_per_frame`, m; computed here if not given. `searched` is the homogeneous stiffness
    of the search, N, drawn in the histogram of stiffness.
    """
    title, scenario, made = f"{observations.scenario.name}, {method}", observations.scenario, dict[str, Figure]()
    # Remove figures of earlier results.
    for name in (*RUN_FIGURES, IMAGE_SCORES):
        (folder / name).unlink(missing_ok=True)
    if trajectory is not None and len(trajectory.positions):
        values = errors or errors_per_frame(trajectory.positions, observations)
        curves = {METRICS[name].title: _over_time(METRICS[name].factor * own, scenario) for name, own in values.items()}
        heading = f"{title}: error [mm] over time [s]"
        made["errors.png"] = curves_figure({heading: curves}, {heading: scenario})
        made["motion.png"] = motion_figure(observations, trajectory, method)
    if histories:
        made["losses.png"] = curves_figure({stage: history_lines(table) for stage, table in histories.items()})
    if twin is not None:
        take, lines = ShownRun(title, twin.topology.nodes[None], twin), lines_of(twin)
        label = f"{title}: {len(twin.topology.nodes)} nodes, {len(lines.pairs)} {lines.kinds}"
        made["topology.png"] = twin_figure(_from_two_sides(observations, take, label, "region"), RUN_WIDTH)
        if lines.inner:
            made["stiffness.png"] = stiffness_figure(observations, take, searched)
    return [save(figure, folder / name) for name, figure in made.items()]


def _over_time(values: np.ndarray, scenario: Scenario) -> pd.Series:
    return pd.Series(values, np.arange(len(values)) / scenario.frame_rate)


def history_lines(history: pd.DataFrame) -> dict[str, pd.Series]:
    """Label -> costs or losses by step, from a stage's history, without diverged candidates."""
    history = history[history["value"] < DIVERGED_COST]
    parts = {label: history[history["metric"] == metric] for metric, label in SERIES.items()}
    return {label: part.set_index("step")["value"].astype(float) for label, part in parts.items() if len(part)}


def image_scores_figure(frames: pd.DataFrame, scenario: Scenario, method: str, folder: Path) -> Path:
    """Draw image_scores.png: all image metrics over time, from columns frame, camera, metric, value; returns the file."""
    finite = frames[np.isfinite(frames["value"])]
    panels = {}
    for name, part in finite.groupby("metric", sort=False):
        values = part.groupby("frame")["value"].mean()
        panels[METRICS[str(name)].label] = {f"{scenario.name}, {method}": values.set_axis(values.index / scenario.frame_rate)}
    return save(curves_figure(panels, dict.fromkeys(panels, scenario)), folder / IMAGE_SCORES)


def motion_figure(observations: Observations, trajectory: Trajectory, method: str) -> Figure:
    """A strip of a few frames with observed points, predicted nodes and their distances, as `neuspring draw strip --as nodes`."""
    scenario, take = observations.scenario, ShownRun(method, trajectory.positions)
    frames = sorted({*chosen_frames(scenario, len(take.positions)), *chosen_frames(scenario, scenario.frame_count)})
    scene = ShownScene.from_side(observations, [take], frames)
    return strip_figure(Painter(scene, [take], frames, DrawingStyle(error="distance")), RUN_WIDTH)


def _from_two_sides(observations: Observations, take: ShownRun, label: str, *quantities: str) -> TwinPicture:
    """The twin in frame 0 from its broad side and from above."""
    columns = [
        (ShownScene.from_side(observations, [take], [0]), replace(take, label=label)),
        (ShownScene.from_side(observations, [take], [0], elevation=FROM_ABOVE), replace(take, label="from above")),
    ]
    return TwinPicture(columns, 0, quantities)  # type: ignore[arg-type]


def stiffness_figure(observations: Observations, take: ShownRun, searched: float | None) -> Figure:
    """Two views of a twin's lines in frame 0, colored by stiffness, and their histogram with the searched stiffness, N.

    The twin must have at least one line.
    """
    assert take.twin is not None
    lines = lines_of(take.twin)
    stiffness = lines.stiffness[: lines.inner].astype(float)
    body = _from_two_sides(observations, take, f"{take.label}: {len(stiffness)} {lines.about}", "stiffness")
    width = RUN_WIDTH + HISTOGRAM
    figure = twin_figure(body, width, LEGEND_ROOM + HISTOGRAM)
    axis = figure.add_axes(((RUN_WIDTH + 0.6) / width, 0.32, (HISTOGRAM - 0.9) / width, 0.6))
    histogram(axis, stiffness, body.norm, searched)
    axis.set_ylabel(lines.kind)
    return figure
