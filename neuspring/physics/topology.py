"""From points to a spring graph (as the released PhysTwin code makes it), uniform or piecewise (the paper's piecewise topology).

Every object node asks for its nearest nodes within a radius; every controller asks for its nearest object nodes. A spring is made
if either end asks for it. In a piecewise topology each region of nodes has
its own radius and number of neighbors; a node asks among all nodes, with its own region's values, so regions stay joined.
A body is one piece: what no spring joins to the rest, a node or a part behind a gap in what was seen, is joined along its seam.
Radii of a search are in units of the spacing of the nodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from neuspring.core.artifacts import NO_REST_SHAPE, Topology, canonical_shape
from neuspring.core.errors import InputError

TREE_NEIGHBORS = 16
"""Nearest nodes among which the tree is looked for: more than a ring or a voxel's corner has."""
TREE_QUANTILE = 0.9
"""Quantile of the tree's edges that is the spacing."""


def nearest(nodes: np.ndarray, points: np.ndarray, count: int, reach: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
    """Distances, m, and indices [P, k] of the `count` nearest nodes of points [P, 3], or all; infinite from `reach` on."""
    from scipy.spatial import cKDTree

    distance, index = cKDTree(nodes).query(points, k=np.arange(1, min(count, len(nodes)) + 1), distance_upper_bound=reach)
    return distance, index


def node_spacing(nodes: np.ndarray) -> float:
    """Distance between neighboring nodes of a body [N, 3], m: the 0.9 quantile of the edges of its minimum spanning tree.

    The tree joins all nodes by the shortest edges that do. Its longest edges lead across gaps: from ring to ring of a body whose
    nodes are nearer to each other within a ring, and from voxel to voxel where a body was sampled on voxels. So a radius of one
    spacing joins the body. The median distance of nearest neighbors does not: nodes of a voxel grid come in close pairs, those of a
    ring are near each other. The last tenth of the edges is left out because of holes in what was seen.
    Scales with the nodes and does not depend on their order. Raises InputError if no two nodes lie apart.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import minimum_spanning_tree

    points = np.asarray(nodes, np.float64)
    distance, partner = nearest(points, points, TREE_NEIGHBORS + 1)
    first = np.repeat(np.arange(len(points)), distance.shape[1])
    # Where all neighbors are nearer than the next part of the body, the tree is a forest: the few edges between are not missed.
    near = coo_array((distance.ravel(), (first, partner.ravel())), shape=(len(points), len(points)))
    edges = minimum_spanning_tree(near.tocsr()).data
    edges = edges[edges > 0]
    if not len(edges):
        raise InputError("observations", "at least two nodes at different places are required", f"{len(points)} nodes")
    return float(np.quantile(edges, TREE_QUANTILE))


def controller_reach(nodes: np.ndarray, controllers: np.ndarray) -> float:
    """Smallest distance between a controller [C, 3] and a node [N, 3], m: a smaller radius holds nothing.

    Of a filmed hand most points are on fingers and forearm, far from what it holds, so the mean distance says nothing.
    """
    return float(nearest(np.asarray(nodes, np.float64), np.asarray(controllers, np.float64), 1)[0].min())


MIN_LENGTH = 1e-4
"""Shorter object springs are not made, m."""
REPAIR_SPRINGS = 3
"""Springs given to a node of a seam: the fewest that can hold a point in space."""


REGION_STEP = 1 / 128
"""Node spacings to which places of nodes are rounded where regions are made: more than float32 loses, less than matters. Places on
half a step would be rounded by chance; those of lattices lie on simple fractions of a spacing."""


def regions(nodes: np.ndarray, count: int) -> np.ndarray:
    """Region of each node [N], 0 .. count - 1, by agglomerative clustering (Ward) of nodes [N, 3], m.

    Regions are numbered by their centroids (x, then y, then z). Neither unit nor order of the nodes matters, on lattices too, where
    nearly all merges are ties: nodes are clustered by whole steps of `REGION_STEP`, in the order of their places.
    Raises InputError if there are fewer nodes than regions.
    """
    if count < 1:
        raise InputError("clusters", "at least one region is required", count, "Choose 1 or more.")
    if count == 1:
        return np.zeros(len(nodes), np.int32)
    if len(nodes) < count:
        rule = f"{count} regions need at least {count} nodes"
        raise InputError("clusters", rule, f"{len(nodes)} nodes", "Choose fewer regions.")
    # Imported here: it takes longer than most commands that need a topology.
    from sklearn.cluster import AgglomerativeClustering

    points = np.asarray(nodes, np.float64)
    places = np.round((points - points.min(axis=0)) / (REGION_STEP * node_spacing(points)))
    order = np.lexsort(places.T[::-1])
    clusters = np.empty(len(places), np.int64)
    clusters[order] = AgglomerativeClustering(n_clusters=count, linkage="ward").fit_predict(places[order])
    # Far below any distance between regions, far above rounding, so ties between equal coordinates are seen as ties.
    centroids = np.round([places[clusters == label].mean(axis=0) for label in range(count)], 6)
    number = np.empty(count, np.int32)
    number[np.lexsort(centroids.T[::-1])] = np.arange(count)
    return number[clusters]


def joined(nodes: np.ndarray, springs: np.ndarray) -> np.ndarray:
    """The springs [S, 2] between nodes [N, 3], m, followed by those that make the body one piece.

    Each piece asks for springs, but the one that is larger than all others: its nodes from which the rest is at most a node spacing
    farther than from the nearest of them, each from its 3 nearest nodes of the rest. So a single node has 3 springs, and a part
    behind a gap a seam.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    count, spacing = len(nodes), 0.0
    while True:
        graph = coo_array((np.ones(len(springs)), springs.T), shape=(count, count))
        pieces, piece = connected_components(graph, directed=False)
        if pieces <= 1:
            return springs
        spacing, sizes, added = spacing or node_spacing(nodes), np.bincount(piece), [springs]
        largest = np.flatnonzero(sizes == sizes.max())
        for label in np.setdiff1d(np.arange(pieces), largest if len(largest) == 1 else []):
            own, rest = np.flatnonzero(piece == label), np.flatnonzero(piece != label)
            # Nodes at the same place are no partners.
            same = max(cKDTree(nodes[rest]).query_ball_point(nodes[own], MIN_LENGTH, return_length=True))
            distance, partner = nearest(nodes[rest], nodes[own], REPAIR_SPRINGS + same)
            usable = distance > MIN_LENGTH
            away = np.where(usable, distance, np.inf).min(axis=1)
            row, column = np.nonzero(usable & (usable.cumsum(axis=1) <= REPAIR_SPRINGS) & (away <= away.min() + spacing)[:, None])
            added.append(np.stack([own[row], rest[partner[row, column]]], axis=1))
        if len(more := _first_of_each(np.concatenate(added), count)) == len(springs):
            return springs
        springs = more


def object_springs(nodes: np.ndarray, radius: np.ndarray, neighbors: np.ndarray) -> np.ndarray:
    """Springs between object nodes, [S, 2], in the order in which they are first asked for.

    Node i asks for its `neighbors[i]` nearest nodes, itself included, at a distance below `radius[i]` [m].
    """
    distance, partner = nearest(nodes, nodes, int(neighbors.max()), float(radius.max()))
    rank = np.arange(distance.shape[1])
    # The first hit is the node itself (or an exact duplicate, which the length rule would refuse anyway).
    wanted = (rank > 0) & (rank < neighbors[:, None]) & (distance < radius[:, None]) & (distance > MIN_LENGTH)
    first, column = np.nonzero(wanted)
    return _first_of_each(np.stack([first, partner[first, column]], axis=1), len(nodes))


def _first_of_each(pairs: np.ndarray, count: int) -> np.ndarray:
    """Keep the first occurrence of every unordered pair."""
    ordered = np.sort(pairs, axis=1)
    _, index = np.unique(ordered[:, 0] * count + ordered[:, 1], return_index=True)
    return pairs[np.sort(index)]


def controller_springs(nodes: np.ndarray, controllers: np.ndarray, radius: float, neighbors: int) -> np.ndarray:
    """Springs from controllers to object nodes, [S, 2] as (N + controller, node)."""
    distance, partner = nearest(nodes, controllers, neighbors, radius)
    controller, column = np.nonzero(distance < radius)
    return np.stack([len(nodes) + controller, partner[controller, column]], axis=1)


def distances(points: np.ndarray, springs: np.ndarray) -> np.ndarray:
    """Distance of the ends of each spring [S], m, in double precision."""
    ends = points.astype(np.float64)[springs.reshape(-1, 2)]
    return np.asarray(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1))


