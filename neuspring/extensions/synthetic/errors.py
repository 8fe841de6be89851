"""Errors of masks, tracks, lifted points, controllers and hull, measured against the truth of synthetic captures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from neuspring.config.perception import ShapePriorSettings
from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.frames import frames_of, overlap
from neuspring.data.results import LiftedTracks, Masks, PixelTracks, ShapePrior
from neuspring.extensions.synthetic.exact import carried
from neuspring.extensions.synthetic.truth import Truth, at_points, under_pixels
from neuspring.perception.sample import inside
from neuspring.perception.shape import visual_hull

IN_MM = 1e3
VOLUME_GRID = 0.003
"""m. Spacing of the grid on which volumes are compared."""
SURFACE_POINTS = 4000
"""Largest number of surface vertices whose distances are averaged."""


def judge(
    capture: Capture,
    truth: Truth,
    masks: Mapping[str, Masks],
    tracks: Mapping[str, PixelTracks],
    lifted: LiftedTracks,
    settings: ShapePriorSettings,
) -> dict[str, float]:
    """Quality measures: lengths in mm, image errors in pixels, fractions and IoU from 0 to 1."""
    facts = mask_quality(capture, masks) | track_quality(capture, truth, tracks) | lifted_quality(truth, lifted)
    if len(truth.tetrahedra):
        facts |= hull_quality(capture, truth, masks, lifted.cloud, settings)
    return facts


def mask_quality(capture: Capture, masks: Mapping[str, Masks]) -> dict[str, float]:
    """Mean intersection over union with the true masks, over the cameras and frames that show the label."""
    views = [(camera, frame) for camera in capture.cameras for frame in frames_of(capture, camera)]
    facts = {}
    for name, label in (("object", OBJECT), ("hands", HANDS)):
        pairs = ((masks[camera].labels[frame] == label, capture.mask(camera, frame) == label) for camera, frame in views)
        facts[f"mask_iou_{name}"] = float(np.mean([overlap(own, true) for own, true in pairs if true.any()]))
    return facts


def track_quality(capture: Capture, truth: Truth, tracks: Mapping[str, PixelTracks]) -> dict[str, float]:
    """Error in pixels of visible object points after frame 0, and the fraction that is still tracked in the last frame."""
    errors, alive = [], []
    for name, camera in capture.cameras.items():
        pixels, visible = tracks[name].pixels, tracks[name].visible
        x, y = np.round(pixels[0]).astype(int).T
        material = under_pixels(truth, camera, pixels[0])
        own = (material.face >= 0) & (capture.mask(name, 0)[y, x] == OBJECT)
        off = np.linalg.norm(camera.project(material.places)[0] - pixels, axis=2)
        errors.append(off[1:][visible[1:] & own])
        alive.append(visible[-1, own])
    facts = _spread("track", np.concatenate(errors), "px")
    return facts | {"track_points": float(sum(map(len, alive))), "track_survival": float(np.concatenate(alive).mean())}


def lifted_quality(truth: Truth, lifted: LiftedTracks) -> dict[str, float]:
    """Distance in mm of lifted points from their nearest material of frame 0, and of controllers from their hand's rigid motion."""
    off = np.linalg.norm(at_points(truth, lifted.object_points[0]).places - lifted.object_points, axis=2)
    visible = lifted.object_visibility[1:]
    trusted = lifted.object_motion_valid[:-1] & visible
    facts = _spread("lifted", IN_MM * off[1:][visible], "mm") | _spread("trusted", IN_MM * off[1:][trusted], "mm")
    facts |= {"lifted_share": float(visible.mean()), "trusted_share": float(trusted.mean())}
    return facts | _spread("controllers", IN_MM * _controller_errors(truth, lifted.controller_points), "mm")


def _controller_errors(truth: Truth, controllers: np.ndarray) -> np.ndarray:
    """Errors of controllers [C, T - 1], m; each is compared with the hand whose motion it follows best."""
    poses = truth.hand_poses.astype(float)
    hands = [carried(controllers[0], poses[:, hand]) for hand in range(poses.shape[1])]
    off = np.stack([np.linalg.norm(places - controllers, axis=2)[1:] for places in hands])
    best = off.mean(axis=1).argmin(axis=0)
    return off[best, :, np.arange(controllers.shape[1])]


def hull_quality(
    capture: Capture, truth: Truth, masks: Mapping[str, Masks], cloud: np.ndarray, settings: ShapePriorSettings
) -> dict[str, float]:
    """Volume IoU and mean surface distance of the visual hull from the first camera, the first two, and so on."""
    surface = ShapePrior(vertices=truth.surface(0), faces=truth.surface_faces, backend="truth")
    facts = {}
    for count in range(1, len(capture.cameras) + 1):
        seen = Capture(capture.folder, replace(capture.description, cameras=capture.description.cameras[:count]))
        try:
            hull = visual_hull(seen, masks, cloud, settings)
        except InputError:
            facts[f"hull_iou_{count}"] = 0.0
            continue
        vertices = np.concatenate([surface.vertices, hull.vertices])
        axes = [np.arange(low, high, VOLUME_GRID) for low, high in zip(vertices.min(axis=0), vertices.max(axis=0), strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        facts[f"hull_iou_{count}"] = overlap(inside(hull, points), inside(surface, points))
        facts[f"hull_distance_{count}_mm"] = IN_MM * _apart(hull.vertices, surface.vertices)
    return facts


def _apart(first: np.ndarray, second: np.ndarray) -> float:
    """Mean distance to the nearest vertex, m, averaged over both directions."""
    rng = np.random.default_rng(0)
    of_first, of_second = (rng.permutation(points)[:SURFACE_POINTS] for points in (first, second))
    return float((cKDTree(second).query(of_first)[0].mean() + cKDTree(first).query(of_second)[0].mean()) / 2.0)


def _spread(name: str, values: np.ndarray, unit: str) -> dict[str, float]:
    """Median and 95th percentile; empty without values."""
    if not values.size:
        return {}
    return {f"{name}_median_{unit}": float(np.median(values)), f"{name}_p95_{unit}": float(np.percentile(values, 95))}
