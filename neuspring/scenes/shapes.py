"""Shapes as signed distance functions, and their triangle surfaces.

Distances [...] of points [..., 3], m, are negative inside. Distances to ellipsoids and smooth unions are approximate. Their signs
are exact away from the blend, which is sufficient for meshing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import warp as wp
from warp.geometry import IsoSurfaceMarchingCubes

from neuspring.scenes.rays import on_cpu

Sdf = Callable[[np.ndarray], np.ndarray]


def sphere(center: Sequence[float], radius: float) -> Sdf:
    """|p - c| - r."""
    return lambda p: np.linalg.norm(p - np.asarray(center), axis=-1) - radius


def ellipsoid(center: Sequence[float], radii: Sequence[float]) -> Sdf:
    """k0 (k0 - 1) / k1 with k0 = |q / r|, k1 = |q / r^2|, q = p - c: first-order exact at the surface."""
    middle, half = np.asarray(center, float), np.asarray(radii, float)

    def distance(p: np.ndarray) -> np.ndarray:
        q = (p - middle) / half
        level = np.linalg.norm(q, axis=-1)
        return np.asarray(level * (level - 1.0) / np.maximum(np.linalg.norm(q / half, axis=-1), 1e-9))

    return distance


def capsule(start: Sequence[float], end: Sequence[float], radius: float) -> Sdf:
    """Distance to the segment from start to end, minus r."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    along = b - a

    def distance(p: np.ndarray) -> np.ndarray:
        t = np.clip((p - a) @ along / (along @ along), 0.0, 1.0)
        return np.asarray(np.linalg.norm(p - a - t[..., None] * along, axis=-1) - radius)

    return distance


def smooth_union(parts: Iterable[Sdf], blend: float) -> Sdf:
    """-k log sum exp(-d_i / k): the union, rounded over about the length k = `blend` where parts meet."""
    members = list(parts)

    def distance(p: np.ndarray) -> np.ndarray:
        each = np.stack([part(p) for part in members])
        least = each.min(axis=0)
        return np.asarray(least - blend * np.log(np.exp(-(each - least) / blend).sum(axis=0)))

    return distance


def gradient(sdf: Sdf, points: np.ndarray, step: float = 1e-4) -> np.ndarray:
    """Unit outward direction [..., 3] by central differences."""
    slope = np.stack([sdf(points + step * axis) - sdf(points - step * axis) for axis in np.eye(3)], axis=-1)
    return np.asarray(slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-12))


def surface(sdf: Sdf, low: Sequence[float], high: Sequence[float], spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Marching cubes of sdf = 0 within the box: vertices [V, 3], m, and faces [F, 3], outward."""
    first = np.asarray(low, float)
    counts = np.ceil((np.asarray(high, float) - first) / spacing).astype(int) + 1
    distances = sdf((first + spacing * grid(counts)).reshape(-1, 3)).reshape(counts)
    values = on_cpu(distances, wp.float32)
    # The extractor does not accept the bounds of this grid, so it returns lattice coordinates that are scaled here.
    points, indices = IsoSurfaceMarchingCubes.extract_surface_marching_cubes(values, 0.0)  # type: ignore[arg-type]
    vertices, faces = first + spacing * points.numpy().astype(float), indices.numpy().reshape(-1, 3)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = (gradient(sdf, corners.mean(axis=1)) * normals).sum(axis=-1).mean() > 0
    return vertices, faces if outward else faces[:, ::-1].copy()


def grid(counts: np.ndarray) -> np.ndarray:
    """Integer lattice points [nx, ny, nz, 3]."""
    return np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1)