def unloaded(
    nodes: np.ndarray, controllers: np.ndarray, springs: np.ndarray, rest_shape: np.ndarray, controller_rest: str = "rest_shape"
) -> np.ndarray:
    """Distance of the ends of each spring [S], m, in the shape where it has no force (double precision).

    That is the rest shape [N + C, 3], m, or frame 0 where it is empty. With `controller_rest` first_frame it is frame 0 for the
    springs of controllers: hands took hold of the body as it was there.
    """
    lengths = distances(canonical_shape(nodes, controllers, rest_shape), springs)
    if controller_rest == "first_frame":
        held = (springs >= len(nodes)).any(axis=1)
        lengths[held] = distances(np.concatenate([nodes, controllers]), springs[held])
    return lengths


def build(
    nodes: np.ndarray,
    controllers: np.ndarray,
    springs: np.ndarray,
    labels: np.ndarray | None = None,
    rest_shape: np.ndarray = NO_REST_SHAPE,
    controller_rest: str = "rest_shape",
) -> Topology:
    """A Topology whose rest lengths are the distances of `unloaded` (rounded to float32)."""
    lengths = unloaded(nodes, controllers, springs, rest_shape, controller_rest)
    if (lengths <= 0).any():
        pair = f"zero-length spring {springs[int(np.argmin(lengths))].tolist()}"
        raise InputError("topology", "a controller may not coincide with an object node", pair, "Move or drop that point.")
    return Topology(
        nodes=nodes,
        controllers=controllers,
        springs=springs.reshape(-1, 2).astype(np.int32),
        rest_lengths=lengths,
        labels=np.zeros(len(nodes), np.int32) if labels is None else labels,
        rest_shape=rest_shape,
        controller_rest=controller_rest,
    )


