"""Masses of nodes from the volume that each stands for.

Nodes are neighbors if no third one lies in the ball whose diameter joins them (the Gabriel graph, a part of Delaunay's). A node's
share of a line, a sheet or a solid is taken as the sum of l^d over its neighbors' distances l, with d = 1, 2 or 3 the dimension
that the cloud looks like. Nodes at an end, an edge or a surface have fewer neighbors, and so less mass, as their cells are cut
there. On a chain this is exact: half of both gaps.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

NEAREST = 24
"""Nodes that may be neighbors of a node, and that may come between."""
TIE = 1e-6
"""A third node this near the ball, relative to its squared diameter, is in it: diagonals of a lattice join nobody."""


def volume_masses(nodes: np.ndarray) -> np.ndarray:
    """Masses [N] with mean 1 of nodes [N, 3], m; all 1 where the nodes are too few or lie too close for a volume."""
    points = np.asarray(nodes, np.float64)
    if len(points) < 3:
        return np.ones(len(points))
    distance, near = cKDTree(points).query(points, k=min(NEAREST + 1, len(points)))
    distance, near = distance[:, 1:], near[:, 1:]
    power = dimension(distance)
    # [N, k, k]: squared distances of neighbor j from third nodes.
    third = ((points[near][:, :, None] - points[near][:, None]) ** 2).sum(axis=-1)
    between = distance[:, None] ** 2 + third <= (1 + TIE) * distance[:, :, None] ** 2
    between &= ~np.eye(near.shape[1], dtype=bool)
    first, column = np.nonzero(~between.any(axis=2))
    pairs = np.unique(np.sort(np.stack([first, near[first, column]], axis=1), axis=1), axis=0)
    shares = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) ** power
    total = np.bincount(pairs.ravel(), np.repeat(shares, 2), len(points))
    if not total.all():
        return np.ones(len(points))
    masses: np.ndarray = total / total.mean()
    return masses


def dimension(distance: np.ndarray) -> int:
    """1, 2 or 3: how the number of nodes grows with the radius, from distances [N, k] to nearest nodes (Levina and Bickel 2004)."""
    far, rest = (np.maximum(values, 1e-12) for values in (distance[:, -1:], distance[:, :-1]))
    inverse = np.log(far / rest).mean()
    return int(np.clip(np.round(1 / max(inverse, 1e-3)), 1, 3))
