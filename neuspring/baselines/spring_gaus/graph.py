"""Anchors, their directed neighbours, the controllers' links, and how points are bound to anchors; all of frame 0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from neuspring.core.errors import NumericalFailure

SHORTEST_LINK = 1e-4
"""Rest lengths of controller links are floored here, m: a controller may lie on an anchor."""
NEAREST = 1e-12
"""Distances to anchors are floored here where a weight is made of them, m."""


@dataclass(frozen=True)
class AnchorGraph:
    """Who pulls whom. Springs are directed: row i is what anchor i feels."""

    anchors: np.ndarray
    """[N, 3] m, at frame 0."""
    neighbours: np.ndarray
    """[N, K] int32: the K nearest other anchors, nearest first."""
    lengths: np.ndarray
    """[N, K] m: their distances at frame 0, the rest lengths."""
    link_starts: np.ndarray
    """[N + 1] int32: links of anchor i are `link_starts[i]:link_starts[i + 1]`."""
    links: np.ndarray
    """[M] int32: a controller for each link."""
    link_lengths: np.ndarray
    """[M] m: rest lengths of the links."""

    @classmethod
    def of(cls, anchors: np.ndarray, controllers: np.ndarray, neighbours: int, reach: float, link_count: int) -> AnchorGraph:
        """Of anchors [N, 3] and controllers [C, 3] at frame 0, m.

        Each controller is linked to its at most `link_count` nearest anchors within `reach`, m. Raises NumericalFailure if there
        are too few anchors, or two at one place.
        """
        if len(anchors) <= neighbours:
            raise NumericalFailure(f"more anchors than neighbours ({neighbours}) are required, and there are {len(anchors)}")
        tree = cKDTree(anchors)
        distance, index = tree.query(anchors, k=neighbours + 1)
        if distance[:, 1].min() <= 0:
            raise NumericalFailure(f"two anchors lie at one place: {int(distance[:, 1].argmin())}")
        # The nearest is the anchor itself: distances of others are positive.
        distance, index = distance[:, 1:], index[:, 1:]
        away, near = tree.query(controllers, k=min(link_count, len(anchors)), distance_upper_bound=reach)
        away, near = away.reshape(len(controllers), -1), near.reshape(len(controllers), -1)
        controller, slot = np.nonzero(np.isfinite(away))
        anchor, length = near[controller, slot], np.maximum(away[controller, slot], SHORTEST_LINK)
        order = np.lexsort((controller, anchor))
        starts = np.searchsorted(anchor[order], np.arange(len(anchors) + 1))
        return cls(
            anchors.astype(np.float32),
            index.astype(np.int32),
            distance.astype(np.float32),
            starts.astype(np.int32),
            controller[order].astype(np.int32),
            length[order].astype(np.float32),
        )

    @property
    def link_anchors(self) -> np.ndarray:
        """[M] the anchor of each link."""
        return np.repeat(np.arange(len(self.anchors)), np.diff(self.link_starts))


def choose_anchors(points: np.ndarray, count: int, cells: tuple[float, ...], draw: np.random.Generator) -> np.ndarray:
    """`count` centres [N, 3] of occupied cells of a grid, at random; of the first of the cell sizes, m, that has so many.

    All centres of the finest grid if none has.
    """
    for size in cells:
        centres = (np.unique(np.floor(points / size).astype(np.int64), axis=0) + 0.5) * size
        if len(centres) >= count:
            return centres[np.sort(draw.choice(len(centres), count, replace=False))]
    return centres


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
