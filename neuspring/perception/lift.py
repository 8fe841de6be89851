"""Tracks of all cameras -> points in the world: cleaned masks, visibility, agreement of motion, controllers.

After sections 2.5 to 2.7 of the processing that PhysTwin released, vectorised. Where its result depends on the order of points, or
its outlier test on single coordinates, ours does not; the released behaviour is a switch of `perception.lift`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from neuspring.config.perception import Lift
from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT, Camera, Capture
from neuspring.perception.controllers import choose_controllers
from neuspring.perception.results import LiftedTracks, Masks, PixelTracks

REFERENCE_FOCAL = 430.0
"""Pixels: `outlier_neighbours` is meant for images of this focal length; with it the number of pixels on a surface grows."""


@dataclass(frozen=True)
class Seen:
    """Points of one kind over time."""

    points: np.ndarray
    """[T, n, 3], m; zeros where not visible."""
    visible: np.ndarray
    """[T, n] bool."""
    colours: np.ndarray
    """[n, 3] RGB in frame 0, 0 to 1."""

    def pick(self, chosen: np.ndarray) -> Seen:
        """Some of the points."""
        return Seen(self.points[:, chosen], self.visible[:, chosen], self.colours[chosen])


def lift(capture: Capture, masks: dict[str, Masks], tracks: dict[str, PixelTracks], settings: Lift) -> LiftedTracks:
    """Everything that the cameras saw, in the world.

    Raises InputError where nothing of the object or too little of the hands remains.
    """
    cameras = lifting_cameras(capture, settings)
    kept, cloud, colours = clean_masks(capture, cameras, masks, settings)
    seen = {}
    for label in (OBJECT, HANDS):
        each = [_lifted(capture, cameras[name], tracks[name], kept[name] == label, settings) for name in cameras]
        joined = (np.concatenate(values, axis=axis) for values, axis in zip(zip(*each, strict=True), (1, 1, 0), strict=True))
        seen[label] = Seen(*joined)
    where = f"{capture.folder}, perception"
    objects, hands = seen[OBJECT], seen[HANDS]
    if not objects.points.shape[1]:
        shown = sum(int((mask.labels[0] == OBJECT).sum()) for mask in masks.values())
        left = sum(int((labels[0] == OBJECT).sum()) for labels in kept.values())
        found = f"{shown} pixels of the object's masks, {left} of them with depth in range and enough neighbours, no track"
        remedy = "Look at masks and tracks; perception.lift has depth_range, neighbourhood and outlier_neighbours."
        raise InputError(where, "at least one tracked point must lie on the object in frame 0", found, remedy)
    valid = agreeing_motion(objects, settings)
    hand_valid = agreeing_motion(hands, settings)
    controllers, facts = choose_controllers(hands.points, hands.visible, hand_valid, settings, where)
    return LiftedTracks(
        object_points=objects.points,
        object_visibility=objects.visible,
        object_motion_valid=valid,
        object_colours=objects.colours,
        controller_points=controllers,
        cloud=cloud,
        cloud_colours=colours,
        backend="released" if settings.sequential_motion_filter else "vectorised",
        facts=facts
        | {
            "object_tracks": float(objects.points.shape[1]),
            "hand_tracks": float(hands.points.shape[1]),
            "visible_share": float(objects.visible.mean()),
            "motion_valid_share": float(valid[:-1].mean()),
        },
    )


def lifting_cameras(capture: Capture, settings: Lift) -> dict[str, Camera]:
    """The cameras as pixels are lifted with."""
    return {name: _mirrored(camera) if settings.mirrored_principal_point else camera for name, camera in capture.cameras.items()}


def clean_masks(
    capture: Capture, cameras: Mapping[str, Camera], masks: Mapping[str, Masks], settings: Lift, frames: int | None = None
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Labels [T, H, W] per camera without pixels that have no usable depth or float alone, and the object's cloud of frame 0 [P, 3]
    with its colours [P, 3]. Only the first `frames` are cleaned, if given."""
    kept = {name: np.zeros_like(mask.labels) for name, mask in masks.items()}
    cloud, colours = np.zeros((0, 3)), np.zeros((0, 3))
    # A camera sees a surface with a density of points that goes with the square of its focal length.
    least = {n: settings.outlier_neighbours * (c.intrinsics[0, 0] / REFERENCE_FOCAL) ** 2 for n, c in cameras.items()}
    for frame in range(frames or capture.frame_count):
        there = [name for name in cameras if capture.has(name, frame)]
        if not there:
            continue
        depths = {name: capture.depth(name, frame) for name in there}
        for label in (OBJECT, HANDS):
            pixels = {name: _usable(masks[name].labels[frame] == label, depths[name], settings) for name in there}
            points = [_cloud(cameras[name], pixels[name], depths[name]) for name in there]
            needed = np.concatenate([np.full(len(p), least[name]) for name, p in zip(there, points, strict=True)])
            stays = _crowded(np.concatenate(points), settings.neighbourhood, needed, settings.coordinate_outliers)
            for name, own in zip(there, np.split(stays, np.cumsum([len(p) for p in points])[:-1]), strict=True):
                y, x = (axis[own] for axis in pixels[name])
                kept[name][frame, y, x] = label
            if frame == 0 and label == OBJECT:
                cloud = np.concatenate(points)[stays]
                rgb = [capture.colour(name, 0)[pixels[name]] / 255.0 for name in there]
                colours = np.concatenate(rgb)[stays]
    return kept, cloud, colours


