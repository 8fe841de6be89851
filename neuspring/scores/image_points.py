"""Points marked in the images of one camera against a prediction: without depth, all that can be compared is where they are seen.

A marked pixel p of frame 0 lies on the object, at a depth that nobody measured. It moves as the nodes do that are seen around it:

    p(t) = p(0) + sum_i w_i (x_i(t) - x_i(0)),    w_i = (1 / (d_i + 1)) / sum_j (1 / (d_j + 1)),    d_i = |p(0) - x_i(0)|

where x_i are the projections of a few surface nodes, in pixels. In frame 0 the error is zero, whatever the nodes.
"""

from __future__ import annotations

import numpy as np

from neuspring.data.capture import Camera

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


def _around(pixel: np.ndarray, pixels: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes that a pixel [2] moves with, and their weights, from projections [N, 2], px, and depths [N], m."""
    distance = np.linalg.norm(pixels - pixel, axis=1)
    order = np.argsort(distance, kind="stable")
    front = depth[order[:CANDIDATES]].min()
    seen = order[depth[order] <= front + BEHIND][:NEIGHBORS]
    inverse = 1.0 / (distance[seen] + 1.0)
    return seen, inverse / inverse.sum()
