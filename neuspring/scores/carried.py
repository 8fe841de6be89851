"""Points that move with the nodes around them: tracked points in space, and points marked in the image of one camera.

*In space*, for the track error whose floor is zero. The published track error follows the nearest node, so that it also measures
how far a point is from a node: several millimeters where nodes are 18 mm apart. Here a point p is bound in frame 0 to its k nearest
nodes x_i and moves with them:

    p(t) = sum_i w_i (x_i(t) + R(t) (p(0) - x_i(0))),    w_i = (1 / d_i) / sum_j (1 / d_j),    d_i = |p(0) - x_i(0)|

R(t) is the rotation that turns the nodes of frame 0 into those of frame t with the least squares (Kabsch). Every node counts the
same in it: with the weights w, a node on the point would leave nothing to turn by. As the weights add up to 1, p(t) is
c(t) + R(t) (p(0) - c(0)) with c = sum_i w_i x_i.

A rigid motion x_i(t) = Q x_i(0) + b scores zero. The least squares vanish at R(t) = Q, and only there if the nodes are not on one
line. So p(t) = sum_i w_i (Q x_i(0) + b) + Q (p(0) - c(0)) = Q c(0) + b + Q p(0) - Q c(0) = Q p(0) + b. Frame 0 is the case Q = 1.

Nodes on one line say nothing of the turn about it, and one node says nothing of any turn. There the rotation of the frame before is
turned by the least angle that takes its line to the new one. That is exact for points on the line, and for rigid motions that never
turn about the line from one frame to the next. A point beside the line moves without jumps.

*In the image*, where there is no depth: all that can be compared is where points are seen. A marked pixel p of frame 0 lies on the
object, at a depth that nobody measured. It moves as the nodes do that are seen around it:

    p(t) = p(0) + sum_i w_i (x_i(t) - x_i(0)),    w_i = (1 / (d_i + 1)) / sum_j (1 / (d_j + 1)),    d_i = |p(0) - x_i(0)|

where x_i are the projections of a few surface nodes, in pixels. In frame 0 the error is zero, whatever the nodes.
"""

from __future__ import annotations

import numpy as np

from neuspring.data.camera import Camera

CARRIERS = 8
"""Nodes that a point is bound to, as many as the corners of a cell of a regular grid."""
ON_A_LINE = 1e-6
"""Nodes are on one line if their second moment across it is below so much of that along it: 0.1 % of their extent."""
LEAST_DISTANCE = 1e-6
"""Least d_i over the mean of all d_i, so that a node on the point has nearly all weight."""


def bound_positions(positions: np.ndarray, points: np.ndarray, neighbors: int = CARRIERS) -> np.ndarray:
    """Places [F, P, 3], m, of points [P, 3], m, of frame 0 in every frame, carried by nodes [F, N, 3] m; float64.

    Fewer nodes than `neighbors` all carry. Nodes of all frames must be finite.
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
    found = np.einsum("fpij,fpj,fpjk->fpik", left, np.stack([*[np.ones_like(signs)] * 2, signs], axis=-1), right)
    # The rotation is unique if the two smaller values do not cancel, with the sign of the last.
    unclear = size[..., 1] + signs * size[..., 2] <= ON_A_LINE * size[..., 0]
    if len(groups := np.flatnonzero(unclear.any(axis=0))):
        found[0, groups] = np.where(unclear[0, groups, None, None], np.eye(3), found[0, groups])
        _carry(found, moments, unclear, groups)
    return np.asarray(found)


def _carry(found: np.ndarray, moments: np.ndarray, unclear: np.ndarray, groups: np.ndarray) -> None:
    """Replace unclear rotations by those of the frame before, turned by the least angle; in place."""
    for frame in range(1, len(found)):
        if not len(lost := groups[unclear[frame, groups]]):
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


FLAT_HEIGHT = 0.015
"""m above the table, below which a point lies on it."""
IN_IMAGE = 4
"""Nodes that a marked pixel moves with."""
CANDIDATES = 8
"""Nodes, nearest in the image, among which the front-most one is looked for."""
FAR_SIDE = 0.03
"""m behind the front-most candidate, beyond which a node is taken to be on another side of the object."""


def points_in_image(camera: Camera, positions: np.ndarray, marked: np.ndarray, surface: int) -> np.ndarray:
    """Mean distance per frame [F], px, of marked points from where the prediction carries them; NaN where none can be compared.

    positions of nodes [F, N, 3], m, of which the first `surface` can be seen;
    marked [F or more, K, 2], px, NaN where a point is not marked. A point that frame 0 does not have is left out.
    """
    places = carried_in_image(camera, positions, marked[0], surface)
    errors = np.linalg.norm(places - marked[: len(places)], axis=2)
    return means(errors, np.isfinite(errors))


def carried_in_image(camera: Camera, positions: np.ndarray, start: np.ndarray, surface: int) -> np.ndarray:
    """Places [F, K, 2], px, to which the nodes around them carry pixels [K, 2] of frame 0; NaN stays.

    Other arguments as in `points_in_image`. The nodes must lie in front of the camera. They are chosen once, in frame 0.
    """
    pixels, depth = camera.project(positions[:, :surface].astype(np.float64))
    places = np.full((len(positions), *np.shape(start)), np.nan)
    for k, pixel in enumerate(np.asarray(start, np.float64)):
        if np.isfinite(pixel).all():
            index, weights = _around(pixel, pixels[0], depth[0])
            places[:, k] = pixel + np.einsum("i,fij->fj", weights, pixels[:, index] - pixels[0, index])
    return places


def points_on_table(camera: Camera, positions: np.ndarray, marked: np.ndarray, surface: int, up: float) -> np.ndarray:
    """As `points_in_image`, m on the table, of points of flat things that touch it: NaN where there is none.

    A thing is flat if no node of frame 0 is FLAT or more above the table z = 0, on the side `up`, +1 or -1. A point touches the
    table in a frame in which the nodes that carry it are less than FLAT above it. There the marked pixel is lifted onto the plane
    at their height; the error is its distance from where they carry the point.
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
    """Mean per frame [F] of the `known` errors, both [F, K]; `none` where there are none."""
    count, total = known.sum(axis=1), np.where(known, errors, 0.0).sum(axis=1)
    mean: np.ndarray = np.divide(total, count, out=np.full(len(errors), none), where=count > 0)
    return mean


def _on_plane(camera: Camera, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
    """World points [n, 3], m, at which the rays of pixels [n, 2] meet the planes at z [n], m."""
    rays = camera.rays(pixels)
    return camera.lift(pixels, (z - camera.camera_to_world[2, 3]) / rays[:, 2])


def _around(pixel: np.ndarray, pixels: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes that a pixel [2] moves with, and their weights, from projections [N, 2], px, and depths [N], m."""
    distance = np.linalg.norm(pixels - pixel, axis=1)
    order = np.argsort(distance, kind="stable")
    front = depth[order[:CANDIDATES]].min()
    seen = order[depth[order] <= front + FAR_SIDE][:IN_IMAGE]
    inverse = 1.0 / (distance[seen] + 1.0)
    return seen, inverse / inverse.sum()
