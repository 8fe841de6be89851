"""The center line of a long thin object, found among its nodes: a principal curve that starts from distances along the object."""

from __future__ import annotations

import numpy as np

from neuspring.core.errors import InputError
from neuspring.extensions.rods.nodes import bind
from neuspring.extensions.rods.rod import arc_of, pieces

LEAST_SLENDERNESS = 8.0
"""Minimum length of a rod, in radii. A shorter object would shear as much as it bends."""
BESIDE_LINE, MOST_BESIDE = 3.0, 0.1
"""Distance from the line, in medians, above which a node is beside the line, and the maximum fraction of such nodes.

A cylinder has none: its nodes are within 1.4 medians."""
LINE_NEIGHBORS = 12
"""Number of nearest nodes along which distances on the object are measured."""
MOST_LINE_NODES = 3000
"""Maximum number of nodes that are used to find the line; of more nodes, a regular subset is used."""
LINE_ROUNDS = 4
"""Fits of the line, each with the arc lengths of the previous fit."""
LINE_SAMPLES = 400
"""Points of the smooth line onto which nodes are projected."""
PIECES = 0.15
"""Pieces of the spline per radius of length: one in about seven radii, so that it does not follow the surface."""
SPLINE_PENALTY = 1e-3
"""Weight of the spline's second differences, for a mean weight of 1 of a piece's points."""


def center_line(nodes: np.ndarray, count: int, where: str = "observations") -> np.ndarray:
    """Vertices [count, 3], m, at equal distances along a smooth line through the nodes [N, 3], m, of a long thin object.

    The line is a principal curve. First, the arc length of a node is its distance along the object from an end: the node that is
    farthest from the node that is farthest from any node. Then cubic splines x(s) are fitted, and each node gets the arc length
    of the nearest point. The order of the nodes does not matter. Raises InputError, with the name `where`, if the object is not
    long and thin, or has branches.
    """
    points = np.asarray(nodes, np.float64)
    points = points[np.lexsort(points.T)]
    points = points[:: -(-len(points) // MOST_LINE_NODES)]
    arc = _from_an_end(points)
    weights, slenderness = np.ones(len(points)), LEAST_SLENDERNESS
    for _ in range(LINE_ROUNDS):
        line = _spline(arc, points, weights, int(np.clip(PIECES * slenderness, 2, count // 2)))
        arc, apart = _projected(points, line)
        # Nodes far beside the line, for example points of a hand, get a small weight.
        typical = max(float(np.median(apart)), 1e-9)
        weights = 1 / (1 + (apart / (0.67 * BESIDE_LINE * typical)) ** 8)
        length = float(pieces(line).sum())
        slenderness = min(length / max(float(np.quantile(apart, 0.9)), 1e-9), 1e3)
    limit = BESIDE_LINE * typical + 1e-3 * length
    beside = float((apart > limit).mean())
    if slenderness < LEAST_SLENDERNESS or beside > MOST_BESIDE:
        rule = f"a rod must be around one line without branches, at least {LEAST_SLENDERNESS:g} radii long"
        found = f"{slenderness:.1f} radii" if slenderness < LEAST_SLENDERNESS else f"{beside:.0%} of the nodes far beside the line"
        raise InputError(f"{where}, nodes of frame 0", rule, found, "Choose a method whose twin is a lattice.")
    return _equally_spaced(line, arc[apart < limit], count)


def _from_an_end(points: np.ndarray) -> np.ndarray:
    """Distance of each node along the object from one of its ends [N], m: the end that is first by x, then y, then z."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
    from scipy.spatial import cKDTree
    from scipy.spatial.distance import cdist

    near, partner = cKDTree(points).query(points, k=min(LINE_NEIGHBORS, len(points)))
    rows = np.repeat(np.arange(len(points)), near.shape[1])
    # The tree connects components that neighbors do not connect.
    tree = minimum_spanning_tree(cdist(points, points)).tocoo()
    both = (np.concatenate([rows, tree.row]), np.concatenate([partner.ravel(), tree.col]))
    lengths, index = np.concatenate([near.ravel(), tree.data]), np.sort(np.stack(both), axis=0)
    _, first = np.unique(index, axis=1, return_index=True)
    shape = (len(points), len(points))
    graph = coo_array((lengths[first], (index[0, first], index[1, first])), shape=shape).tocsr()

    def far(node: int) -> np.ndarray:
        return np.asarray(dijkstra(graph, directed=False, indices=node))

    end = int(far(0).argmax())
    opposite = int(far(end).argmax())
    return far(min((end, opposite), key=lambda node: tuple(points[node])))


def _spline(arc: np.ndarray, points: np.ndarray, weights: np.ndarray, pieces: int) -> np.ndarray:
    """Points [LINE_SAMPLES, 3] of the cubic spline of equal pieces that fits points [N, 3] with weights [N] at arc lengths [N].

    A small penalty of second differences (a P-spline) regularizes pieces without points.
    """
    from scipy.interpolate import BSpline

    low, high = float(arc.min()), float(arc.max())
    knots = np.concatenate([[low] * 3, np.linspace(low, high, pieces + 1), [high] * 3])
    design = BSpline.design_matrix(arc, knots, 3).toarray()
    bends = np.diff(np.eye(design.shape[1]), n=2, axis=0)
    normal = design.T @ (weights[:, None] * design) + SPLINE_PENALTY * weights.sum() / pieces * bends.T @ bends
    coefficients = np.linalg.solve(normal, design.T @ (weights[:, None] * points))
    return np.asarray(BSpline(knots, coefficients, 3)(np.linspace(low, high, LINE_SAMPLES)))


def _projected(points: np.ndarray, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Arc length of the nearest point of a polyline, extended beyond its ends, for each point [N], and its distance [N], m."""
    ends = 2 * line[[0, -1]] - line[[1, -2]]
    reach = len(line) // 8
    before, after = (line[[k]] + np.arange(1, reach + 1)[:, None] * (end - line[k]) for k, end in ((0, ends[0]), (-1, ends[1])))
    longer = np.concatenate([before[::-1], line, after])
    edge, place = bind(longer, np.zeros((len(longer) - 1, 3)), points)
    lengths, fraction = pieces(longer), np.clip(place[:, 0], 0, 1)
    arc = arc_of(lengths)[edge] + fraction * lengths[edge]
    foot = longer[edge] + fraction[:, None] * np.diff(longer, axis=0)[edge]
    return arc - lengths[:reach].sum(), np.linalg.norm(points - foot, axis=1)


def _equally_spaced(line: np.ndarray, arc: np.ndarray, count: int) -> np.ndarray:
    """Points [count, 3] at equal distances on a polyline, from the least to the largest arc length of the nodes [N]."""
    along = arc_of(pieces(line))
    at = np.linspace(max(arc.min(), 0.0), min(arc.max(), along[-1]), count)
    return np.stack([np.interp(at, along, column) for column in line.T], axis=1)
