"""Helpers of figures: projections of the world, two views at one scale, sizes for many points, saving."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from neuspring.core.artifacts import Up
from neuspring.core.files import write_atomically

DPI = 110
MOST_SPRINGS = 20_000
"""More springs than this are not drawn: lines would cover each other."""
THINNEST = 0.2
"""Smallest side of a view as a fraction of the largest, so that a flat object still has a panel that can be read."""
LEFT, BOTTOM, TOP, GAP = 0.8, 0.55, 0.6, 0.15
"""Room around panels for labels and a title, and between panels, inches."""
MARGIN = 0.07
"""Free space around the points on each side, as a fraction of the extent."""


@dataclass(frozen=True)
class View:
    """A parallel projection: two unit vectors of the picture (right, up), and the names of its axes."""

    right: tuple[float, float, float]
    upwards: tuple[float, float, float]
    labels: tuple[str, str]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Picture coordinates [..., 2] of points [..., 3], meters; the second grows upwards in the picture."""
        flat: np.ndarray = np.asarray(points, np.float64) @ np.array([self.right, self.upwards]).T
        return flat

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Distance towards the viewer [...] of points [..., 3], meters."""
        towards: np.ndarray = np.asarray(points, np.float64) @ np.cross(self.right, self.upwards)
        return towards


def _unit(axis: int, sign: float = 1.0) -> tuple[float, float, float]:
    vector = [0.0, 0.0, 0.0]
    vector[axis] = sign
    return (vector[0], vector[1], vector[2])


def widest_axis(points: np.ndarray) -> int:
    """The horizontal axis (0 or 1) along which points [N, 3] extend most."""
    spread = np.ptp(points, axis=0)
    return 0 if spread[0] >= spread[1] else 1


def side_view(axis: int, up: Up) -> View:
    """A horizontal axis (0 or 1) against height; height grows upwards whichever way the world's z points."""
    return View(_unit(axis), _unit(2, 1.0 if up == "+z" else -1.0), ("xy"[axis] + " [m]", "height [m]"))


def top_view(axis: int, up: Up) -> View:
    """Seen from above: a horizontal axis (0 or 1) to the right. The other one is turned round where the view would be mirrored."""
    other = 1 - axis
    sign = (1.0 if up == "+z" else -1.0) * (1.0 if axis == 0 else -1.0)
    return View(_unit(axis), _unit(other, sign), ("xy"[axis] + " [m]", ("" if sign > 0 else "−") + "xy"[other] + " [m]"))


def limits(coordinates: np.ndarray, least: float = 0.0) -> np.ndarray:
    """Lower and upper limits [2, D] around coordinates [..., D], with a margin and each span at least `least`; same unit."""
    flat = coordinates.reshape(-1, coordinates.shape[-1])
    low, high = flat.min(axis=0), flat.max(axis=0)
    half = np.maximum((high - low) * (0.5 + MARGIN), 0.5 * least)
    middle = 0.5 * (low + high)
    return np.array([middle - half, middle + half])


