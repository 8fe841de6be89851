"""Lifted tracks and a shape prior -> the structure points of a twin, one per voxel.

Observed points come first, then points on the prior's surface, then points inside it (section 2.9 of the released processing, here
with a seed).
"""

from __future__ import annotations

from itertools import count

import numpy as np
import warp as wp

from neuspring.config.perception import Sampling
from neuspring.perception.results import LiftedTracks, ShapePrior
from neuspring.perception.sample_kernels import winding

GROWTH = 1.01
"""Ratio of the voxel sizes that are tried one after the other."""


def structure(
    lifted: LiftedTracks, prior: ShapePrior, settings: Sampling, up: float, seed: int, rank: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Indices of the object tracks to keep [No], surface points [Ns, 3] and interior points [Ni, 3], m, and the voxel's side, m.

    Tracks with the same place in frame 0 count once, in lexicographic order of their places, those of the highest `rank` [Q] first
    where one is given. Every voxel holds one point; object
    before surface before interior. Its side is `settings.voxel`, or what `settings.nodes` needs. Points below the table are lifted
    to it.
    """
    start = on_table(lifted.object_points[0], up)
    _, unique = np.unique(start, axis=0, return_index=True)
    if rank is not None:
        unique = unique[np.argsort(-rank[unique], kind="stable")]
    surface, interior = (on_table(points, up) for points in _samples(prior, settings, seed))
    everything = np.concatenate([start[unique], surface, interior])
    voxel = settings.voxel if settings.nodes is None else voxel_for(everything, settings.nodes, settings.voxel)
    first_of_cell = np.zeros(len(everything), dtype=bool)
    first_of_cell[np.unique(cells_of(everything, voxel), axis=0, return_index=True)[1]] = True
    own, outer, inner = np.split(first_of_cell, np.cumsum([len(unique), len(surface)]))
    return unique[own], surface[outer], interior[inner], voxel


def cells_of(points: np.ndarray, voxel: float) -> np.ndarray:
    """The voxel of each point, [n, 3] whole numbers from the lowest corner on."""
    cells: np.ndarray = np.floor((points - points.min(axis=0)) / voxel).astype(int)
    return cells


def voxel_for(points: np.ndarray, most: int, least: float) -> float:
    """The smallest of the sides `least` GROWTH^k, k = 0, 1, 2, ..., m, at which points [n, 3] lie in at most `most` voxels.

    The number of voxels does not quite fall with their side. Trying one after the other, more voxels never make a larger side.
    """
    for step in count():
        voxel = least * GROWTH**step
        cells = cells_of(points, voxel)
        size = cells.max(axis=0) + 1
        if len(np.unique(np.ravel_multi_index(tuple(cells.T), tuple(size)))) <= most:
            break
    return voxel


def on_table(points: np.ndarray, up: float) -> np.ndarray:
    """Points [..., 3] with those below the table z = 0 moved up to it; `up` is +1 or -1."""
    lifted = np.array(points, dtype=float)
    lifted[..., 2] = up * np.maximum(up * lifted[..., 2], 0.0)
    return lifted


def on_surface(vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points [count, 3] of a mesh, uniform by area."""
    corners = vertices[faces].astype(float)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face = rng.choice(len(area), count, p=area / area.sum())
    weights = rng.dirichlet((1.0, 1.0, 1.0), count)
    return np.asarray(np.einsum("ns,nsc->nc", weights, corners[face]))


def inside(prior: ShapePrior, points: np.ndarray) -> np.ndarray:
    """Whether points [n, 3] lie inside the closed surface [n], by its winding number."""
    indices: wp.array = wp.array(prior.faces.ravel(), dtype=wp.int32, device="cpu")
    mesh = wp.Mesh(wp.array(prior.vertices, dtype=wp.vec3, device="cpu"), indices, support_winding_number=True)
    result = wp.zeros(len(points), dtype=wp.bool, device="cpu")
    reach = float(np.ptp(prior.vertices, axis=0).max()) * 2.0
    wp.launch(winding, len(points), [mesh.id, wp.array(points, dtype=wp.vec3, device="cpu"), reach, result], device="cpu")
    return np.asarray(result.numpy())


def _samples(prior: ShapePrior, settings: Sampling, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on the surface, and those of uniform points of its bounding box that lie inside."""
    if not len(prior.faces):
        return np.zeros((0, 3)), np.zeros((0, 3))
    rng = np.random.default_rng(seed)
    surface = on_surface(prior.vertices, prior.faces, settings.surface, rng)
    box = rng.uniform(prior.vertices.min(axis=0), prior.vertices.max(axis=0), (settings.interior, 3))
    return surface, box[inside(prior, box)]
