"""Drawing of one panel: the observed frame, a prediction, or its error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize

from neuspring.core.artifacts import Observations
from neuspring.data.camera import Camera
from neuspring.draw.scene import ShownRun, ShownScene
from neuspring.draw.sheet import CONTROLLER, WORST, points_across

Error = Literal["color", "distance", "none"]
ERROR_COLORS = "magma_r"
"""Color map of errors: light for no error, darker for larger errors."""
BLUE_POINTS, DARK_NODES, UNKNOWN_COLOR = "tab:blue", "#303030", "#d5d5d5"
"""Colors of observed points, predicted nodes, and nodes with unknown error."""
LEAST_MM = 1.0
"""Smallest upper end of the range of distances, mm."""
NOTE, SMALLEST_NOTE = 7.0, 5.0
"""Size of the text in a panel, points, and its smallest value, for narrow panels."""
DRAWN_MM = 1e3
"""Drawn mm per m."""


@dataclass(frozen=True, kw_only=True)
class DrawingStyle:
    """Style in which predictions and errors are drawn."""

    error: Error
    most: float | None = None
    """Upper end of the range of errors: color difference (colors are 0 to 1), or mm for distances; None: from the data."""
    together: bool = False
    """Do not draw a separate panel of the observed frame; nodes are drawn over the observed points."""


def distances(take: ShownRun, observations: Observations, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices [P] of nodes whose point is visible in a frame, and their distances [P], m, to it. Node i is tracked point i."""
    seen = np.flatnonzero(observations.object_visibility[frame])
    gap = take.positions[frame][seen].astype(float) - observations.object_points[frame][seen]
    return seen, np.linalg.norm(gap, axis=1)


