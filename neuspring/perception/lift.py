"""Tracks of all cameras -> points in the world: cleaned masks, visibility, motion agreement, controllers.

A vectorized version of sections 2.5 to 2.7 of PhysTwin's released processing. Unlike the released code, the result does not
depend on the order of points, and the outlier test uses distances instead of single coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from neuspring.checks.perceived import look_at_lifted
from neuspring.config.perception import Lift, Perception
from neuspring.core.errors import InputError
from neuspring.data.camera import Camera
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.results import LiftedTracks, Masks, PixelTracks
from neuspring.intake.points import held, read
from neuspring.perception.backends import Lifted
from neuspring.perception.controllers import ALWAYS, HAND_GAP, SeenBody, choose_controllers, holding
from neuspring.perception.shape import no_prior, shape_prior

NEAREST, FARTHEST = 0.2, 1.5
"""Range of usable depth, m along the optical axis, as released."""
OUTLIER_NEIGHBORS, REFERENCE_FOCAL = 40.0, 430.0
"""A masked pixel must have more neighbors than this at the reference focal length, pixels; scaled by the focal length squared."""
DEPTH_WINDOW = 3
"""Side of the window, pixels: a track gets the median depth inside the mask in it."""
LEAST_NEIGHBORS = 5
"""Smallest number of neighbors of a trusted motion, itself included."""
AGREEMENT = 0.005
"""m: at least half of a motion's neighbors must agree with it within this distance, as released."""
NEAR_STRIDE = 3
"""Every third pixel of object and hands is used for their distance."""


@dataclass(frozen=True)
class Seen:
    """Points of object or hands over time."""

    points: np.ndarray
    """[T, n, 3], m; zero if not visible."""
    visible: np.ndarray
    """[T, n] bool."""
    colors: np.ndarray
    """[n, 3] RGB in frame 0, 0 to 1."""

    @classmethod
    def of_all(cls, cameras: list[Seen]) -> Seen:
        """Concatenate the points of several cameras."""
        points = np.concatenate([camera.points for camera in cameras], axis=1)
        visible = np.concatenate([camera.visible for camera in cameras], axis=1)
        return cls(points, visible, np.concatenate([camera.colors for camera in cameras]))


def lift(capture: Capture, masks: Mapping[str, Masks], tracks: Mapping[str, PixelTracks], settings: Perception) -> Lifted:
    """Lift tracks of cameras with depth; compute the shape prior unless the capture contains nodes. Raises InputError."""
    lifted = lift_tracks(capture, masks, tracks, settings.lift)
    given = len(read(capture).nodes)
    prior = no_prior() if given else shape_prior(capture, masks, lifted.cloud, settings.shape)
    return Lifted(tracks=lifted, prior=prior, findings=look_at_lifted(lifted, prior, capture.description.up_sign))