def piecewise_topology(
    nodes: np.ndarray,
    controllers: np.ndarray,
    labels: np.ndarray,
    object_radius: Sequence[float],
    object_neighbors: Sequence[int],
    controller_radius: float,
    controller_neighbors: int,
    *,
    repair: bool = False,
    rest_shape: np.ndarray = NO_REST_SHAPE,
    controller_rest: str = "rest_shape",
) -> Topology:
    """A radius [m] and a neighbor count (self included) per region; `labels` [N] says which region a node belongs to.

    Neighbors are looked for in the rest shape [N + C, 3], m, where one is given, else in frame 0. `repair` makes the body one
    piece (`joined`). Rest lengths: `unloaded`. Raises InputError if a controller coincides with a node.
    """
    canonical = np.asarray(canonical_shape(nodes, controllers, rest_shape), np.float64)
    points, hands = canonical[: len(nodes)], canonical[len(nodes) :]
    inner = object_springs(points, np.asarray(object_radius, np.float64)[labels], np.asarray(object_neighbors)[labels])
    outer = controller_springs(points, hands, controller_radius, controller_neighbors)
    if repair:
        inner = joined(points, inner)
    springs = np.concatenate([inner, outer])
    return build(np.asarray(nodes), np.asarray(controllers), springs, labels, rest_shape, controller_rest)


def uniform_topology(
    nodes: np.ndarray, controllers: np.ndarray, object_radius: float, object_neighbors: int, *of_controllers: Any
) -> Topology:
    """One radius [m] and one neighbor count (self included) for the whole object; `of_controllers` are theirs.

    Raises InputError if a controller coincides with a node.
    """
    one = np.zeros(len(nodes), np.int32)
    return piecewise_topology(nodes, controllers, one, [object_radius], [object_neighbors], *of_controllers)


RADIUS_MARGIN = 1 + 1e-6
"""Factor on radii, so that the longest spring is made again."""


def infer_controller_radius(topology: Topology) -> tuple[float, int]:
    """Radius, m, and number of nodes that make the controller springs of a topology again."""
    springs = topology.springs[topology.object_spring_count :]
    if not len(springs):
        return 1e-9, 1
    hands = springs.max(axis=1) - len(topology.nodes)
    return float(distances(topology.canonical, springs).max()) * RADIUS_MARGIN, int(np.bincount(hands).max())
