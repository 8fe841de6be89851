"""Planes in depth images.

A plane is n . x + h = 0 in camera coordinates (OpenCV: x right, y down, z forward, m). Its unit normal n points to the camera, so
that h > 0 is the height of the camera above it. RANSAC finds a plane, and weighted least squares refines it: residuals are divided
by the sensor's noise, which grows with depth (`camera.depth_noise`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neuspring.data.camera import Plane, depth_noise

HYPOTHESES = 2000
"""Point triples per search: on average two of them are on a plane with a tenth of the points."""
SCORED_POINTS = 800
"""Points that score a hypothesis."""
CLOUD_POINTS = 20000
"""Largest number of points from all frames together."""
FLATNESS = 0.001
"""m. Deviation of a table from a plane, and of the sensor from its calibration."""
SIGMAS = 3.0
"""A point is on the plane if its distance is below this many standard deviations of the noise."""
BEST = 8
"""Number of hypotheses that are refined."""
REFINEMENTS = 8
"""Iterations of a refinement."""
PLANES = 4
"""Largest number of planes, the largest first."""
PLANE_SHARE = 0.03
"""Smallest fraction of the points that makes a plane."""


def cloud(depths: Sequence[np.ndarray], intrinsics: np.ndarray, most: int = CLOUD_POINTS) -> np.ndarray:
    """Points [n, 3], m, in camera coordinates, from every k-th pixel of depth images [H, W], m (0: no depth)."""
    clouds = []
    for depth in depths:
        y, x = np.nonzero(depth > 0)
        step = max(int(np.ceil(len(x) * len(depths) / most)), 1)
        x, y = x[::step], y[::step]
        rays = np.stack([x, y, np.ones(len(x))], axis=1) @ np.linalg.inv(intrinsics).T
        clouds.append(rays * depth[y, x][:, None])
    return np.concatenate(clouds) if clouds else np.zeros((0, 3))


def noise(points: np.ndarray, height: float | np.ndarray) -> np.ndarray:
    """Standard deviation [n], m, of the distance of points [n, 3] from a plane `height` below the camera.

    Depth is measured along the ray, which meets the plane at an angle: the fraction height / z of its noise is normal to the plane.
    """
    depth = points[:, 2]
    return np.asarray(np.hypot(depth_noise(depth) * np.abs(height) / depth, FLATNESS))


def planes(points: np.ndarray, most: int = PLANES) -> list[Plane]:
    """The planes in points [n, 3], m, the largest first. Each search uses the points that are on no earlier plane."""
    left, found = points, list[Plane]()
    while len(found) < most and len(left) >= max(PLANE_SHARE * len(points), 50):
        plane = _largest(left, len(points))
        if plane is None or plane.share < PLANE_SHARE:
            break
        found.append(plane)
        left = left[np.abs(plane.above(left)) > 2 * SIGMAS * noise(left, plane.height)]
    return sorted(found, key=lambda plane: -plane.share)


def refined(points: np.ndarray, normal: np.ndarray, height: float, total: int | None = None) -> Plane | None:
    """The plane near the given one that fits points [n, 3] best by weighted least squares; None if fewer than 20 are near it."""
    scale = 2.0
    near = np.zeros(len(points), dtype=bool)
    for _ in range(REFINEMENTS):
        sigma = noise(points, height)
        distance = np.abs(points @ normal + height) / sigma
        near = distance < SIGMAS * scale
        if near.sum() < 20:
            return None
        weight = sigma[near] ** -2
        center = np.average(points[near], axis=0, weights=weight)
        spread = (points[near] - center) * np.sqrt(weight)[:, None]
        normal = np.linalg.svd(spread.T @ spread)[0][:, -1]
        height = float(-normal @ center)
        if height < 0:
            normal, height = -normal, -height
        # Sensors have more or less noise than the model: the scale follows the median residual.
        distance = np.abs(points[near] @ normal + height) / sigma[near]
        scale = float(np.clip(1.4826 * np.median(distance), 0.5, 2.0))
    rms = float(np.sqrt(np.mean((points[near] @ normal + height) ** 2)))
    return Plane(normal, height, rms, float(near.sum()) / (total or len(points)), int(near.sum()), points[near])


def _largest(points: np.ndarray, total: int) -> Plane | None:
    """The plane that contains the most of `points`; deterministic."""
    rng = np.random.default_rng(0)
    corners = points[rng.integers(len(points), size=(HYPOTHESES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    valid = length > 1e-9
    normals, corners = normals[valid] / length[valid, None], corners[valid]
    if not len(normals):
        return None
    heights = -np.einsum("ij,ij->i", normals, corners[:, 0])
    scored = points[rng.permutation(len(points))[:SCORED_POINTS]]
    votes = np.concatenate(
        [
            (np.abs(scored @ part.T + height) < SIGMAS * noise(scored, height[:, None]).T).sum(axis=0)
            for part, height in zip(np.array_split(normals, 8), np.array_split(heights, 8), strict=True)
        ]
    )
    found = [refined(points, normals[k], float(heights[k]), total) for k in np.argsort(-votes, kind="stable")[:BEST]]
    return max((plane for plane in found if plane), key=lambda plane: plane.inliers, default=None)
