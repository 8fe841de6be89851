"""The spring graph of points, as in the released PhysTwin code: uniform, or piecewise (the paper's piecewise topology).

Every object node selects its nearest nodes within a radius, and every controller its nearest object nodes. Two points share a
spring if at least one of them selects the other. In a piecewise topology, each region of nodes has its own radius and number of
neighbors. Nodes select among all nodes, with the values of their own region, so regions stay connected. The repair connects nodes
and parts without a spring to the rest, for example behind a gap in the observations. Radii of a search are in units of the node
spacing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from neuspring.core.artifacts import NO_REST_SHAPE, Topology, canonical_shape
from neuspring.core.errors import InputError

TREE_NEIGHBORS = 16
"""Number of nearest nodes in the graph of the spanning tree: more than the neighbors in a ring or at the corner of a voxel."""
TREE_QUANTILE = 0.9
"""Quantile of the edge lengths of the tree that is the spacing."""


def nearest(nodes: np.ndarray, points: np.ndarray, count: int, reach: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
    """Distances, m, and indices [P, k] of the `count` nearest nodes (at most all) of points [P, 3]; infinite from `reach` on."""
    from scipy.spatial import cKDTree

    distance, index = cKDTree(nodes).query(points, k=np.arange(1, min(count, len(nodes)) + 1), distance_upper_bound=reach)
    return distance, index


def node_spacing(nodes: np.ndarray) -> float:
    """Distance between neighboring nodes [N, 3], m: the 0.9 quantile of the edge lengths of their minimum spanning tree.

    The longest edges of the tree cross gaps, for example between rings or voxels, so a radius of one spacing connects the object.
    The median distance of nearest neighbors does not: nodes of a voxel grid form close pairs, and nodes of a ring are close
    together. The quantile excludes the longest edges, because they may cross holes in the observations.

    The spacing scales with the nodes and does not depend on their order. Raises InputError if all nodes coincide.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import minimum_spanning_tree

    points = np.asarray(nodes, np.float64)
    distance, partner = nearest(points, points, TREE_NEIGHBORS + 1)
    first = np.repeat(np.arange(len(points)), distance.shape[1])
    # If parts are farther apart than all neighbors, the tree is a forest. The few missing edges hardly change the quantile.
    near = coo_array((distance.ravel(), (first, partner.ravel())), shape=(len(points), len(points)))
    edges = minimum_spanning_tree(near.tocsr()).data
    edges = edges[edges > 0]
    if not len(edges):
        raise InputError("observations", "at least two nodes at different positions are required", f"{len(points)} nodes")
    return float(np.quantile(edges, TREE_QUANTILE))


def controller_reach(nodes: np.ndarray, controllers: np.ndarray) -> float:
    """Smallest distance between a controller [C, 3] and a node [N, 3], m. A smaller radius creates no controller spring.

    The mean distance is not suitable: most controllers of a recorded hand are on fingers and forearm, far from the object.
    """
    return float(nearest(np.asarray(nodes, np.float64), np.asarray(controllers, np.float64), 1)[0].min())


MIN_LENGTH = 1e-4
"""Smallest length of an object spring, m."""
REPAIR_SPRINGS = 3
"""Number of springs that the repair adds to a node: the smallest number that can hold a point in space."""


REGION_STEP = 1 / 128
"""Step to which positions are rounded before clustering, in node spacings: coarser than float32 rounding, too fine to matter.
Nodes of regular lattices are at simple fractions of a spacing, so they are not at half a step."""