def agreeing_motion(seen: Seen, settings: Lift) -> np.ndarray:
    """[T, n] bool, row t for the motion from t to t + 1: visible in both, with enough neighbours of which half move alike."""
    test = _sequential if settings.sequential_motion_filter else _simultaneous
    valid = np.zeros_like(seen.visible)
    for frame in range(len(seen.points) - 1):
        moving = np.flatnonzero(seen.visible[frame] & seen.visible[frame + 1])
        if len(moving):
            here = seen.points[frame, moving]
            valid[frame, moving] = test(here, seen.points[frame + 1, moving] - here, settings)
    return valid


def _simultaneous(points: np.ndarray, motion: np.ndarray, settings: Lift) -> np.ndarray:
    """All points judged by all: independent of their order."""
    pairs = cKDTree(points).query_pairs(settings.neighbourhood, output_type="ndarray")
    alike = np.linalg.norm(motion[pairs[:, 0]] - motion[pairs[:, 1]], axis=1) < settings.agreement
    count = np.bincount(pairs.ravel(), minlength=len(points)) + 1
    agreeing = np.bincount(pairs[alike].ravel(), minlength=len(points)) + 1
    return (count >= settings.least_neighbours) & (agreeing >= 0.5 * count)


def _sequential(points: np.ndarray, motion: np.ndarray, settings: Lift) -> np.ndarray:
    """As released: points in order, each judged by those not dropped before it."""
    valid = np.ones(len(points), dtype=bool)
    for i, near in enumerate(cKDTree(points).query_ball_point(points, settings.neighbourhood)):
        neighbours = np.array([j for j in near if valid[j]], dtype=int)
        alike = np.linalg.norm(motion[neighbours] - motion[i], axis=1) < settings.agreement
        valid[i] = len(neighbours) >= settings.least_neighbours and alike.sum() >= 0.5 * len(neighbours)
    return valid


def _lifted(
    capture: Capture, camera: Camera, tracks: PixelTracks, inside: np.ndarray, settings: Lift
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [T, n, 3], visibility [T, n] and colours [n, 3] of the tracks that start inside the mask `inside` [T, H, W]."""
    frames = capture.frame_count
    hit = np.zeros((frames, tracks.pixels.shape[1]), dtype=bool)
    rounded = np.round(tracks.pixels).astype(int)
    for frame in range(frames):
        seen = tracks.visible[frame] & camera.sees(tracks.pixels[frame])
        x, y = rounded[frame, seen].T
        hit[frame, seen] = inside[frame, y, x]
    own = hit[0]
    visible, pixels = hit[:, own], tracks.pixels[:, own]
    points = np.zeros((*visible.shape, 3))
    for frame in range(frames):
        if visible[frame].any():
            seen = visible[frame]
            x, y = rounded[frame][own][seen].T
            depth = local_depth(capture.depth(camera.name, frame), inside[frame], x, y, settings.depth_window)
            place = rounded[frame][own][seen] if settings.whole_pixels else pixels[frame, seen]
            points[frame, seen] = camera.lift(place.astype(float), depth)
    x, y = rounded[0, own].T
    return points, visible, capture.colour(camera.name, 0)[y, x] / 255.0


def local_depth(depth: np.ndarray, inside: np.ndarray, x: np.ndarray, y: np.ndarray, window: int) -> np.ndarray:
    """Median depth [n], m, of the pixels around (x, y) that belong to the same mask; (x, y) itself does."""
    reach = np.arange(window) - window // 2
    rows = np.clip(y[:, None, None] + reach[:, None], 0, depth.shape[0] - 1)
    columns = np.clip(x[:, None, None] + reach[None, :], 0, depth.shape[1] - 1)
    values = np.where(inside[rows, columns], depth[rows, columns], np.nan)
    return np.asarray(np.nanmedian(values.reshape(len(x), -1), axis=1))


def _usable(mask: np.ndarray, depth: np.ndarray, settings: Lift) -> tuple[np.ndarray, np.ndarray]:
    low, high = settings.depth_range
    y, x = np.nonzero(mask & (depth > low) & (depth < high))
    return y, x


def _cloud(camera: Camera, pixels: tuple[np.ndarray, np.ndarray], depth: np.ndarray) -> np.ndarray:
    y, x = pixels
    return camera.lift(np.stack([x, y], axis=1).astype(float), depth[y, x])


def _crowded(points: np.ndarray, radius: float, least: np.ndarray, by_coordinate: bool) -> np.ndarray:
    """Whether more than `least` [n] points, itself included, lie within `radius` of each [n] bool.

    `by_coordinate`, as released: a point is also dropped if any one of its coordinates equals that of a dropped point.
    """
    if not len(points):
        return np.zeros(0, dtype=bool)
    stays = cKDTree(points).query_ball_point(points, radius, return_length=True) > least
    if by_coordinate and not stays.all():
        dropped = points[~stays]
        stays &= ~np.any([np.isin(points[:, k], dropped[:, k]) for k in range(3)], axis=0)
    return np.asarray(stays)


def _mirrored(camera: Camera) -> Camera:
    """As the processing did before July 2025: x measured from W - cx."""
    k = camera.intrinsics.copy()
    k[0, 2] = camera.width - k[0, 2]
    return replace(camera, intrinsics=k)
