"""Points bound to the nodes around them: the track error whose floor is zero.

The published track error follows the nearest node, so that it also measures how far a point is from a node: several millimeters
where nodes are 18 mm apart. Here a point p is bound in frame 0 to its k nearest nodes x_i and moves with them:

    p(t) = sum_i w_i (x_i(t) + R(t) (p(0) - x_i(0))),    w_i = (1 / d_i) / sum_j (1 / d_j),    d_i = |p(0) - x_i(0)|

R(t) is the rotation that turns the nodes of frame 0 into those of frame t with the least squares (Kabsch). Every node counts the
same in it: with the weights w, a node on the point would leave nothing to turn by. As the weights add up to 1, p(t) is
c(t) + R(t) (p(0) - c(0)) with c = sum_i w_i x_i.

A rigid motion x_i(t) = Q x_i(0) + b scores zero. The least squares vanish at R(t) = Q, and only there if the nodes are not on one
line. So p(t) = sum_i w_i (Q x_i(0) + b) + Q (p(0) - c(0)) = Q c(0) + b + Q p(0) - Q c(0) = Q p(0) + b. Frame 0 is the case Q = 1.

Nodes on one line say nothing of the turn about it, and one node says nothing of any turn. There the rotation of the frame before is
turned by the least angle that takes its line to the new one. That is exact for points on the line, and for rigid motions that never
turn about the line from one frame to the next. A point beside the line moves without jumps.
"""

from __future__ import annotations

import numpy as np

NEIGHBORS = 8
"""Nodes that a point is bound to, as many as the corners of a cell of a regular grid."""
ON_A_LINE = 1e-6
"""Nodes are on one line if their second moment across it is below so much of that along it: 0.1 % of their extent."""
LEAST_DISTANCE = 1e-6
"""Least d_i over the mean of all d_i, so that a node on the point has nearly all weight."""


def bound_positions(positions: np.ndarray, points: np.ndarray, neighbors: int = NEIGHBORS) -> np.ndarray:
    """Where points [P, 3] m of frame 0 are in every frame [F, P, 3], carried by nodes [F, N, 3] m; float64.

    Fewer nodes than `neighbors` all carry. Nodes of all frames must be finite.
    """
    from scipy.spatial import cKDTree

    nodes, points = positions.astype(np.float64), points.astype(np.float64)
    count = min(neighbors, nodes.shape[1])
    distance, index = cKDTree(nodes[0]).query(points, k=np.arange(1, count + 1))
    mean = distance.mean(axis=1, keepdims=True)
    inverse = 1.0 / np.maximum(distance, np.maximum(LEAST_DISTANCE * mean, np.finfo(float).tiny))
    weights = inverse / inverse.sum(axis=1, keepdims=True)
    carrying = nodes[:, index]
    centers = np.einsum("pk,fpkc->fpc", weights, carrying)
    turned = np.einsum("fpij,pj->fpi", rotations(carrying), points - centers[0])
    return np.asarray(centers + turned)


def rotations(carrying: np.ndarray) -> np.ndarray:
    """Rotation [F, P, 3, 3] of every group of nodes [F, P, k, 3] from frame 0 to each frame."""
    offsets = carrying - carrying.mean(axis=2, keepdims=True)
    moments = np.einsum("fpki,pkj->fpij", offsets, offsets[0])
    left, size, right = np.linalg.svd(moments)
    signs = np.sign(np.linalg.det(left) * np.linalg.det(right))
    found = np.einsum("fpij,fpj,fpjk->fpik", left, _last(signs), right)
    # The rotation is unique if the two smaller values do not cancel, with the sign of the last.
    unclear = size[..., 1] + signs * size[..., 2] <= ON_A_LINE * size[..., 0]
    groups = np.flatnonzero(unclear.any(axis=0))
    if len(groups):
        found[0, groups] = np.where(unclear[0, groups, None, None], np.eye(3), found[0, groups])
        _carry(found, moments, unclear, groups)
    return np.asarray(found)


def _last(signs: np.ndarray) -> np.ndarray:
    ones = np.ones_like(signs)
    return np.stack([ones, ones, signs], axis=-1)


def _carry(found: np.ndarray, moments: np.ndarray, unclear: np.ndarray, groups: np.ndarray) -> None:
    """Replace unclear rotations by those of the frame before, turned by the least angle; in place."""
    for frame in range(1, len(found)):
        lost = groups[unclear[frame, groups]]
        if not len(lost):
            continue
        before = found[frame - 1, lost]
        # From the nodes of frame 0 as the frame before turned them. The largest value belongs to the line.
        left, size, right = np.linalg.svd(moments[frame, lost] @ before.transpose(0, 2, 1))
        least = _least_turn(right[:, 0], left[:, :, 0])
        none = size[:, 0] <= np.finfo(float).tiny
        found[frame, lost] = np.where(none[:, None, None], np.eye(3), least) @ before


def _least_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Rotations [P, 3, 3] by the least angle that take unit vectors [P, 3] to others.

    R = H(end + start) H(start) with H(v) = 2 v v^T / |v|^2 - 1, the half turn about v. Opposite vectors turn about any normal.
    """
    middle = start + end
    normal = np.cross(start, np.eye(3)[np.abs(start).argmin(axis=1)])
    opposite = np.linalg.norm(middle, axis=1, keepdims=True) < 1e-9
    half = _half_turn(np.where(opposite, normal, middle))
    return np.where(opposite[..., None], half, half @ _half_turn(start))


def _half_turn(axis: np.ndarray) -> np.ndarray:
    unit = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    return np.asarray(2 * unit[:, :, None] * unit[:, None, :] - np.eye(3))
