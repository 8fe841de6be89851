"""The shape prior, which completes what the cameras do not see in frame 0: a closed surface by carving voxels, or none.

A voxel belongs to the hull if no camera that has the object in view contradicts it, and at least one shows the object there. A
camera contradicts a voxel if its mask shows neither the object nor a hand before it, or if it measured depth behind the voxel.
Without the second condition a hand that all cameras see would belong to the hull. Nothing under the table belongs to it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import warp as wp
from scipy import ndimage
from warp.geometry import IsoSurfaceMarchingCubes

from neuspring.config.perception import ShapePriorSettings
from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT, Camera, Capture
from neuspring.perception.results import Masks, ShapePrior


def shape_prior(capture: Capture, masks: Mapping[str, Masks], cloud: np.ndarray, settings: ShapePriorSettings) -> ShapePrior:
    """The prior of the backend that `settings` names; `cloud` [P, 3], m, is what was seen of the object in frame 0."""
    backend = settings.backend
    if backend == "auto":
        backend = "none" if capture.description.category in settings.thin else "visual_hull"
    if backend == "visual_hull":
        return visual_hull(capture, masks, cloud, settings)
    if backend == "mesh":
        from neuspring.perception.shape_mesh import align

        return align(capture, masks, cloud, settings)
    if backend == "truth":
        from neuspring.perception.track_truth import surface

        return surface(capture)
    return no_prior()


def no_prior() -> ShapePrior:
    """The empty prior: the twin has only what was seen."""
    return ShapePrior(vertices=np.zeros((0, 3)), faces=np.zeros((0, 3), dtype=int), backend="none")


def visual_hull(capture: Capture, masks: Mapping[str, Masks], cloud: np.ndarray, settings: ShapePriorSettings) -> ShapePrior:
    """Carve the surroundings of the object's `cloud` [P, 3], m, of frame 0. Raises InputError if nothing remains."""
    sign = 1.0 if capture.description.up == "+z" else -1.0
    low, high = cloud.min(axis=0) - settings.margin, cloud.max(axis=0) + settings.margin
    counts = np.ceil((high - low) / settings.voxel).astype(int) + 1
    # Voxel centers [nx, ny, nz, 3].
    grid = low + settings.voxel * np.moveaxis(np.indices(counts), 0, -1)
    hull = sign * grid[..., 2] > 0
    shown = np.zeros_like(hull)
    for name, camera in capture.cameras.items():
        labels = masks[name].labels[0]
        # A camera that does not have the object in view says nothing about it.
        if (labels == OBJECT).any():
            admitted, shows = _consistent(grid, camera, labels, capture.depth(name, 0), settings.tolerance)
            hull, shown = hull & admitted, shown | shows
    hull = _largest_piece(hull & shown)
    vertices, faces = _surface(hull, low, settings.voxel, settings.smoothing)
    if not len(faces):
        rule = f"more than specks of {1e3 * settings.voxel:g} mm must be consistent with all cameras"
        remedy = "Masks, depth and calibration of frame 0 contradict each other; or take perception.shape.backend: none."
        raise InputError(f"{capture.folder}, visual hull", rule, f"{hull.sum()} voxels", remedy)
    facts = {"volume": float(hull.sum() * settings.voxel**3), "cameras": len(capture.cameras)}
    return ShapePrior(vertices=vertices, faces=faces, backend="visual_hull", facts=facts)


def _consistent(
    grid: np.ndarray, camera: Camera, labels: np.ndarray, depth: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Whether one camera admits each voxel [nx, ny, nz] bool, and whether it shows the object there, not a hand before it."""
    pixels, distance = camera.project(grid.reshape(-1, 3))
    admitted, shows = np.ones(len(distance), dtype=bool), np.zeros(len(distance), dtype=bool)
    seen = np.flatnonzero(camera.sees(pixels) & (distance > 0))
    x, y = np.round(pixels[seen]).astype(int).T
    label, measured = labels[y, x], depth[y, x]
    behind = (measured <= 0) | (distance[seen] >= measured - tolerance)
    admitted[seen] = behind & ((label == OBJECT) | (label == HANDS))
    shows[seen] = behind & (label == OBJECT)
    return admitted.reshape(grid.shape[:-1]), shows.reshape(grid.shape[:-1])


def _largest_piece(voxels: np.ndarray) -> np.ndarray:
    labels, count = ndimage.label(voxels)
    return voxels if count < 2 else np.asarray(labels == np.bincount(labels[voxels]).argmax())


def _surface(voxels: np.ndarray, low: np.ndarray, voxel: float, smoothing: float) -> tuple[np.ndarray, np.ndarray]:
    """Marching cubes of the occupancy, blurred over `smoothing` voxels, padded so that the surface closes."""
    padded = np.pad(voxels.astype(np.float32), 2)
    level = 0.5 - ndimage.gaussian_filter(padded, smoothing)
    values: wp.array = wp.array(level, dtype=wp.float32, device="cpu")
    vertices, indices = IsoSurfaceMarchingCubes.extract_surface_marching_cubes(values, 0.0)  # type: ignore[arg-type]
    faces = indices.numpy().reshape(-1, 3)
    points = low + voxel * (vertices.numpy().astype(float) - 2.0)
    corners = points[faces]
    volume = (np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum()
    return points, faces if volume > 0 else faces[:, ::-1].copy()
