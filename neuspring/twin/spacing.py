"""Lengths of a body that the search measures its radii in: the distance between its nodes, and how near its controllers are."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import cKDTree

from neuspring.core.errors import InputError

NEIGHBORS = 16
"""Nearest nodes among which the tree is looked for: more than a ring or a voxel's corner has."""
SHARE = 0.9
"""Quantile of the tree's edges."""


def node_spacing(nodes: np.ndarray) -> float:
    """Distance between neighboring nodes of a body [N, 3], m: the 0.9 quantile of the edges of its minimum spanning tree.

    The tree joins all nodes by the shortest edges that do. Its longest edges lead across gaps: from ring to ring of a cable, whose
    nodes are nearer to each other within a ring, and from voxel to voxel where a body was sampled on voxels. So a radius of one
    spacing joins the body. The median distance of nearest neighbors does not: nodes of a voxel grid come in close pairs, those of a
    ring are near each other. The last tenth of the edges is left out because of holes in what was seen.
    Scales with the nodes and does not depend on their order. Raises InputError if no two nodes lie apart.
    """
    points = np.asarray(nodes, np.float64)
    count = min(NEIGHBORS + 1, len(points))
    distance, partner = cKDTree(points).query(points, k=count)
    first = np.repeat(np.arange(len(points)), count)
    # Where all neighbors are nearer than the next part of the body, the tree is a forest: the few edges between are not missed.
    near = coo_array((distance.ravel(), (first, partner.ravel())), shape=(len(points), len(points)))
    edges = minimum_spanning_tree(near.tocsr()).data
    edges = edges[edges > 0]
    if not len(edges):
        raise InputError("observations", "at least two nodes at different places are required", f"{len(points)} nodes")
    return float(np.quantile(edges, SHARE))


def controller_reach(nodes: np.ndarray, controllers: np.ndarray) -> float:
    """Smallest distance between a controller [C, 3] and a node [N, 3], m: a smaller radius holds nothing.

    Of a filmed hand most points are on fingers and forearm, far from what it holds, so the mean distance says nothing.
    """
    return float(cKDTree(np.asarray(nodes, np.float64)).query(np.asarray(controllers, np.float64))[0].min())