class Painter:
    """Draws panels of one scene; all panels share the range of errors."""

    def __init__(self, scene: ShownScene, takes: Sequence[ShownRun], frames: Sequence[int], manner: DrawingStyle) -> None:
        self.scene, self.takes, self.frames, self.manner = scene, takes, tuple(frames), manner
        self.norm = Normalize(0, self._most())

    def _most(self) -> float:
        if self.manner.most is not None:
            return self.manner.most
        if self.manner.error != "distance":
            return WORST
        kept = [
            distances(take, self.scene.observations, frame)[1]
            for take in self.takes
            for frame in self.frames
            if frame < len(take.positions)
        ]
        values = np.concatenate(kept) if kept else np.zeros(0)
        value = max(DRAWN_MM * float(np.quantile(values, 0.98)) if len(values) else 0.0, LEAST_MM)
        power = 10.0 ** np.floor(np.log10(value))
        return float(np.ceil(value / power * (1 - 1e-9)) * power)

    error_name, error_label = "distance", "distance [mm]"
    """Label of the rows of errors, and of their color bar."""

    def draw(self, axis: Axes, which: int | None, frame: int, error: bool = False) -> None:
        """Draw one panel: the observed frame (`which` is None), or the prediction or error of run `which`."""
        if which is None:
            self.draw_observed(axis, frame)
        else:
            (self.draw_error if error else self.draw_predicted)(axis, which, frame)

    def draw_observed(self, axis: Axes, frame: int) -> None:
        """Draw the observed points."""
        empty(axis, self.scene.view)
        self._observed(axis, frame)
        hands(axis, self.scene, frame)

    def draw_predicted(self, axis: Axes, which: int, frame: int) -> None:
        """Draw the predicted nodes over the observed points."""
        empty(axis, self.scene.view)
        nodes = self.takes[which].positions
        if frame >= len(nodes):
            self._note(axis, "diverged")
            return
        self._below(axis, frame)
        self._line(axis, nodes[frame], frame, DARK_NODES)
        self._points(axis, nodes[frame], DARK_NODES)
        hands(axis, self.scene, frame)

    def _observed(self, axis: Axes, frame: int, alpha: float = 1.0) -> None:
        seen = self.scene.observations
        self._line(axis, seen.object_points[frame], frame, BLUE_POINTS, alpha)
        self._points(axis, seen.object_points[frame][seen.object_visibility[frame]], BLUE_POINTS, alpha=alpha)

    def _below(self, axis: Axes, frame: int) -> None:
        self._observed(axis, frame, 0.5)

    def draw_error(self, axis: Axes, which: int, frame: int) -> None:
        """Draw the distances of nodes to their points in false colors, and write their mean."""
        empty(axis, self.scene.view)
        take = self.takes[which]
        if frame >= len(take.positions):
            return
        seen, distance = distances(take, self.scene.observations, frame)
        nodes = take.positions[frame]
        unknown = np.setdiff1d(np.arange(len(nodes)), seen)
        self._points(axis, nodes[unknown], UNKNOWN_COLOR)
        pairs = np.stack([self.scene.observations.object_points[frame][seen], nodes[seen]], axis=1)
        flat = self.scene.view.project(pairs.astype(float))[0]
        axis.add_collection(LineCollection(list(flat), colors="0.6", linewidths=0.4, zorder=2))
        self._points(axis, nodes[seen], values=DRAWN_MM * distance)
        if len(distance):
            self._note(axis, f"{DRAWN_MM * distance.mean():.1f} mm")

    def _note(self, axis: Axes, text: str) -> None:
        box: dict[str, Any] = {"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 1.0}
        style: dict[str, Any] = {"ha": "right", "va": "bottom", "bbox": box, "transform": axis.transAxes, "zorder": 9}
        axis.text(0.975, 0.035, text, fontsize=float(np.clip(0.075 * points_across(axis), SMALLEST_NOTE, NOTE)), **style)

    def _line(self, axis: Axes, nodes: np.ndarray, frame: int, color: str, alpha: float = 1.0) -> None:
        """Draw the center line of a long thin object through its nodes [P, 3], m, at least the first ones; else nothing."""
        observations = self.scene.observations
        if not observations.line.size:
            return
        missing = np.full((len(observations.nodes) - len(nodes), 3), np.nan)
        line = np.concatenate([nodes, missing, observations.controller_points[frame]])[observations.line]
        flat = self.scene.view.project(line.astype(float))[0]
        axis.plot(flat[:, 0], flat[:, 1], color=color, alpha=alpha, linewidth=0.008 * points_across(axis), zorder=2)

    def _points(
        self, axis: Axes, points: np.ndarray, color: str | None = None, *, values: np.ndarray | None = None, alpha: float = 1.0
    ) -> None:
        """Draw points [P, 3], m, as dots of one color, or colored by values [P]; the nearest are on top."""
        observations = self.scene.observations
        flat, depth = self.scene.view.project(np.asarray(points, float))
        order = np.argsort(-depth)
        order = order[depth[order] > 0]
        style = {"color": color} if values is None else {"c": values[order], "cmap": ERROR_COLORS, "norm": self.norm}
        edge = {"linewidths": 0.0} if values is None else {"linewidths": 0.25, "edgecolors": "0.45"}
        # The size of dots does not depend on the frame's number of visible points.
        nodes = color in (DARK_NODES, UNKNOWN_COLOR)
        count, width = len(observations.nodes) if nodes else observations.object_points.shape[1], points_across(axis)
        # Dots cover about a third of the panel, within limits of visibility.
        size = float(np.clip((0.35 * width / np.sqrt(max(count, 1))) ** 2, 0.8, (0.035 * width) ** 2))
        axis.scatter(flat[order, 0], flat[order, 1], s=size, alpha=alpha, zorder=3, **style, **edge)


def empty(axis: Axes, view: Camera, *, framed: bool = True) -> None:
    """Clear a panel to the size of a camera's image, with pixel centers at integer coordinates."""
    limits = {"xlim": (-0.5, view.width - 0.5), "ylim": (view.height - 0.5, -0.5)}
    axis.set(xticks=[], yticks=[], **limits, aspect="auto", facecolor="white")
    axis.set_autoscale_on(False)
    axis.spines[:].set(linewidth=0.5, color="0.7", visible=framed)


def hands(axis: Axes, scene: ShownScene, frame: int) -> None:
    """Draw the controllers of a frame."""
    flat, depth = scene.view.project(scene.hands(frame).astype(float))
    size = float(np.clip((0.021 * points_across(axis)) ** 2, 3.0, 14.0))
    style: dict[str, Any] = {"marker": "D", "color": CONTROLLER, "edgecolors": "white", "linewidths": 0.25, "zorder": 5}
    axis.scatter(flat[depth > 0, 0], flat[depth > 0, 1], s=size, **style)