def regions(nodes: np.ndarray, count: int) -> np.ndarray:
    """Region of each node [N], 0 .. count - 1, by agglomerative clustering (Ward) of nodes [N, 3], m.

    Regions are numbered by their centroids (x, then y, then z). Nodes are rounded to `REGION_STEP` and sorted by position. So
    neither unit nor order of the nodes matters, even on regular lattices, where nearly all merges are ties. Raises InputError if
    there are fewer nodes than regions.
    """
    if count < 1:
        raise InputError("clusters", "at least one region is required", count, "Choose 1 or more.")
    if count == 1:
        return np.zeros(len(nodes), np.int32)
    if len(nodes) < count:
        rule = f"{count} regions need at least {count} nodes"
        raise InputError("clusters", rule, f"{len(nodes)} nodes", "Choose fewer regions.")
    # Imported here, because the import takes longer than most commands that need a topology.
    from sklearn.cluster import AgglomerativeClustering

    points = np.asarray(nodes, np.float64)
    places = np.round((points - points.min(axis=0)) / (REGION_STEP * node_spacing(points)))
    order = np.lexsort(places.T[::-1])
    clusters = np.empty(len(places), np.int64)
    clusters[order] = AgglomerativeClustering(n_clusters=count, linkage="ward").fit_predict(places[order])
    # Rounding far below the distances between regions keeps ties between equal coordinates.
    centroids = np.round([places[clusters == label].mean(axis=0) for label in range(count)], 6)
    number = np.empty(count, np.int32)
    number[np.lexsort(centroids.T[::-1])] = np.arange(count)
    return number[clusters]


def joined(nodes: np.ndarray, springs: np.ndarray) -> np.ndarray:
    """The springs [S, 2] between nodes [N, 3], m, followed by springs that connect all pieces.

    Every piece except the largest selects springs to the rest. Its nodes along the gap, whose distance to the rest is at most one
    node spacing above the smallest, each select their 3 nearest nodes of the rest. So a single node gets 3 springs.
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
            # Coincident nodes are no partners.
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
    """Springs between object nodes [S, 2], in the order of their first selection.

    Node i selects its `neighbors[i]` nearest nodes, itself included, at distances below `radius[i]`, m.
    """
    distance, partner = nearest(nodes, nodes, int(neighbors.max()), float(radius.max()))
    rank = np.arange(distance.shape[1])
    # Rank 0 is the node itself, or an exact duplicate, which MIN_LENGTH excludes anyway.
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
    """Distance between the ends of each spring [S], m, in float64."""
    ends = points.astype(np.float64)[springs.reshape(-1, 2)]
    return np.asarray(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1))


def unloaded(
    nodes: np.ndarray, controllers: np.ndarray, springs: np.ndarray, rest_shape: np.ndarray, controller_rest: str = "rest_shape"
) -> np.ndarray:
    """Distance between the ends of each spring [S], m, in the shape without forces, in float64.

    That shape is the rest shape [N + C, 3], m, or frame 0 if the rest shape is empty. With `controller_rest` first_frame, it is
    frame 0 for controller springs, because the hands grasp the object in its pose of frame 0.
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
    """A Topology with the rest lengths of `unloaded`, rounded to float32. Raises InputError if a spring has no length."""
    lengths = unloaded(nodes, controllers, springs, rest_shape, controller_rest)
    if (lengths <= 0).any():
        pair = f"zero-length spring {springs[int(np.argmin(lengths))].tolist()}"
        raise InputError("topology", "a controller may not coincide with an object node", pair, "Move or remove this controller.")
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
    """A topology with a radius and a number of neighbors per region.

    - labels: region of each node [N]
    - object_radius, controller_radius: m
    - object_neighbors: self included
    - repair: connect all pieces of the object (`joined`)
    - rest_shape: [N + C, 3], m, in which neighbors are selected; empty: frame 0
    - controller_rest: see `unloaded`, which defines the rest lengths

    Raises InputError if a controller coincides with a node.
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
    """A topology with one radius, m, and one number of neighbors (self included); `of_controllers` are those of the controllers.

    Raises InputError if a controller coincides with a node.
    """
    one = np.zeros(len(nodes), np.int32)
    return piecewise_topology(nodes, controllers, one, [object_radius], [object_neighbors], *of_controllers)


RADIUS_MARGIN = 1 + 1e-6
"""Factor on inferred radii, so that they include the longest spring."""


def infer_controller_radius(topology: Topology) -> tuple[float, int]:
    """Radius, m, and number of nodes that reproduce the controller springs of a topology."""
    springs = topology.springs[topology.object_spring_count :]
    if not len(springs):
        return 1e-9, 1
    hands = springs.max(axis=1) - len(topology.nodes)
    return float(distances(topology.canonical, springs).max()) * RADIUS_MARGIN, int(np.bincount(hands).max())
