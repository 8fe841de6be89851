"""The shape prior, which completes what the cameras do not see in frame 0: a closed surface by carving voxels, or none.

A voxel belongs to the hull if no camera that has the object in view contradicts it, and at least one shows the object there. A
camera contradicts a voxel if its mask shows neither the object nor a hand before it, or if it measured depth behind the voxel.
Without the second condition a hand that all cameras see would belong to the hull. Nothing under the table belongs to it.

Where one camera alone shows the object there is no other witness: pixels of its mask without depth carve with the depth nearest to
them, and the hull ends at the back that `perception.shape.back` guesses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import warp as wp
from scipy import ndimage
from warp.geometry import IsoSurfaceMarchingCubes

from neuspring.config.perception import ShapePriorSettings
from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT, Camera, Capture
from neuspring.perception.results import Masks, ShapePrior
from neuspring.perception.shape_back import back, front
from neuspring.perception.shape_seen import invented_share, seen

SEEN_WITHIN = 4.0
"""Voxels between a vertex of the shape and the depth of a camera that saw it: carving and smoothing move a surface by less."""


def shape_prior(capture: Capture, masks: Mapping[str, Masks], cloud: np.ndarray, settings: ShapePriorSettings) -> ShapePrior:
    """The prior of the backend that `settings` names, with the share of its surface that no camera saw.

    `cloud` [P, 3], m, is what was seen of the object in frame 0.
    """
    prior = _prior(capture, masks, cloud, settings)
    if not len(prior.faces):
        return prior
    was_seen = seen(prior.vertices, capture, masks, SEEN_WITHIN * settings.voxel, prior.faces)
    share = invented_share(prior.vertices, prior.faces, was_seen)
    return replace(prior, seen=was_seen, facts={**prior.facts, "invented_share": share})


def _prior(capture: Capture, masks: Mapping[str, Masks], cloud: np.ndarray, settings: ShapePriorSettings) -> ShapePrior:
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
    # A camera that does not have the object in view says nothing about it.
    showing = [name for name in capture.cameras if (masks[name].labels[0] == OBJECT).any()]
    sign = 1.0 if capture.description.up == "+z" else -1.0
    # Measured depth by camera, and where the object ends, if that is guessed.
    sides: dict[str, tuple[np.ndarray, np.ndarray | None]] = {name: (capture.depth(name, 0), None) for name in showing}
    space, facts = cloud, dict[str, float]()
    if len(showing) == 1:
        camera, labels = capture.cameras[showing[0]], masks[showing[0]].labels[0]
        filled, end = one_sided(camera, labels, sides[camera.name][0], cloud, settings)
        facts["depth_filled"] = float((filled != sides[camera.name][0])[labels == OBJECT].mean())
        sides[camera.name] = (filled, end)
        if end is not None:
            y, x = np.nonzero(labels == OBJECT)
            space = np.concatenate([cloud, camera.lift(np.stack([x, y], axis=1).astype(float), end[y, x])])
    low, high = space.min(axis=0) - settings.margin, space.max(axis=0) + settings.margin
    counts = np.ceil((high - low) / settings.voxel).astype(int) + 1
    # Voxel centers [nx, ny, nz, 3].
    grid = low + settings.voxel * np.moveaxis(np.indices(counts), 0, -1)
    hull = sign * grid[..., 2] > 0
    shown = np.zeros_like(hull)
    for name in showing:
        admitted, shows = _consistent(grid, capture.cameras[name], masks[name].labels[0], *sides[name], settings.tolerance)
        hull, shown = hull & admitted, shown | shows
    hull = _largest_piece(hull & shown)
    vertices, faces = _surface(hull, low, settings.voxel, settings.smoothing)
    if not len(faces):
        rule = f"more than specks of {1e3 * settings.voxel:g} mm must be consistent with all cameras"
        remedy = "Masks, depth and calibration of frame 0 contradict each other; or take perception.shape.backend: none."
        raise InputError(f"{capture.folder}, visual hull", rule, f"{hull.sum()} voxels", remedy)
    facts |= {"volume": float(hull.sum() * settings.voxel**3), "cameras": len(showing)}
    backend = "visual_hull" if len(showing) > 1 else f"visual_hull, back: {settings.back}"
    return ShapePrior(vertices=vertices, faces=faces, backend=backend, facts=facts)


def one_sided(
    camera: Camera, labels: np.ndarray, depth: np.ndarray, cloud: np.ndarray, settings: ShapePriorSettings
) -> tuple[np.ndarray, np.ndarray | None]:
    """Depth of the seen surface [H, W], m, without holes, and of the back; None where that is not guessed."""
    distance = camera.project(cloud)[1]
    # What lies far before or behind all usable points shines through, or is noise.
    near, far = float(distance.min()) - settings.margin, float(distance.max()) + settings.margin
    filled = np.where(labels == OBJECT, front(labels == OBJECT, depth, near, far), depth)
    if settings.back == "none":
        return filled, None
    return filled, back(labels, filled, camera.intrinsics[0, 0], settings.back, settings.back_fraction)


def _consistent(
    grid: np.ndarray, camera: Camera, labels: np.ndarray, depth: np.ndarray, end: np.ndarray | None, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Whether one camera admits each voxel [nx, ny, nz] bool, and whether it shows the object there, not a hand before it.

    It admits nothing behind the object's `end` [H, W], m, if there is a guess of that.
    """
    pixels, distance = camera.project(grid.reshape(-1, 3))
    admitted, shows = np.ones(len(distance), dtype=bool), np.zeros(len(distance), dtype=bool)
    ahead = np.flatnonzero(camera.sees(pixels) & (distance > 0))
    x, y = np.round(pixels[ahead]).astype(int).T
    label, measured = labels[y, x], depth[y, x]
    behind = (measured <= 0) | (distance[ahead] >= measured - tolerance)
    if end is not None:
        behind &= (label != OBJECT) | (distance[ahead] <= end[y, x])
    admitted[ahead] = behind & ((label == OBJECT) | (label == HANDS))
    shows[ahead] = behind & (label == OBJECT)
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
