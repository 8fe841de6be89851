"""From points to a spring graph (dataset facts, section 5.1).

Every object node asks for its nearest nodes within a radius; every controller asks for its nearest object nodes. The spring
set is the union of all answers: a pair is kept if either side asks for it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from neuspring.artifacts import Topology
from neuspring.errors import InputError

MIN_LENGTH = 1e-4
"""Shorter object springs are not made, m."""


def object_springs(nodes: np.ndarray, radius: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Springs between object nodes, [S, 2], in the order in which they are first asked for.

    Node i asks for its `neighbours[i]` nearest nodes, itself included, at a distance below `radius[i]` [m].
    """
    count = len(nodes)
    k = int(min(neighbours.max(), count))
    distance, partner = cKDTree(nodes).query(nodes, k=k, distance_upper_bound=float(radius.max()))
    distance, partner = distance.reshape(count, k), partner.reshape(count, k)
    rank = np.arange(k)
    # The first hit is the node itself (or an exact duplicate, which the length rule would refuse anyway).
    asked = (rank > 0) & (rank < neighbours[:, None]) & (distance < radius[:, None]) & (distance > MIN_LENGTH)
    first, column = np.nonzero(asked)
    pairs = np.stack([first, partner[first, column]], axis=1)
    return _first_of_each(pairs, count)


def _first_of_each(pairs: np.ndarray, count: int) -> np.ndarray:
    """Keep the first occurrence of every unordered pair."""
    ordered = np.sort(pairs, axis=1)
    _, index = np.unique(ordered[:, 0] * count + ordered[:, 1], return_index=True)
    kept: np.ndarray = pairs[np.sort(index)]
    return kept


def controller_springs(nodes: np.ndarray, controllers: np.ndarray, radius: float, neighbours: int) -> np.ndarray:
    """Springs from controllers to object nodes, [S, 2] as (N + controller, node)."""
    k = min(neighbours, len(nodes))
    distance, partner = cKDTree(nodes).query(controllers, k=k, distance_upper_bound=radius)
    distance, partner = distance.reshape(len(controllers), k), partner.reshape(len(controllers), k)
    controller, column = np.nonzero(distance < radius)
    return np.stack([len(nodes) + controller, partner[controller, column]], axis=1)


def build(nodes: np.ndarray, controllers: np.ndarray, springs: np.ndarray, labels: np.ndarray | None = None) -> Topology:
    """A Topology whose rest lengths are the frame-0 distances (in double precision, then rounded to float32)."""
    ends = np.concatenate([nodes, controllers]).astype(np.float64)[springs.reshape(-1, 2)]
    lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    if (lengths <= 0).any():
        pair = springs[int(np.argmin(lengths))].tolist()
        raise InputError(
            "topology",
            "a controller may not coincide with an object node",
            f"zero-length spring {pair}",
            "Move or drop that point.",
        )
    return Topology(
        nodes=nodes,
        controllers=controllers,
        springs=springs.reshape(-1, 2).astype(np.int32),
        rest_lengths=lengths,
        labels=np.zeros(len(nodes), np.int32) if labels is None else labels,
    )


def uniform_topology(
    nodes: np.ndarray,
    controllers: np.ndarray,
    object_radius: float,
    object_neighbours: int,
    controller_radius: float,
    controller_neighbours: int,
) -> Topology:
    """One radius [m] and one neighbour count (self included) for the whole object.

    Raises InputError if a controller coincides with a node.
    """
    points, hands = np.asarray(nodes, np.float64), np.asarray(controllers, np.float64)
    count = len(points)
    inner = object_springs(points, np.full(count, object_radius), np.full(count, object_neighbours))
    outer = controller_springs(points, hands, controller_radius, controller_neighbours)
    return build(np.asarray(nodes), np.asarray(controllers), np.concatenate([inner, outer]))
