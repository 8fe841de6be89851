"""Twins as bodies: springs or surface colored by stiffness, nodes by region, seen by any camera; one column per method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
import torch
from matplotlib import colormaps
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.spatial import cKDTree

from neuspring.config.images import Images
from neuspring.core.artifacts import Twin
from neuspring.report.figures.twin import COLORS, CONTROLLER, region_colors, stiffness_limits
from neuspring.report.figures.views import place, sample
from neuspring.report.paper.scene import Prediction, Scene, faded, finer, over_white
from neuspring.report.paper.sheet import TEXT, color_bar, points_across
from neuspring.splats.draw import picture, view_of
from neuspring.splats.harmonics import C0
from neuspring.splats.model import Gaussians
from neuspring.splats.rasterize import choose_backend

Quantity = Literal["stiffness", "region"]
TITLE, GAP, BAR, EDGE = 0.22, 0.05, 0.75, 0.03
"""Room for names of methods, between panels, for a color bar or names of regions, and at the edges, inches."""
MOST_VECTORS = 2500
"""More lines than this are stored as pixels: a page would open slowly."""
FINE = 900
"""Least width of a surface in pixels; nothing is compared with it, so it need not have the camera's."""
CROSSING = (0.35, 0.35, 0.35, 1.0)
"""Springs between regions."""


def node_stiffness(twin: Twin) -> np.ndarray:
    """Geometric mean of the stiffness of each node's object springs [N], N; the median of all for a node without any."""
    count = twin.topology.object_spring_count
    pairs, values = twin.topology.springs[:count], np.maximum(twin.material.stiffness[:count].astype(float), 1e-30)
    nodes = len(twin.topology.nodes)
    degree = np.bincount(pairs.ravel(), minlength=nodes)
    total = np.bincount(pairs.ravel(), np.repeat(np.log(values), 2), minlength=nodes)
    typical = float(np.median(np.log(values))) if count else 0.0
    return np.asarray(np.exp(np.where(degree > 0, total / np.maximum(degree, 1), typical)))


@dataclass(frozen=True, eq=False)
class TwinPicture:
    """Twins of one scene in one frame, and what their colors say."""

    scene: Scene
    takes: Sequence[Prediction]
    frame: int
    quantities: Sequence[Quantity]
    style: Literal["springs", "splats"] = "springs"
    ground: Literal["white", "image"] = "white"
    images: Images = Images()
    device: str = "cpu"

    @cached_property
    def norm(self) -> LogNorm:
        """The range of stiffness, N, that all twins share."""
        values = [_twin(take).material.stiffness[: _twin(take).topology.object_spring_count] for take in self.takes]
        return LogNorm(*stiffness_limits(np.concatenate(values)))

    def node_colors(self, take: Prediction, quantity: Quantity) -> np.ndarray:
        """RGBA [N, 4]."""
        twin = _twin(take)
        if quantity == "stiffness":
            return self._of_stiffness(node_stiffness(twin))
        names, region = np.unique(twin.topology.labels, return_inverse=True)
        return np.asarray(region_colors(len(names))[region])

    def spring_colors(self, take: Prediction, quantity: Quantity) -> np.ndarray:
        """RGBA [S, 4] of object springs."""
        twin, count = _twin(take), _twin(take).topology.object_spring_count
        if quantity == "stiffness":
            return self._of_stiffness(twin.material.stiffness[:count])
        ends = twin.topology.labels[twin.topology.springs[:count]]
        colors = self.node_colors(take, "region")[twin.topology.springs[:count, 0]]
        colors[ends[:, 0] != ends[:, 1]] = CROSSING
        return np.asarray(colors)

    def _of_stiffness(self, values: np.ndarray) -> np.ndarray:
        # A stiffness of 0 has no color on a log scale; it takes that of the lower end.
        return np.asarray(colormaps[COLORS](self.norm(np.clip(values, self.norm.vmin, self.norm.vmax))))

    def paint(self, axis: Axes, take: Prediction, quantity: Quantity) -> None:
        """One panel."""
        view, photo = self.scene.view, self.scene.photo(self.frame)
        axis.set(xticks=[], yticks=[], xlim=(-0.5, view.width - 0.5), ylim=(view.height - 0.5, -0.5), facecolor="white")
        for side in axis.spines.values():
            side.set_visible(self.ground == "image")
            side.set(linewidth=0.5, color="0.7")
        below = self.scene.cut(faded(photo)) if photo is not None and self.ground == "image" else None
        extent = (-0.5, view.width - 0.5, view.height - 0.5, -0.5)
        if self.style == "splats":
            surface = self._surface(take, quantity)
            ground = None if below is None else cv2.resize(below, surface.shape[1::-1], interpolation=cv2.INTER_CUBIC)
            axis.imshow(over_white(surface, ground), extent=extent, aspect="auto", interpolation="antialiased")
        else:
            if below is not None:
                axis.imshow(below, extent=extent, aspect="auto", interpolation="antialiased")
            self._lines(axis, take, quantity)
        hands, depth = view.project(self.scene.hands(self.frame).astype(float))
        style: dict[str, Any] = {"marker": "D", "color": CONTROLLER, "edgecolors": "white", "linewidths": 0.3, "zorder": 5}
        axis.scatter(hands[depth > 0, 0], hands[depth > 0, 1], s=7, **style)

    def _lines(self, axis: Axes, take: Prediction, quantity: Quantity) -> None:
        """Springs and nodes, the farthest first, so that the nearest are on top."""
        twin, nodes = _twin(take), take.positions[self.frame].astype(float)
        flat, depth = self.scene.view.project(nodes)
        count = twin.topology.object_spring_count
        chosen = sample(count)
        pairs = twin.topology.springs[chosen]
        order = np.argsort(-depth[pairs].mean(axis=1), kind="stable")
        order = order[(depth[pairs[order]] > 0).all(axis=1)]
        width = points_across(axis)
        colors = self.spring_colors(take, quantity)[chosen][order]
        thick = float(np.clip(0.06 * width / np.sqrt(max(len(order), 1)), 0.25, 1.4))
        many = len(order) > MOST_VECTORS
        axis.add_collection(LineCollection(list(flat[pairs[order]]), colors=colors, linewidths=thick, rasterized=many, zorder=2))
        if quantity == "stiffness":
            return
        near = np.argsort(-depth)
        near = near[depth[near] > 0]
        size = float(np.clip((0.2 * width) ** 2 / max(len(nodes), 1), 1.0, 14.0))
        axis.scatter(flat[near, 0], flat[near, 1], c=self.node_colors(take, quantity)[near], s=size, linewidths=0, zorder=3)

    def _surface(self, take: Prediction, quantity: Quantity) -> np.ndarray:
        """The splats [h, w, 4] over black, each in the color of the surface node that is nearest in frame 0."""
        assert take.splats is not None
        outer = take.positions[0][: self.scene.observations.surface_count]
        nearest = cKDTree(outer).query(take.splats.means)[1]
        rgb = self.node_colors(take, quantity)[nearest, :3]
        (gaussians,) = (found for _, found in take.gaussians([self.frame], self.images, self.device))
        plain = torch.tensor((rgb - 0.5) / C0, dtype=torch.float32, device=self.device)[:, None]
        painted: Gaussians = replace(gaussians, harmonics=plain)
        view = view_of(finer(self.scene.view, FINE), self.images, self.device)
        return picture(painted, view, choose_backend(self.images.backend, self.device))