def lift_tracks(capture: Capture, masks: Mapping[str, Masks], tracks: Mapping[str, PixelTracks], settings: Lift) -> LiftedTracks:
    """Lift all tracks to the world; controllers are those of the capture, or are chosen from tracks of the hands.

    Raises InputError if no track of the object or too few of the hands remain.
    """
    cameras = capture.cameras
    labels, cloud, colors = clean_masks(capture, masks, settings.neighborhood)
    objects, hands = (
        Seen.of_all([_lifted(capture, camera, tracks[name], labels[name] == label) for name, camera in cameras.items()])
        for label in (OBJECT, HANDS)
    )
    where = f"{capture.folder}, perception"
    if not objects.points.shape[1]:
        shown = sum(int((mask.labels[0] == OBJECT).sum()) for mask in masks.values())
        usable = sum(int((label[0] == OBJECT).sum()) for label in labels.values())
        received = f"no track, and {shown} mask pixels of the object, {usable} of them with usable depth and enough neighbors"
        remedy = f"Check masks.png and tracks.png; usable depth is {NEAREST:g} to {FARTHEST:g} m."
        raise InputError(where, "at least one tracked point must be on the object in frame 0", received, remedy)
    valid = agreeing_motion(objects, settings.neighborhood)
    space = read(capture)
    if space.hands is None:
        moving = agreeing_motion(hands, settings.neighborhood)
        controllers, facts = choose_controllers(hands.points, hands.visible, moving, cloud, settings, where)
        body, in_view = _body(capture, cameras, labels, objects)
        grips = holding(controllers, (hands.points, hands.visible), body, in_view, settings.release or HAND_GAP)
        holds = ALWAYS if settings.release is None else grips.holds
        if settings.release is not None and grips.elsewhere is not None:
            facts["grip_elsewhere"] = float(grips.elsewhere)
        if grips.strays:
            facts |= {"stray_hand_frames": float(len(grips.strays)), "stray_hand_first": float(grips.strays[0])}
    else:
        controllers, holds = held(space.hands, space.tracks, capture.train_end), space.hands.holds
        facts = {"controllers": float(controllers.shape[1])}
    if len(holds):
        first = float(np.flatnonzero(~holds.all(axis=1))[0])
        facts |= {"controllers_let_go": float((~holds).any(axis=0).sum()), "first_let_go": first}
    facts |= {
        "object_tracks": float(objects.points.shape[1]),
        "hand_tracks": float(hands.points.shape[1]),
        "visible_share": float(objects.visible.mean()),
        "motion_valid_share": float(valid[:-1].mean()),
    }
    return LiftedTracks(
        object_points=objects.points,
        object_visibility=objects.visible,
        object_motion_valid=valid,
        object_colors=objects.colors,
        controller_points=controllers,
        controller_valid=holds,
        cloud=cloud,
        cloud_colors=colors,
        backend="vectorised",
        facts=facts,
    )


def _body(
    capture: Capture, cameras: Mapping[str, Camera], labels: Mapping[str, np.ndarray], objects: Seen
) -> tuple[SeenBody, np.ndarray]:
    """Evidence for grasps, and whether any mask shows a hand [T]. Reads depth again."""
    clouds: dict[int, list[np.ndarray]] = {OBJECT: [], HANDS: []}
    for frame in range(capture.train_end):
        depths = {name: capture.depth(name, frame) for name in cameras if capture.has(name, frame)}
        for label, points in clouds.items():
            seen = [np.zeros((0, 3))]
            for name, depth in depths.items():
                y, x = (values[::NEAR_STRIDE] for values in np.nonzero(labels[name][frame] == label))
                seen.append(cameras[name].lift(np.stack([x, y], axis=1).astype(float), depth[y, x]))
            points.append(np.concatenate(seen))
    in_view = np.any([(label == HANDS).any(axis=(1, 2)) for label in labels.values()], axis=0)
    return SeenBody(clouds[OBJECT], clouds[HANDS], objects.points, objects.visible), in_view


