"""Points that move with the nodes around them: tracked points in space, and points annotated in the image of one camera.

*In space*, for the bound track error. The published track error follows the nearest node, so it also measures the distance of a
point from a node: several millimeters if nodes are 18 mm apart. Here, frame 0 binds a point p to its k nearest nodes x_i:

    p(t) = sum_i w_i (x_i(t) + R(t) (p(0) - x_i(0))),    w_i = (1 / d_i) / sum_j (1 / d_j),    d_i = |p(0) - x_i(0)|

R(t) is the least-squares rotation of the nodes from frame 0 to frame t (Kabsch). All nodes have the same weight in it, because
with the weights w a node on the point would leave R undetermined. The weights w add up to 1, so p(t) = c(t) + R(t) (p(0) - c(0))
with c = sum_i w_i x_i.

A rigid motion x_i(t) = Q x_i(0) + b scores zero. The squares vanish at R(t) = Q, and only there if the nodes are not on one line.
Then p(t) = sum_i w_i (Q x_i(0) + b) + Q (p(0) - c(0)) = Q c(0) + b + Q p(0) - Q c(0) = Q p(0) + b. In frame 0, Q = 1.

Nodes on one line leave the rotation about it undetermined, and a single node leaves every rotation undetermined. R(t) is then the
rotation of the previous frame, followed by the smallest rotation from the previous to the new line. That is exact for points on the
line, and for rigid motions without rotation about the line between frames. Points off the line move without jumps.

*In the image*, for captures without depth, only image positions can be compared. An annotated pixel p of frame 0 is on the object,
at an unknown depth. It moves with the visible nodes around it:

    p(t) = p(0) + sum_i w_i (x_i(t) - x_i(0)),    w_i = (1 / (d_i + 1)) / sum_j (1 / (d_j + 1)),    d_i = |p(0) - x_i(0)|

The x_i are projections of a few surface nodes, in pixels. The error in frame 0 is zero for all nodes.
"""

from __future__ import annotations

import numpy as np

from neuspring.data.camera import Camera

CARRIERS = 8
"""Nodes that a point is bound to: the number of corners of a grid cell."""
ON_A_LINE = 1e-6
"""Nodes are on one line if their second moment across it is below this fraction of that along it (0.1 % of their extent)."""
LEAST_DISTANCE = 1e-6
"""Lower bound of d_i as a fraction of the mean d_i; a node on the point gets nearly all weight."""


def bound_positions(positions: np.ndarray, points: np.ndarray, neighbors: int = CARRIERS) -> np.ndarray:
    """Positions [F, P, 3], m, float64, of points [P, 3], m, of frame 0 in every frame, carried by nodes [F, N, 3], m.

    A point is bound to `neighbors` nodes, or to all nodes if there are fewer. All nodes must be finite.
    """
    from scipy.spatial import cKDTree

    nodes, points = positions.astype(np.float64), points.astype(np.float64)
    distance, index = cKDTree(nodes[0]).query(points, k=np.arange(1, min(neighbors, nodes.shape[1]) + 1))
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
    result = np.einsum("fpij,fpj,fpjk->fpik", left, np.stack([*[np.ones_like(signs)] * 2, signs], axis=-1), right)
    # The rotation is unique if the sum of the two smaller singular values, with the sign of the last, is not zero.
    unclear = size[..., 1] + signs * size[..., 2] <= ON_A_LINE * size[..., 0]
    if len(groups := np.flatnonzero(unclear.any(axis=0))):
        result[0, groups] = np.where(unclear[0, groups, None, None], np.eye(3), result[0, groups])
        _extend(result, moments, unclear, groups)
    return np.asarray(result)


def _extend(result: np.ndarray, moments: np.ndarray, unclear: np.ndarray, groups: np.ndarray) -> None:
    """Replace undetermined rotations by the previous rotation followed by the smallest rotation of the line; in place."""
    for frame in range(1, len(result)):
        if not len(lost := groups[unclear[frame, groups]]):
            continue
        before = result[frame - 1, lost]
        # Moments against the nodes of frame 0 after the previous rotation. The line has the largest singular value.
        left, size, right = np.linalg.svd(moments[frame, lost] @ before.transpose(0, 2, 1))
        least = _smallest_rotation(right[:, 0], left[:, :, 0])
        none = size[:, 0] <= np.finfo(float).tiny
        result[frame, lost] = np.where(none[:, None, None], np.eye(3), least) @ before


