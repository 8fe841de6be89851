"""Points marked in the images of one camera against a prediction: without depth, all that can be compared is where they are seen.

A marked pixel p of frame 0 lies on the object, at a depth that nobody measured. It moves as the nodes do that are seen around it:

    p(t) = p(0) + sum_i w_i (x_i(t) - x_i(0)),    w_i = (1 / (d_i + 1)) / sum_j (1 / (d_j + 1)),    d_i = |p(0) - x_i(0)|

where x_i are the projections of a few surface nodes, in pixels. In frame 0 the error is zero, whatever the nodes.
"""

from __future__ import annotations

import numpy as np

from neuspring.data.capture import Camera

FLAT = 0.015
"""m above the table, below which a point lies on it."""
NEIGHBORS = 4
"""Nodes that a marked pixel moves with."""
CANDIDATES = 8
"""Nodes, nearest in the image, among which the front-most one is looked for."""
BEHIND = 0.03
"""m behind the front-most candidate, beyond which a node is taken to be on another side of the object."""


def points_in_image(
    intrinsics: np.ndarray, camera_to_world: np.ndarray, positions: np.ndarray, marked: np.ndarray, surface: int
) -> np.ndarray:
    """Mean distance per frame [F], px, of marked points from where the prediction carries them; NaN where none can be compared.

    intrinsics [3, 3], px; camera_to_world [4, 4], m; positions of nodes [F, N, 3], m, of which the first `surface` can be seen;
    marked [F or more, K, 2], px, NaN where a point is not marked. A point that frame 0 does not have is left out.
    """
    errors = point_errors(intrinsics, camera_to_world, positions, marked, surface)
    known = np.isfinite(errors)
    count, total = known.sum(axis=1), np.where(known, errors, 0.0).sum(axis=1)
    mean: np.ndarray = np.divide(total, count, out=np.full(len(errors), np.nan), where=count > 0)
    return mean


def point_errors(
    intrinsics: np.ndarray, camera_to_world: np.ndarray, positions: np.ndarray, marked: np.ndarray, surface: int
) -> np.ndarray:
    """As `points_in_image`, of every point: distances [F, K], px; NaN where a point is not marked in the frame or in frame 0."""
    places = carried_in_image(intrinsics, camera_to_world, positions, marked[0], surface)
    return np.asarray(np.linalg.norm(places - marked[: len(places)], axis=2))


def carried_in_image(
    intrinsics: np.ndarray, camera_to_world: np.ndarray, positions: np.ndarray, start: np.ndarray, surface: int
) -> np.ndarray:
    """Where the nodes around them carry pixels [K, 2] of frame 0: [F, K, 2]; NaN stays. Other arguments as in `points_in_image`.

    The nodes must lie in front of the camera. They are chosen once, in frame 0.
    """
    camera = Camera("", 0, 0, intrinsics, camera_to_world)
    pixels, depth = camera.project(positions[:, :surface].astype(np.float64))
    places = np.full((len(positions), *np.shape(start)), np.nan)
    for k, pixel in enumerate(np.asarray(start, np.float64)):
        if np.isfinite(pixel).all():
            index, weights = _around(pixel, pixels[0], depth[0])
            places[:, k] = pixel + np.einsum("i,fij->fj", weights, pixels[:, index] - pixels[0, index])
    return places


def points_on_table(
    intrinsics: np.ndarray, camera_to_world: np.ndarray, positions: np.ndarray, marked: np.ndarray, surface: int, up: float
) -> np.ndarray:
    """As `points_in_image`, m on the table, of points of flat things that touch it: NaN where there is none.

    A thing is flat if no node of frame 0 is FLAT or more above the table z = 0, on the side `up`, +1 or -1. A point touches the
    table in a frame in which the nodes that carry it are less than FLAT above it. There the marked pixel is lifted onto the plane
    at their height; the error is its distance from where they carry the point.
    """
    errors = np.full((len(positions), marked.shape[1]), np.nan)
    if (up * positions[0, :, 2]).max() < FLAT:
        camera = Camera("", 0, 0, intrinsics, camera_to_world)
        nodes = positions[:, :surface].astype(np.float64)
        pixels, depth = camera.project(nodes[0])
        for k, pixel in enumerate(marked[0]):
            if not np.isfinite(pixel).all():
                continue
            index, weights = _around(pixel, pixels, depth)
            start = _on_plane(camera, pixel[None], np.array([weights @ nodes[0, index, 2]]))[0]
            carried = start + np.einsum("i,fij->fj", weights, nodes[:, index] - nodes[0, index])
            touching = (up * carried[:, 2] < FLAT) & np.isfinite(marked[: len(nodes), k]).all(axis=1)
            seen = _on_plane(camera, marked[: len(nodes), k][touching], carried[touching, 2])
            errors[touching, k] = np.linalg.norm(seen - carried[touching], axis=1)
    known = np.isfinite(errors)
    count, total = known.sum(axis=1), np.where(known, errors, 0.0).sum(axis=1)
    mean: np.ndarray = np.divide(total, count, out=np.full(len(errors), np.nan), where=count > 0)
    return mean


def _on_plane(camera: Camera, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
    """World points [n, 3], m, at which the rays of pixels [n, 2] meet the planes at z [n], m."""
    rays = camera.lift(pixels, np.ones(len(pixels))) - camera.camera_to_world[:3, 3]
    return np.asarray(camera.lift(pixels, (z - camera.camera_to_world[2, 3]) / rays[:, 2]))


def _around(pixel: np.ndarray, pixels: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes that a pixel [2] moves with, and their weights, from projections [N, 2], px, and depths [N], m."""
    distance = np.linalg.norm(pixels - pixel, axis=1)
    order = np.argsort(distance, kind="stable")
    front = depth[order[:CANDIDATES]].min()
    seen = order[depth[order] <= front + BEHIND][:NEIGHBORS]
    inverse = 1.0 / (distance[seen] + 1.0)
    return seen, inverse / inverse.sum()
