"""Anchors in frame 0: their directed neighbors, the controllers' links to them, and how points are bound to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.spatial import cKDTree

from neuspring.core.artifacts import Artifact, array
from neuspring.core.errors import InputError, NumericalFailure

SHORTEST_LINK = 1e-4
"""Rest lengths of controller links are floored here, m: a controller may lie on an anchor."""
NEAREST = 1e-12
"""Distances to anchors are floored here before a weight is computed from them, m."""


@dataclass(frozen=True, kw_only=True)
class AnchorGraph(Artifact):
    """Which anchors and controllers each anchor feels. Springs are directed: row i is what anchor i feels."""

    kind: ClassVar[str] = "anchor_graph"
    anchors: np.ndarray = array("N,3", np.float32, "m", "positions in frame 0")
    neighbors: np.ndarray = array("N,K", np.int32, "1", "the K nearest other anchors, nearest first")
    lengths: np.ndarray = array("N,K", np.float32, "m", "their distances in frame 0, the rest lengths")
    link_starts: np.ndarray = array("L", np.int32, "1", "links of anchor i: link_starts[i] to link_starts[i + 1]")
    links: np.ndarray = array("M", np.int32, "1", "controller of each link")
    link_lengths: np.ndarray = array("M", np.float32, "m", "rest lengths of links")

    def check(self) -> None:
        anchors = len(self.anchors)
        if len(self.link_starts) != anchors + 1:
            raise InputError("spring_gaus.link_starts", f"{anchors + 1} entries are required", len(self.link_starts))
        if self.neighbors.size and not 0 <= self.neighbors.min() <= self.neighbors.max() < anchors:
            raise InputError("spring_gaus.neighbors", f"indices must lie in [0, {anchors})", int(self.neighbors.max()))
        if (self.lengths <= 0).any() or (self.link_lengths <= 0).any():
            raise InputError("spring_gaus.lengths", "every rest length must be positive", "0 or less")

    @classmethod
    def between(cls, anchors: np.ndarray, controllers: np.ndarray, neighbors: int, reach: float, link_count: int) -> AnchorGraph:
        """The graph of anchors [N, 3] and controllers [C, 3] of frame 0, m.

        Each controller is linked to its at most `link_count` nearest anchors within `reach`, m. Raises NumericalFailure if there
        are too few anchors, or two at one place.
        """
        if len(anchors) <= neighbors:
            raise NumericalFailure(f"more anchors than neighbors ({neighbors}) are required, and there are {len(anchors)}")
        tree = cKDTree(anchors)
        distance, index = tree.query(anchors, k=neighbors + 1)
        if distance[:, 1].min() <= 0:
            raise NumericalFailure(f"two anchors lie at one place: {int(distance[:, 1].argmin())}")
        link_distance, near = tree.query(controllers, k=min(link_count, len(anchors)), distance_upper_bound=reach)
        link_distance, near = link_distance.reshape(len(controllers), -1), near.reshape(len(controllers), -1)
        controller, slot = np.nonzero(np.isfinite(link_distance))
        anchor, length = near[controller, slot], np.maximum(link_distance[controller, slot], SHORTEST_LINK)
        order = np.lexsort((controller, anchor))
        return AnchorGraph(
            anchors=anchors,
            # The nearest is the anchor itself: distances of others are positive.
            neighbors=index[:, 1:],
            lengths=distance[:, 1:],
            link_starts=np.searchsorted(anchor[order], np.arange(len(anchors) + 1)),
            links=controller[order],
            link_lengths=length[order],
        )

    @property
    def link_anchors(self) -> np.ndarray:
        """[M] the anchor of each link."""
        return np.repeat(np.arange(len(self.anchors)), np.diff(self.link_starts))


def choose_anchors(points: np.ndarray, count: int, cells: tuple[float, ...], draw: np.random.Generator) -> np.ndarray:
    """`count` random centers [N, 3] of occupied cells of a grid, m.

    The grid has the first of the sizes `cells`, m, with so many occupied cells. If none has, all centers of the last are returned.
    """
    for size in cells:
        centers = (np.unique(np.floor(points / size).astype(np.int64), axis=0) + 0.5) * size
        if len(centers) >= count:
            return centers[np.sort(draw.choice(len(centers), count, replace=False))]
    return centers


@dataclass(frozen=True)
class Binding:
    """How points follow anchors: weights w proportional to distance^(-power) at frame 0, over the nearest anchors."""

    indices: np.ndarray
    """[P, k] int32."""
    weights: np.ndarray
    """[P, k], rows add up to 1."""

    @classmethod
    def of(cls, points: np.ndarray, anchors: np.ndarray, count: int, power: float = 0.5) -> Binding:
        """Bind points [P, 3] to their `count` nearest anchors [N, 3] of frame 0, m."""
        distance, index = cKDTree(anchors).query(points, k=min(count, len(anchors)))
        weights = np.maximum(distance.reshape(len(points), -1), NEAREST) ** -power
        weights /= weights.sum(axis=1, keepdims=True)
        return cls(index.reshape(weights.shape).astype(np.int32), weights.astype(np.float32))