def clean_masks(
    capture: Capture, masks: Mapping[str, Masks], neighborhood: float, frames: int | None = None
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Cleaned labels [T, H, W] per camera, and the object's point cloud in frame 0 [P, 3], m, with colors [P, 3].

    Removes pixels without usable depth, and pixels whose points have too few neighbors. `frames`: clean only so many frames.
    """
    cameras = capture.cameras
    labels = {name: np.zeros_like(mask.labels) for name, mask in masks.items()}
    cloud, colors = np.zeros((0, 3)), np.zeros((0, 3))
    # The density of points on a surface is proportional to the squared focal length.
    focal = {name: camera.intrinsics[0, 0] for name, camera in cameras.items()}
    least = {name: OUTLIER_NEIGHBORS * (length / REFERENCE_FOCAL) ** 2 for name, length in focal.items()}
    for frame in range(frames or capture.frame_count):
        names = [name for name in cameras if capture.has(name, frame)]
        if not names:
            continue
        depths = {name: capture.depth(name, frame) for name in names}
        for label in (OBJECT, HANDS):
            pixels, points = {}, []
            for name in names:
                # A repeated image shows the object at an old position.
                depth = depths[name] * (label == HANDS or capture.shows(name, frame))
                pixels[name] = np.nonzero((masks[name].labels[frame] == label) & (depth > NEAREST) & (depth < FARTHEST))
                y, x = pixels[name]
                points.append(cameras[name].lift(np.stack([x, y], axis=1).astype(float), depth[y, x]))
            needed = np.concatenate([np.full(len(part), least[name]) for name, part in zip(names, points, strict=True)])
            stays = _crowded(np.concatenate(points), neighborhood, needed)
            for name, own in zip(names, np.split(stays, np.cumsum([len(part) for part in points])[:-1]), strict=True):
                y, x = pixels[name]
                labels[name][frame, y[own], x[own]] = label
            if frame == 0 and label == OBJECT:
                cloud = np.concatenate(points)[stays]
                colors = np.concatenate([capture.color(name, 0)[pixels[name]] / 255.0 for name in names])[stays]
    return labels, cloud, colors


def agreeing_motion(seen: Seen, neighborhood: float) -> np.ndarray:
    """[T, n] bool for the motion from t to t + 1: the point is visible in both frames, and half of its neighbors agree."""
    valid = np.zeros_like(seen.visible)
    for frame in range(len(seen.points) - 1):
        if len(moving := np.flatnonzero(seen.visible[frame] & seen.visible[frame + 1])):
            here = seen.points[frame, moving]
            valid[frame, moving] = _agreeing(here, seen.points[frame + 1, moving] - here, neighborhood)
    return valid


def _agreeing(points: np.ndarray, motion: np.ndarray, neighborhood: float) -> np.ndarray:
    """Agreement of each motion with those of all neighbors, independent of their order."""
    pairs = cKDTree(points).query_pairs(neighborhood, output_type="ndarray")
    same = np.linalg.norm(motion[pairs[:, 0]] - motion[pairs[:, 1]], axis=1) < AGREEMENT
    count = np.bincount(pairs.ravel(), minlength=len(points)) + 1
    agreeing = np.bincount(pairs[same].ravel(), minlength=len(points)) + 1
    return (count >= LEAST_NEIGHBORS) & (agreeing >= 0.5 * count)


def _lifted(capture: Capture, camera: Camera, tracks: PixelTracks, inside: np.ndarray) -> Seen:
    """Lift the tracks of one camera that start inside the mask `inside` [T, H, W]."""
    rounded = np.round(tracks.pixels).astype(int)
    visible = tracks.visible & camera.sees(tracks.pixels)
    for frame, seen in enumerate(visible):
        x, y = rounded[frame, seen].T
        seen[seen] = inside[frame, y, x]
    starting = visible[0]
    rounded, visible = rounded[:, starting], visible[:, starting]
    pixels = tracks.pixels[:, starting]
    points = np.zeros((*visible.shape, 3))
    for frame, seen in enumerate(visible):
        if seen.any():
            x, y = rounded[frame, seen].T
            depth = local_depth(capture.depth(camera.name, frame), inside[frame], x, y)
            points[frame, seen] = camera.lift(pixels[frame, seen].astype(float), depth)
    x, y = rounded[0].T
    return Seen(points, visible, capture.color(camera.name, 0)[y, x] / 255.0)


def local_depth(depth: np.ndarray, inside: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Median depth [n], m, of the mask pixels around (x, y); (x, y) must be inside the mask."""
    reach = np.arange(DEPTH_WINDOW) - DEPTH_WINDOW // 2
    rows = np.clip(y[:, None, None] + reach[:, None], 0, depth.shape[0] - 1)
    columns = np.clip(x[:, None, None] + reach[None, :], 0, depth.shape[1] - 1)
    values = np.where(inside[rows, columns], depth[rows, columns], np.nan)
    return np.asarray(np.nanmedian(values.reshape(len(x), -1), axis=1))


def _crowded(points: np.ndarray, radius: float, least: np.ndarray) -> np.ndarray:
    """True for points [n] with more than `least` [n] points within `radius`, themselves included."""
    if not len(points):
        return np.zeros(0, dtype=bool)
    return np.asarray(cKDTree(points).query_ball_point(points, radius, return_length=True) > least)
