"""Figures of twins: springs or surface colored by stiffness, nodes colored by region, and a histogram of stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from neuspring.core.artifacts import Twin
from neuspring.draw.painter import empty, hands
from neuspring.draw.scene import ShownRun, ShownScene
from neuspring.draw.sheet import CONTROLLER, TEXT, color_bar, panels, points_across, sample
from neuspring.twin.body import Lines, body_of, lines_of

Quantity = Literal["stiffness", "region"]
STIFFNESS_COLORS = "viridis"
PALETTE = [f"tab:{name}" for name in ("blue", "orange", "green", "purple", "brown", "pink", "olive", "cyan")] + ["navy", "gold"]
CROSSING = (0.35, 0.35, 0.35, 1.0)
"""RGBA of springs between regions."""
LEGEND_ROOM = 0.75
"""Margin for a color bar or the legend of regions, inches."""
MOST_VECTORS = 2500
"""More lines are rasterized, because a page with so many vectors opens slowly."""
LEAST_RATIO, DEEPEST = 2.0, 1e4
"""Smallest ratio of the ends of a stiffness axis, so that tiny differences do not fill it; largest ratio of a color range."""
STIFFNESS_BINS = 41
"""Odd, so that equal values are in the middle of a bar, at the line of the searched stiffness."""


def region_colors(count: int) -> np.ndarray:
    """One RGBA color per region [count, 4], different from the colors of controllers and springs."""
    if count <= len(PALETTE):
        return to_rgba_array(PALETTE[:count])
    return colormaps["turbo"](np.linspace(0.05, 0.85, count))


def stiffness_limits(stiffness: np.ndarray) -> tuple[float, float]:
    """Ends of a logarithmic color range, N, for stiffness [S], N.

    The range excludes 0.5 % of the values at each end. Its ratio is at least 2 and at most 10^4; both ends are positive.
    """
    if not len(positive := stiffness[stiffness > 0]):
        return 1.0, LEAST_RATIO
    low, high = (float(value) for value in np.quantile(positive.astype(np.float64), [0.005, 0.995]))
    return _widened(max(low, high / DEEPEST), high)


def _widened(low: float, high: float) -> tuple[float, float]:
    """Widen a range to a ratio of at least 2 around its geometric mean."""
    if high >= LEAST_RATIO * low:
        return low, high
    middle = float(np.sqrt(low * high))
    return middle / LEAST_RATIO**0.5, middle * LEAST_RATIO**0.5


@dataclass(frozen=True, eq=False)
class TwinPicture:
    """Twins in one frame: one column per (scene, run), one row per quantity that the colors show."""

    columns: Sequence[tuple[ShownScene, ShownRun]]
    frame: int
    quantities: Sequence[Quantity]
    limits: tuple[float, float] | None = None
    """Color range of stiffness, N; None: from the twins."""

    @cached_property
    def norm(self) -> LogNorm:
        """The color range of stiffness, N, shared by all twins."""
        if self.limits:
            return LogNorm(*self.limits)
        twins = [_twin(take) for _, take in self.columns]
        return LogNorm(*stiffness_limits(np.concatenate([lines.stiffness[: lines.inner] for lines in map(lines_of, twins)])))

    def node_colors(self, take: ShownRun, quantity: Quantity) -> np.ndarray:
        """RGBA of nodes [N, 4]."""
        twin = _twin(take)
        if quantity == "stiffness":
            return self._of_stiffness(body_of(twin).node_stiffness(twin))
        names, region = np.unique(twin.topology.labels, return_inverse=True)
        return region_colors(len(names))[region]

    def spring_colors(self, take: ShownRun, quantity: Quantity) -> np.ndarray:
        """RGBA of object springs [S, 4]."""
        lines = lines_of(_twin(take))
        if quantity == "stiffness":
            return self._of_stiffness(lines.stiffness[: lines.inner])
        names, region = np.unique(lines.labels, return_inverse=True)
        colors = region_colors(len(names))[region[lines.pairs[: lines.inner, 0]]]
        colors[_between(lines)] = CROSSING
        return np.asarray(colors)

    def _of_stiffness(self, values: np.ndarray) -> np.ndarray:
        # A stiffness of 0 gets the color of the lower end of the log scale.
        return np.asarray(colormaps[STIFFNESS_COLORS](self.norm(np.clip(values, self.norm.vmin, self.norm.vmax))))

    def paint(self, axis: Axes, scene: ShownScene, take: ShownRun, quantity: Quantity) -> None:
        """Draw one panel."""
        empty(axis, scene.view, framed=False)
        self._lines(axis, scene, take, quantity)
        hands(axis, scene, self.frame)

    def _lines(self, axis: Axes, scene: ShownScene, take: ShownRun, quantity: Quantity) -> None:
        """Draw springs and, by region, nodes and the springs of controllers in frame 0; the nearest are on top."""
        lines, nodes = lines_of(_twin(take)), take.positions[self.frame].astype(float)
        seen = scene.observations.controller_points
        everything = lines.points(nodes, seen[min(self.frame, len(seen) - 1)].astype(float))
        flat, depth = scene.view.project(everything)
        chosen = sample(lines.inner)
        pairs = lines.pairs[chosen]
        order = np.argsort(-depth[pairs].mean(axis=1), kind="stable")
        order = order[(depth[pairs[order]] > 0).all(axis=1)]
        width = points_across(axis)
        colors = self.spring_colors(take, quantity)[chosen][order]
        thick = float(np.clip(0.06 * width / np.sqrt(max(len(order), 1)), 0.25, 1.4))
        many = len(order) > MOST_VECTORS
        axis.add_collection(LineCollection(list(flat[pairs[order]]), colors=colors, linewidths=thick, rasterized=many, zorder=2))
        if quantity == "stiffness":
            return
        if not self.frame:
            ends = flat[lines.pairs[lines.inner :]]
            style: dict[str, Any] = {"colors": CONTROLLER, "linewidths": thick, "alpha": 0.5, "rasterized": many, "zorder": 2}
            axis.add_collection(LineCollection(list(ends), **style))
        near = np.argsort(-depth[: len(nodes)])
        near = near[depth[near] > 0]
        size = float(np.clip((0.2 * width) ** 2 / max(len(nodes), 1), 1.0, 14.0))
        axis.scatter(flat[near, 0], flat[near, 1], c=self.node_colors(take, quantity)[near], s=size, linewidths=0, zorder=3)


def twin_figure(body: TwinPicture, width: float, room: float = LEGEND_ROOM) -> Figure:
    """Draw twins, `width` inches wide: one column per twin, one row per quantity with its legend.

    `room` is the right margin, inches.
    """
    shapes = [scene.view.width / scene.view.height for scene, _ in body.columns]
    figure, axes = panels(width, shapes, len(body.quantities), right=room)
    for row, quantity in zip(axes, body.quantities, strict=True):
        for axis, (scene, take) in zip(row, body.columns, strict=True):
            body.paint(axis, scene, take, quantity)
        if quantity == "stiffness":
            color_bar(row[-1:], body.norm, STIFFNESS_COLORS, "stiffness [N]", extend="both")
        else:
            _regions(row[-1], body)
    for axis, (_, take) in zip(axes[0], body.columns, strict=True):
        axis.set_title(take.label, fontsize=TEXT, pad=3)
    return figure


def _regions(axis: Axes, body: TwinPicture) -> None:
    """Draw the legend of regions, for the twin with the most regions."""
    count = max(len(np.unique(_twin(take).topology.labels)) for _, take in body.columns)
    names = [f"region {k}" for k in range(count)] if count > 1 else ["one region"]
    dots = [Line2D([], [], ls="", marker="o", ms=4, color=color) for color in region_colors(count)]
    if count > 1:
        names.append("between")
        dots.append(Line2D([], [], color=CROSSING, linewidth=1.0))
    style = {"fontsize": TEXT - 1.5, "frameon": False, "handlelength": 0.8, "handletextpad": 0.3, "borderaxespad": 0.3}
    axis.legend(dots, names, loc="center left", bbox_to_anchor=(1.0, 0.5), labelspacing=0.25, **style)


def histogram(axis: Axes, stiffness: np.ndarray, norm: LogNorm, searched: float | None) -> None:
    """Draw the histogram of stiffness [S], N, on a log axis, in the colors of the twin; the dashed line is `searched`, N.

    Values below the largest / 10^6 are counted at that value.
    """
    shown = np.maximum(stiffness, (stiffness.max() or 1.0) / 1e6)
    low, high = _widened(float(shown.min()), float(shown.max()))
    # The margins keep rounded extremes inside of the outer bins.
    drawn: Any = axis.hist(shown, np.geomspace(low * (1 - 1e-6), high * (1 + 1e-6), STIFFNESS_BINS + 1).tolist())
    _, edges, bars = drawn
    colors = colormaps[STIFFNESS_COLORS](norm(np.clip(np.sqrt(edges[1:] * edges[:-1]), norm.vmin, norm.vmax)))
    for bar, color in zip(bars, colors, strict=True):
        bar.set_facecolor(color)
    text = f"stiffness [N], median {np.median(stiffness):.4g}"
    if searched:
        axis.axvline(searched, color=CONTROLLER, ls="--", lw=1.3)
        text += f"\ndashed: searched, {searched:.4g}"
    axis.set(xscale="log", ylabel="springs")
    axis.set_xlabel(text, fontsize=TEXT - 1)
    axis.tick_params(labelsize=TEXT - 1, which="both")


def _between(lines: Lines) -> np.ndarray:
    """[S] bool: True if an inner line connects two regions."""
    ends = lines.labels[lines.pairs[: lines.inner]]
    return np.asarray(ends[:, 0] != ends[:, 1])


def _twin(take: ShownRun) -> Twin:
    assert take.twin is not None
    return take.twin