def body_figure(body: TwinPicture, width: float) -> Figure:
    """The picture, `width` inches wide: methods from left to right, quantities from top to bottom, each with its legend."""
    view, columns = body.scene.view, len(body.takes)
    across = (width - 2 * EDGE - BAR - GAP * (columns - 1)) / columns
    high = across * view.height / view.width
    total = TITLE + len(body.quantities) * (high + GAP) + EDGE
    figure = plt.figure(figsize=(width, total))
    top = total - TITLE
    for column, take in enumerate(body.takes):
        middle = EDGE + column * (across + GAP) + across / 2
        figure.text(middle / width, (top + 0.05) / total, take.label, ha="center", va="bottom", fontsize=TEXT)
    for quantity in body.quantities:
        for column, take in enumerate(body.takes):
            axis = place(figure, EDGE + column * (across + GAP), top - high, across, high)
            body.paint(axis, take, quantity)
        legend = width - EDGE - BAR
        if quantity == "stiffness":
            tall = min(high, 1.8)
            cax = place(figure, legend + 0.1, top - 0.5 * (high + tall) + 0.06, 0.09, tall - 0.12)
            color_bar(figure, cax, body.norm, COLORS, "stiffness [N]", extend="both")
        else:
            _regions(figure, body, legend, top - high / 2)
        top -= high + GAP
    return figure


def _regions(figure: Figure, body: TwinPicture, left: float, middle: float) -> None:
    """Names of the regions; twins of one scene are divided alike, and the one with most regions names them all."""
    count = max(len(np.unique(_twin(take).topology.labels)) for take in body.takes)
    width, height = figure.get_size_inches()
    dots = [Line2D([], [], ls="", marker="o", ms=4, color=color) for color in region_colors(count)]
    names = [f"region {k}" for k in range(count)] if count > 1 else ["one region"]
    if count > 1 and body.style == "springs":
        dots.append(Line2D([], [], color=CROSSING, linewidth=1.0))
        names.append("between")
    style = {"fontsize": TEXT - 1.5, "frameon": False, "handlelength": 0.8, "handletextpad": 0.3, "borderaxespad": 0.1}
    figure.legend(dots, names, loc="center left", bbox_to_anchor=(left / width, middle / height), labelspacing=0.25, **style)


def _twin(take: Prediction) -> Twin:
    assert take.twin is not None
    return take.twin
