"""What the cameras do not see of the object in frame 0: a closed surface by carving voxels, or none.

A voxel belongs to the hull if every camera that has it in its image sees the object there, or a hand before it, and does not look
through it: the measured depth is not behind the voxel. At least one camera must see the object there, else a hand seen by all would
belong. What is under the table does not belong.
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

EMPTY = (np.zeros((0, 3)), np.zeros((0, 3), dtype=int))


def shape_prior(capture: Capture, masks: Mapping[str, Masks], cloud: np.ndarray, settings: ShapePriorSettings) -> ShapePrior:
    """The prior of the chosen backend."""
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
    """Nothing but what was seen."""
    return ShapePrior(vertices=EMPTY[0], faces=EMPTY[1], backend="none")


def visual_hull(capture: Capture, masks: Mapping[str, Masks], cloud: np.ndarray, settings: ShapePriorSettings) -> ShapePrior:
    """Carve the surroundings of the object's `cloud` [P, 3], m, of frame 0. Raises InputError if nothing remains."""
    sign = 1.0 if capture.description.up == "+z" else -1.0
    margin = settings.margin
    low, high = cloud.min(axis=0) - margin, cloud.max(axis=0) + margin
    grid = _grid(low, high, settings.voxel)
    inside = sign * grid[..., 2] > 0
    shown = np.zeros_like(inside)
    for name, camera in capture.cameras.items():
        if not (masks[name].labels[0] == OBJECT).any():
            # A camera that does not have the object in view says nothing about it.
            continue
        admitted, shows = _consistent(grid, camera, masks[name].labels[0], capture.depth(name, 0), settings.tolerance)
        inside, shown = inside & admitted, shown | shows
    inside &= shown
    if settings.symmetry:
        inside |= _mirrored(inside, grid, cloud, settings.voxel)
    inside = _largest(inside)
    vertices, faces = _surface(inside, low, settings.voxel, settings.smoothing)
    if not len(faces):
        rule = f"more than specks of {1e3 * settings.voxel:g} mm must be consistent with all cameras"
        remedy = "Masks, depth and calibration of frame 0 contradict each other; or take perception.shape.backend: none."
        raise InputError(f"{capture.folder}, visual hull", rule, f"{inside.sum()} voxels", remedy)
    volume = float(inside.sum() * settings.voxel**3)
    return ShapePrior(
        vertices=vertices, faces=faces, backend="visual_hull", facts={"volume": volume, "cameras": len(capture.cameras)}
    )


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


def _mirrored(inside: np.ndarray, grid: np.ndarray, cloud: np.ndarray, voxel: float) -> np.ndarray:
    """The hull's mirror image in the vertical plane through the cloud's middle that it is most symmetric to."""
    points = grid[inside]
    centre = points.mean(axis=0)
    best, found = -1.0, np.zeros_like(inside)
    for angle in np.linspace(0.0, np.pi, 36, endpoint=False):
        normal = np.array([np.cos(angle), np.sin(angle), 0.0])
        image = points - 2.0 * ((points - centre) @ normal)[:, None] * normal
        index = np.round((image - grid[0, 0, 0]) / voxel).astype(int)
        within = ((index >= 0) & (index < inside.shape)).all(axis=1)
        overlap = inside[tuple(index[within].T)].mean() if within.any() else 0.0
        if overlap > best:
            best, found = float(overlap), np.zeros_like(inside)
            found[tuple(index[within].T)] = True
    return np.asarray(ndimage.binary_closing(found))


def _largest(inside: np.ndarray) -> np.ndarray:
    labels, count = ndimage.label(inside)
    if count < 2:
        return inside
    return np.asarray(labels == np.bincount(labels[inside]).argmax())


def _surface(inside: np.ndarray, low: np.ndarray, voxel: float, smoothing: float) -> tuple[np.ndarray, np.ndarray]:
    """Marching cubes of the occupancy, blurred over `smoothing` voxels, padded so that the surface closes."""
    padded = np.pad(inside.astype(np.float32), 2)
    level = 0.5 - ndimage.gaussian_filter(padded, smoothing)
    values: wp.array = wp.array(level, dtype=wp.float32, device="cpu")
    vertices, indices = IsoSurfaceMarchingCubes.extract_surface_marching_cubes(values, 0.0)  # type: ignore[arg-type]
    faces = indices.numpy().reshape(-1, 3)
    points = low + voxel * (vertices.numpy().astype(float) - 2.0)
    corners = points[faces]
    volume = (np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum()
    return points, faces if volume > 0 else faces[:, ::-1].copy()


def _grid(low: np.ndarray, high: np.ndarray, voxel: float) -> np.ndarray:
    """Voxel centres [nx, ny, nz, 3]."""
    counts = np.ceil((high - low) / voxel).astype(int) + 1
    return low + voxel * np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1)
