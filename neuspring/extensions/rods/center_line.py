"""The center line of a long thin body, found among its nodes: distances along the body, then a smooth curve (a principal curve)."""

from __future__ import annotations

import numpy as np

from neuspring.core.errors import InputError
from neuspring.extensions.rods.nodes import bind
from neuspring.extensions.rods.rod import arc_of, pieces

LEAST_SLENDERNESS = 8.0
"""Length over radius below which a body is no rod: bending would shear it as much."""
BESIDE_LINE, MOST_BESIDE = 3.0, 0.1
"""Nodes farther from the line than this times the median lie beside it, and the largest part of them. A cylinder has none: at most
1.4 times the median."""
LINE_NEIGHBORS = 12
"""Nearest nodes along which distances on the body are measured."""
MOST_LINE_NODES = 3000
"""Nodes that decide on the line, at most; of more, evenly chosen ones."""
LINE_ROUNDS = 4
"""Fits of the line, each with the arc of the one before."""
LINE_SAMPLES = 400
"""Points of the smooth line, to which nodes are projected."""
PIECES = 0.15
"""Pieces of the spline per radius of length: one in about seven radii, so that it does not follow the surface."""
SPLINE_PENALTY = 1e-3
"""Weight of the spline's second differences, where the mean weight of a piece's points is 1."""


def center_line(nodes: np.ndarray, count: int, where: str = "observations") -> np.ndarray:
    """Vertices [count, 3], m, at equal distances along a smooth line through a long thin body of nodes [N, 3], m.

    A principal curve: the first arc of a node is its distance along the body from an end (the node farthest from the one that is
    farthest from any). Then cubic splines x(s) are fitted, and each node takes the arc of the nearest point. Does not depend on the
    order of the nodes. Raises InputError, naming `where`, if the body is not long and thin, or has branches.
    """
    points = np.asarray(nodes, np.float64)
    points = points[np.lexsort(points.T)]
    points = points[:: -(-len(points) // MOST_LINE_NODES)]
    arc = _from_an_end(points)
    weights, slenderness = np.ones(len(points)), LEAST_SLENDERNESS
    for _ in range(LINE_ROUNDS):
        line = _spline(arc, points, weights, int(np.clip(PIECES * slenderness, 2, count // 2)))
        arc, apart = _projected(points, line)
        # What lies far beside the line, as points of a hand, hardly pulls it.
        typical = max(float(np.median(apart)), 1e-9)
        weights = 1 / (1 + (apart / (0.67 * BESIDE_LINE * typical)) ** 8)
        length = float(pieces(line).sum())
        slenderness = min(length / max(float(np.quantile(apart, 0.9)), 1e-9), 1e3)
    limit = BESIDE_LINE * typical + 1e-3 * length
    beside = float((apart > limit).mean())
    if slenderness < LEAST_SLENDERNESS or beside > MOST_BESIDE:
        rule = f"a rod is long and thin: its nodes lie around one line without branches, at least {LEAST_SLENDERNESS:g} radii long"
        found = f"{slenderness:.1f} radii" if slenderness < LEAST_SLENDERNESS else f"{beside:.0%} of the nodes far beside the line"
        raise InputError(f"{where}, nodes of frame 0", rule, found, "Choose a method whose twin is a lattice.")
    return _equally_spaced(line, arc[apart < limit], count)


def _from_an_end(points: np.ndarray) -> np.ndarray:
    """Distance of each node along the body from one of its ends [N], m; the end that comes first in x, then y, z."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
    from scipy.spatial import cKDTree
    from scipy.spatial.distance import cdist

    near, partner = cKDTree(points).query(points, k=min(LINE_NEIGHBORS, len(points)))
    rows = np.repeat(np.arange(len(points)), near.shape[1])
    # The tree joins parts that no near neighbor does.
    tree = minimum_spanning_tree(cdist(points, points)).tocoo()
    both = (np.concatenate([rows, tree.row]), np.concatenate([partner.ravel(), tree.col]))
    lengths, index = np.concatenate([near.ravel(), tree.data]), np.sort(np.stack(both), axis=0)
    _, first = np.unique(index, axis=1, return_index=True)
    shape = (len(points), len(points))
    graph = coo_array((lengths[first], (index[0, first], index[1, first])), shape=shape).tocsr()

    def far(node: int) -> np.ndarray:
        return np.asarray(dijkstra(graph, directed=False, indices=node))

    one = int(far(0).argmax())
    other = int(far(one).argmax())
    return far(min((one, other), key=lambda node: tuple(points[node])))


def _spline(arc: np.ndarray, points: np.ndarray, weights: np.ndarray, pieces: int) -> np.ndarray:
    """Points [LINE_SAMPLES, 3] of the cubic spline of equal pieces that is nearest to points [N, 3] with weights [N] at arcs [N].

    Its second differences are penalized a little (a P-spline), which decides where there are no points.
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
    """Arc of the nearest point of a polyline for each point [N], beyond its ends too, and the distance from there [N], m."""
    ends = 2 * line[[0, -1]] - line[[1, -2]]
    reach = len(line) // 8
    before, after = (line[[k]] + np.arange(1, reach + 1)[:, None] * (end - line[k]) for k, end in ((0, ends[0]), (-1, ends[1])))
    longer = np.concatenate([before[::-1], line, after])
    edge, place = bind(longer, np.zeros((len(longer) - 1, 3)), points)
    lengths, part = pieces(longer), np.clip(place[:, 0], 0, 1)
    arc = arc_of(lengths)[edge] + part * lengths[edge]
    foot = longer[edge] + part[:, None] * np.diff(longer, axis=0)[edge]
    return arc - lengths[:reach].sum(), np.linalg.norm(points - foot, axis=1)


def _equally_spaced(line: np.ndarray, arc: np.ndarray, count: int) -> np.ndarray:
    """Points [count, 3] at equal arcs of a polyline, from the least to the largest arc of the nodes [N]."""
    own = arc_of(pieces(line))
    at = np.linspace(max(arc.min(), 0.0), min(arc.max(), own[-1]), count)
    return np.stack([np.interp(at, own, column) for column in line.T], axis=1)