@dataclass(frozen=True)
class TwoViews:
    """A side view, and beside it the other side or below it the view from above (whichever shows more), at one scale.

    Panels are placed in inches, so that equal aspect leaves no gaps and nothing is cut off.
    """

    views: tuple[View, View]
    bounds: tuple[np.ndarray, np.ndarray]
    """Limits [2, 2] of each view, m: low and high of both picture axes."""
    below: bool
    """Whether the second view lies below the first (from above) or beside it (other side)."""
    scale: float
    """Inches per meter."""

    @classmethod
    def of(cls, points: np.ndarray, up: Up, width: float = 6.5, height: float = 5.2) -> TwoViews:
        """The two views of points [N, 3], m; both panels together fill `width` or `height`, in inches."""
        axis = widest_axis(points)
        spread = np.ptp(points, axis=0)
        below = bool(spread[axis] > spread[2])
        side = side_view(axis, up)
        other = top_view(axis, up) if below else side_view(1 - axis, up)
        least = max(THINNEST * float(spread.max()), 1e-6)
        first, second = (limits(view.project(points), least) for view in (side, other))
        total = np.ptp(first, axis=0)
        total[int(below)] += np.ptp(second, axis=0)[int(below)]
        return cls((side, other), (first, second), below, float(min(width / total[0], height / total[1])))

    @property
    def inches(self) -> tuple[float, float]:
        """Width and height of both panels with the gap between them."""
        first, second = (self.scale * np.ptp(bounds, axis=0) for bounds in self.bounds)
        if self.below:
            return float(first[0]), float(first[1] + GAP + second[1])
        return float(first[0] + GAP + second[0]), float(first[1])

    def axes(self, figure: Figure, left: float = LEFT, bottom: float = BOTTOM) -> list[tuple[Axes, View]]:
        """Two empty panels, with the view that each one shows; their lower left corner is at `left`, `bottom` inches."""
        sizes = [self.scale * np.ptp(bounds, axis=0) for bounds in self.bounds]
        offsets = [(0.0, sizes[1][1] + GAP), (0.0, 0.0)] if self.below else [(0.0, 0.0), (sizes[0][0] + GAP, 0.0)]
        panels: list[tuple[Axes, View]] = []
        for view, bounds, size, offset in zip(self.views, self.bounds, sizes, offsets, strict=True):
            panel = place(figure, left + offset[0], bottom + offset[1], *size)
            panel.set(xlim=bounds[:, 0], ylim=bounds[:, 1], xlabel=view.labels[0], ylabel=view.labels[1], aspect="equal")
            panel.xaxis.set_major_locator(MaxNLocator(max(1, int(1.4 * size[0]))))
            panel.yaxis.set_major_locator(MaxNLocator(max(2, int(2.5 * size[1]))))
            panel.tick_params(labelsize=8)
            panels.append((panel, view))
        # A shared axis is named once.
        if self.below:
            panels[0][0].set_xlabel("")
            panels[0][0].tick_params(labelbottom=False)
        else:
            panels[1][0].set_ylabel("")
            panels[1][0].tick_params(labelleft=False)
        return panels


def place(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """New axes in a figure; all in inches from the lower left corner."""
    across, high = figure.get_size_inches()
    return figure.add_axes((left / across, bottom / high, width / across, height / high))


def headline(figure: Figure, title: str, text: str) -> None:
    """A title and a line of text in the upper left corner, away from legends."""
    high = figure.get_size_inches()[1]
    figure.text(LEFT / figure.get_size_inches()[0], 1 - 0.1 / high, f"{title}\n{text}", ha="left", va="top", fontsize=10)


def sample(count: int, most: int = MOST_SPRINGS) -> np.ndarray:
    """Indices, ascending, of the springs to draw: all of them, or a random `most` that is the same every time."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, most, replace=False))


def sample_note(count: int, most: int = MOST_SPRINGS) -> str:
    """The part of a title that says how many springs are drawn; empty if all are."""
    return "" if count <= most else f", a random {most} of them drawn"


def point_size(count: int) -> float:
    """Marker area, points^2, for this many nodes in one panel."""
    return float(np.clip(3000 / max(count, 1), 2.0, 14.0))


def line_width(count: int) -> float:
    """Line width, points, for this many springs in one panel."""
    return float(np.clip(35 / np.sqrt(max(count, 1)), 0.25, 1.6))


def readable(legend: Legend) -> None:
    """Enlarge the samples in a legend, so that those of fine lines and points can be seen."""
    for handle in legend.legend_handles:
        if isinstance(handle, Line2D):
            handle.set_linewidth(1.3)
        elif isinstance(handle, PathCollection):
            handle.set_sizes([16.0])


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG atomically and close it; returns the path."""
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=DPI, format="png"))
    plt.close(figure)
    return path
