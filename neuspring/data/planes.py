"""Planes in depth.

A plane is n . x + h = 0 in the coordinates of the camera (OpenCV: x right, y down, z forward, m). Its unit normal n points to the
camera, so that h > 0 is the camera's height above it. It is found by RANSAC, then by weighted least squares: residuals count in
units of the sensor's noise, which grows with depth (`camera.depth_noise`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neuspring.data.camera import Plane, depth_noise

HYPOTHESES = 2000
"""Triples of points per search: a plane with a tenth of the points is hit twice."""
SCORED_POINTS = 800
"""Points on which a hypothesis is scored."""
CLOUD_POINTS = 20000
"""Points of all frames together."""
FLATNESS = 0.001
"""m. Deviation of a table from a plane, and of the sensor from its calibration."""
SIGMAS = 3.0
"""A point within so many deviations of the noise lies on the plane."""
BEST = 8
"""Hypotheses that are refined."""
REFINEMENTS = 8
"""Refinements of a plane."""
PLANES = 4
"""Planes that are looked for, the largest first."""
PLANE_SHARE = 0.03
"""Share of the points below which a plane is none."""


def cloud(depths: Sequence[np.ndarray], intrinsics: np.ndarray, most: int = CLOUD_POINTS) -> np.ndarray:
    """Points [n, 3], m, in the coordinates of the camera, of depth images [H, W], m, 0: none; every k-th pixel of each."""
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

    Depth is measured along the ray, which meets the plane at an angle: the part of its noise across the plane is height / z.
    """
    depth = points[:, 2]
    return np.asarray(np.hypot(depth_noise(depth) * np.abs(height) / depth, FLATNESS))


def planes(points: np.ndarray, most: int = PLANES) -> list[Plane]:
    """The planes in points [n, 3], m, the largest first: each is searched among the points that those before it left."""
    left, found = points, list[Plane]()
    while len(found) < most and len(left) >= max(PLANE_SHARE * len(points), 50):
        plane = _largest(left, len(points))
        if plane is None or plane.share < PLANE_SHARE:
            break
        found.append(plane)
        left = left[np.abs(plane.above(left)) > 2 * SIGMAS * noise(left, plane.height)]
    return sorted(found, key=lambda plane: -plane.share)


def refined(points: np.ndarray, normal: np.ndarray, height: float, total: int | None = None) -> Plane | None:
    """The plane near the given one that fits points [n, 3] best by weighted least squares, or None where too few lie near it."""
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
        # A sensor with more or less noise than the model has other deviations: the scale follows the median of what is near.
        distance = np.abs(points[near] @ normal + height) / sigma[near]
        scale = float(np.clip(1.4826 * np.median(distance), 0.5, 2.0))
    rms = float(np.sqrt(np.mean((points[near] @ normal + height) ** 2)))
    return Plane(normal, height, rms, float(near.sum()) / (total or len(points)), int(near.sum()), points[near])


def _largest(points: np.ndarray, total: int) -> Plane | None:
    """The plane with the most of `points`; deterministic."""
    rng = np.random.default_rng(0)
    corners = points[rng.integers(len(points), size=(HYPOTHESES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    whole = length > 1e-9
    normals, corners = normals[whole] / length[whole, None], corners[whole]
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