def _smallest_rotation(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Smallest rotations [P, 3, 3] from unit vectors `start` [P, 3] to `end` [P, 3].

    R = H(end + start) H(start) with H(v) = 2 v v^T / |v|^2 - 1, the rotation by 180 degrees about v. Opposite vectors rotate about
    an arbitrary normal.
    """
    middle = start + end
    normal = np.cross(start, np.eye(3)[np.abs(start).argmin(axis=1)])
    opposite = np.linalg.norm(middle, axis=1, keepdims=True) < 1e-9
    half = _half_turn(np.where(opposite, normal, middle))
    return np.where(opposite[..., None], half, half @ _half_turn(start))


def _half_turn(axis: np.ndarray) -> np.ndarray:
    unit = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    return np.asarray(2 * unit[:, :, None] * unit[:, None, :] - np.eye(3))


FLAT_HEIGHT = 0.015
"""Height above the table, m, below which a point is on the table."""
IN_IMAGE = 4
"""Nodes that carry an annotated pixel."""
CANDIDATES = 8
"""Nearest nodes in the image, from which the front-most is selected."""
FAR_SIDE = 0.03
"""Depth behind the front-most candidate, m, beyond which a node counts as another side of the object."""


def points_in_image(camera: Camera, positions: np.ndarray, marked: np.ndarray, surface: int) -> np.ndarray:
    """Mean distance per frame [F], px, of annotated points from their predicted positions; NaN if no point can be compared.

    - positions: nodes [F, N, 3], m; only the first `surface` nodes can be visible.
    - marked: annotated points [F or more, K, 2], px; NaN: not annotated. Points without an annotation in frame 0 are left out.
    """
    predicted = carried_in_image(camera, positions, marked[0], surface)
    errors = np.linalg.norm(predicted - marked[: len(predicted)], axis=2)
    return means(errors, np.isfinite(errors))


def carried_in_image(camera: Camera, positions: np.ndarray, start: np.ndarray, surface: int) -> np.ndarray:
    """Positions [F, K, 2], px, of pixels `start` [K, 2] of frame 0 that the nodes around them carry; NaN stays NaN.

    Other arguments as in `points_in_image`. The carrying nodes are chosen once, in frame 0, and must be in front of the camera.
    """
    pixels, depth = camera.project(positions[:, :surface].astype(np.float64))
    carried = np.full((len(positions), *np.shape(start)), np.nan)
    for k, pixel in enumerate(np.asarray(start, np.float64)):
        if np.isfinite(pixel).all():
            index, weights = _around(pixel, pixels[0], depth[0])
            carried[:, k] = pixel + np.einsum("i,fij->fj", weights, pixels[:, index] - pixels[0, index])
    return carried


def points_on_table(camera: Camera, positions: np.ndarray, marked: np.ndarray, surface: int, up: float) -> np.ndarray:
    """As `points_in_image`, but in m on the table, for points of flat objects while they touch the table; otherwise NaN.

    An object is flat if all its nodes are less than FLAT_HEIGHT above the table z = 0 in frame 0, on the side `up` (+1 or -1). A
    point touches the table if its carried position is less than FLAT_HEIGHT above it. The annotated pixel is lifted to the plane at
    that height; the error is its distance from the carried position.
    """
    errors = np.full((len(positions), marked.shape[1]), np.nan)
    if (up * positions[0, :, 2]).max() < FLAT_HEIGHT:
        nodes = positions[:, :surface].astype(np.float64)
        pixels, depth = camera.project(nodes[0])
        for k, pixel in enumerate(marked[0]):
            if not np.isfinite(pixel).all():
                continue
            index, weights = _around(pixel, pixels, depth)
            start = _on_plane(camera, pixel[None], np.array([weights @ nodes[0, index, 2]]))[0]
            carried = start + np.einsum("i,fij->fj", weights, nodes[:, index] - nodes[0, index])
            touching = (up * carried[:, 2] < FLAT_HEIGHT) & np.isfinite(marked[: len(nodes), k]).all(axis=1)
            seen = _on_plane(camera, marked[: len(nodes), k][touching], carried[touching, 2])
            errors[touching, k] = np.linalg.norm(seen - carried[touching], axis=1)
    return means(errors, np.isfinite(errors))


def means(errors: np.ndarray, known: np.ndarray, none: float = np.nan) -> np.ndarray:
    """Mean per frame [F] of the `known` errors, both [F, K]; `none` for a frame without known errors."""
    count, total = known.sum(axis=1), np.where(known, errors, 0.0).sum(axis=1)
    mean: np.ndarray = np.divide(total, count, out=np.full(len(errors), none), where=count > 0)
    return mean


def _on_plane(camera: Camera, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
    """World points [n, 3], m, where the rays of pixels [n, 2] intersect the planes at heights z [n], m."""
    rays = camera.rays(pixels)
    return camera.lift(pixels, (z - camera.camera_to_world[2, 3]) / rays[:, 2])


def _around(pixel: np.ndarray, pixels: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices and weights of the nodes that carry a pixel [2], from projections [N, 2], px, and depths [N], m."""
    distance = np.linalg.norm(pixels - pixel, axis=1)
    order = np.argsort(distance, kind="stable")
    front = depth[order[:CANDIDATES]].min()
    seen = order[depth[order] <= front + FAR_SIDE][:IN_IMAGE]
    inverse = 1.0 / (distance[seen] + 1.0)
    return seen, inverse / inverse.sum()
