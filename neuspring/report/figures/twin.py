"""Pictures of a twin in frame 0: its regions and springs, and its stiffness."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from neuspring.core.artifacts import Topology, Twin
from neuspring.report.figures.views import (
    BOTTOM,
    LEFT,
    TOP,
    TwoViews,
    View,
    headline,
    line_width,
    place,
    point_size,
    readable,
    sample,
    sample_note,
)

COLORS = "viridis"
PALETTE = [f"tab:{name}" for name in ("blue", "orange", "green", "purple", "brown", "pink", "olive", "cyan")] + ["navy", "gold"]
CONTROLLER = "tab:red"
LEAST_RATIO = 2.0
"""Smallest ratio of the ends of a stiffness axis, so that tiny differences do not fill it."""
DEEPEST = 1e4
"""Largest ratio of the ends of the color range."""
BINS = 41
"""Odd, so that equal values sit in the middle of a bar, under the mark of the searched one."""
KEY, HISTOGRAM = 2.8, 3.3
"""Widths of the legend beside the views, and of the histogram, inches."""


def region_colors(count: int) -> np.ndarray:
    """One color [count, 4] per region, RGBA, different from those of controllers and springs."""
    if count <= len(PALETTE):
        return to_rgba_array(PALETTE[:count])
    return np.asarray(colormaps["turbo"](np.linspace(0.05, 0.85, count)))


def topology_figure(twin: Twin, title: str) -> Figure:
    """Rest nodes colored by region, springs within and between regions, controllers and their springs; two views."""
    topology = twin.topology
    layout = TwoViews.of(np.concatenate([topology.nodes, topology.controllers]), twin.simulation.up)
    width, height = layout.inches
    figure = plt.figure(figsize=(LEFT + width + KEY, max(height + BOTTOM + TOP, 3.4)))
    panels = layout.axes(figure)
    for axis, view in panels:
        _draw_springs(axis, view, topology)
        _draw_nodes(axis, view, topology)
    right, top = (LEFT + width + 0.1) / figure.get_figwidth(), (BOTTOM + height) / figure.get_figheight()
    handles, names = panels[0][0].get_legend_handles_labels()
    readable(figure.legend(handles, names, loc="upper left", bbox_to_anchor=(right, top), frameon=False, fontsize=8))
    regions, springs = len(np.unique(topology.labels)), len(topology.springs)
    counts = f"{len(topology.nodes)} nodes in {regions} region{'s' * (regions > 1)}, {springs} springs{sample_note(springs)}"
    headline(figure, f"{title}: topology in frame 0", counts)
    return figure


def _draw_springs(axis: Axes, view: View, topology: Topology) -> None:
    """The springs, by kind, in thin lines."""
    springs, nodes = topology.springs, len(topology.nodes)
    flat = view.project(np.concatenate([topology.nodes, topology.controllers]))
    labels = np.concatenate([topology.labels, np.full(len(topology.controllers), -1)])
    held = (springs >= nodes).any(axis=1)
    crossing = ~held & (labels[springs[:, 0]] != labels[springs[:, 1]])
    drawn = np.zeros(len(springs), bool)
    drawn[sample(len(springs))] = True
    several = bool(crossing.any())
    width = 0.7 * line_width(int(drawn.sum()))
    for chosen, color, name in (
        (~held & ~crossing, "0.75", "springs within a region" if several else "springs"),
        (crossing, "0.25", "springs between regions"),
        (held, "lightcoral", "springs of controllers"),
    ):
        if chosen.any():
            label = f"{name} ({int(chosen.sum())})"
            axis.add_collection(
                LineCollection(list(flat[springs[chosen & drawn]]), colors=color, linewidths=width, label=label, zorder=1)
            )


def _draw_nodes(axis: Axes, view: View, topology: Topology) -> None:
    """Nodes in the color of their region, near ones in front, and controllers."""
    flat, order = view.project(topology.nodes), np.argsort(view.depth(topology.nodes))
    names, region = np.unique(topology.labels, return_inverse=True)
    colors, size = region_colors(len(names)), point_size(len(flat))
    axis.scatter(flat[order, 0], flat[order, 1], s=size, c=colors[region[order]], linewidths=0, zorder=2)
    degree = np.bincount(topology.springs.ravel(), minlength=len(flat))[: len(flat)]
    for index, name in enumerate(names):
        inside = region == index
        title = f"region {name}" if len(names) > 1 else "all"
        title += f": {int(inside.sum())} nodes, {degree[inside].mean():.1f} springs each"
        axis.scatter([], [], s=16, color=colors[index], label=title)
    lonely = flat[degree == 0]
    if len(lonely):
        axis.scatter(
            lonely[:, 0], lonely[:, 1], s=30, marker="x", color="black", label=f"nodes without spring ({len(lonely)})", zorder=3
        )
    hands = view.project(topology.controllers)
    style: dict[str, Any] = {"marker": "D", "color": CONTROLLER, "edgecolors": "white", "linewidths": 0.4}
    axis.scatter(hands[:, 0], hands[:, 1], s=16, label=f"controllers ({len(hands)})", zorder=4, **style)


def stiffness_limits(stiffness: np.ndarray) -> tuple[float, float]:
    """Ends of a logarithmic color range, N, for stiffness [S], N.

    All but the outermost 0.5 % on either side; at least a factor of 2 and at most one of 10^4 apart; positive whatever comes in.
    """
    positive = stiffness[stiffness > 0]
    if not len(positive):
        return 1.0, LEAST_RATIO
    low, high = (float(value) for value in np.quantile(positive.astype(np.float64), [0.005, 0.995]))
    return widened(max(low, high / DEEPEST), high)


def widened(low: float, high: float) -> tuple[float, float]:
    """The same range; a range narrower than a factor of 2 is widened to that about its geometric mean."""
    if high >= LEAST_RATIO * low:
        return low, high
    middle = float(np.sqrt(low * high))
    return middle / LEAST_RATIO**0.5, middle * LEAST_RATIO**0.5


def stiffness_figure(twin: Twin, searched: float | None, title: str) -> Figure:
    """Object springs in frame 0 colored by stiffness in two views, and their histogram with the searched stiffness [N] marked.

    The twin must have an object spring.
    """
    topology = twin.topology
    count = topology.object_spring_count
    stiffness = np.asarray(twin.material.stiffness[:count], np.float64)
    norm = LogNorm(*stiffness_limits(stiffness))
    layout = TwoViews.of(topology.nodes, twin.simulation.up, width=6.0, height=4.8)
    width, height = layout.inches
    figure = plt.figure(figsize=(LEFT + width + 1.7 + HISTOGRAM + 0.2, max(height, 2.4) + BOTTOM + TOP + 0.25))
    panels = layout.axes(figure, bottom=BOTTOM + 0.2)
    for axis, view in panels:
        lines = _draw_stiffness(axis, view, topology, stiffness, norm)
    colors = place(figure, LEFT + width + 0.2, BOTTOM + 0.2, 0.16, height)
    figure.colorbar(lines, cax=colors, extend=_beyond(stiffness, norm), label="stiffness [N]")
    colors.tick_params(labelsize=8, which="both")
    _histogram(place(figure, LEFT + width + 1.7, BOTTOM + 0.2, HISTOGRAM, max(height, 2.4) - 0.2), stiffness, norm, searched)
    headline(figure, title, f"stiffness of {count} object springs{sample_note(count)}")
    return figure


def _draw_stiffness(axis: Axes, view: View, topology: Topology, stiffness: np.ndarray, norm: LogNorm) -> LineCollection:
    chosen = sample(len(stiffness))
    ends = topology.springs[chosen]
    # Near springs are drawn last, so a view shows the side of the body that faces it.
    order = np.argsort(view.depth(topology.nodes)[ends].mean(axis=1), kind="stable")
    segments = view.project(topology.nodes)[ends[order]]
    lines = LineCollection(list(segments), cmap=COLORS, norm=norm, linewidths=line_width(len(chosen)))
    # A stiffness of 0 has no color on a log scale; it takes that of the lower end.
    lines.set_array(np.clip(stiffness[chosen[order]], norm.vmin, norm.vmax))
    axis.add_collection(lines)
    return lines


def _beyond(stiffness: np.ndarray, norm: LogNorm) -> str:
    """Which ends of the color bar get an arrow, because values lie beyond them."""
    below, above = bool((stiffness < norm.vmin).any()), bool((stiffness > norm.vmax).any())
    return {(True, True): "both", (True, False): "min", (False, True): "max", (False, False): "neither"}[below, above]


def histogram_edges(stiffness: np.ndarray) -> np.ndarray:
    """Edges of bins of equal width in log10 stiffness, N, around stiffness [S] as `floored` returns it."""
    low, high = widened(float(stiffness.min()), float(stiffness.max()))
    # Rounding must not push the extremes out of the outer bins.
    return np.geomspace(low * (1 - 1e-6), high * (1 + 1e-6), BINS + 1)


def floored(stiffness: np.ndarray) -> np.ndarray:
    """Stiffness [S], N. Values below the largest / 10^6 are raised to that."""
    raised: np.ndarray = np.maximum(stiffness, (stiffness.max() or 1.0) / 1e6)
    return raised


def _newtons(value: float) -> str:
    return f"{value:,.0f} N" if value >= 100 else f"{value:.3g} N"


def _histogram(axis: Axes, stiffness: np.ndarray, norm: LogNorm, searched: float | None) -> None:
    """A histogram of springs over log stiffness, in the colors of the views."""
    shown = floored(stiffness)
    edges = histogram_edges(shown)
    counts, _ = np.histogram(shown, edges)
    middles = np.clip(np.sqrt(edges[1:] * edges[:-1]), norm.vmin, norm.vmax)
    axis.bar(edges[:-1], counts, np.diff(edges), align="edge", color=colormaps[COLORS](norm(middles)), edgecolor="0.4", lw=0.3)
    middle = float(np.median(stiffness))
    text = f"median {_newtons(middle)}"
    if searched:
        axis.axvline(searched, color=CONTROLLER, ls="--", lw=1.3, label=f"searched $S_0$ = {_newtons(searched)}")
        axis.legend(frameon=False, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        text += f" = {middle / searched:.2f} $S_0$"
    low = int((stiffness < shown).sum())
    text += f"; {low} springs below the axis" if low else ""
    axis.set(xscale="log", xlabel=f"stiffness [N]\n{text}", ylabel="springs")
    axis.tick_params(labelsize=8, which="both")
    # Matplotlib labels the ticks between powers of ten when few powers are in view; over half a decade they would overlap.
    if edges[-1] / edges[0] > 3:
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        axis.xaxis.set_minor_formatter(NullFormatter())
