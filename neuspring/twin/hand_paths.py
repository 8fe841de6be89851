"""How far hands are from a camera without depth, and so where their controllers are.

A hand is a rigid patch. In the image its grip is at u(t), turned by a(t), at s(t) times its size of frame 0: all tracked, in all
frames. Its depth z(t) along the optical axis is not seen. It is

    z(t) / z(0) = min(p(t)^(1 - g) s(t)^(-g) k(t), l(t))

p    from a plane through the grip of frame 0 in which the hand moves: the ray through u(t) meets it at depth p(t) z(0). The plane
     contains the horizontal direction of the image; at a tilt of 0 degrees it is upright and faces the camera, at 90 level.
g    `hand_size`: how much of the depth follows from the apparent size.
l    the same of the level plane: a hand that holds a thing on the table does not go below its grip of frame 0.
k    factors `hand_depth` at a few knots of the training frames, 1 in frame 0, joined by a cubic (PCHIP) of their logarithms, and
     constant after the last knot.

Tilt, g and k are searched with the material, in training frames. In future frames nothing of the object is read: z follows from the
hand's own image motion and size, and from what the training frames taught. The patch keeps its shape, is turned by a(t) about the
ray, and follows z(t) and u(t).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from neuspring.core.artifacts import ImageObservations, Observations, Twin

KNOTS = 3
"""Knots of each hand's depth, spread evenly over the training frames after frame 0."""
LEVEL = 90.0
"""Tilt of the level plane, degrees."""
NEAREST, FARTHEST = 0.5, 2.0
"""Depth of a hand over that of frame 0: beyond, the plane is seen edge on and says nothing."""


def names(image: ImageObservations) -> tuple[str, ...]:
    """Variables of the hands: tilt and size of all, and the factors of each hand, knot by knot. None where hands are given."""
    if not image.hands:
        return ()
    return ("hand_tilt", "hand_size", *(f"hand_depth.{k}" for k in range(KNOTS * image.hands)))


def with_hands(observations: Observations, twin: Twin) -> Observations:
    """The observations with the controllers where the twin's hands are; where they are known in space, as they are."""
    if observations.image is None or not twin.hands:
        return observations
    return replace(observations, controller_points=hand_points(observations, twin.hands))


def hand_points(observations: Observations, values: Mapping[str, float]) -> np.ndarray:
    """Controllers [T, C, 3], m, for values of the variables `names`."""
    image = observations.image
    assert image is not None
    depths = depths_of(image, values, observations.scenario.train_end, observations.scenario.up_sign)
    return place(image, observations.controller_points[0].astype(np.float64), depths)


def depths_of(image: ImageObservations, values: Mapping[str, float], train_end: int, up: float) -> np.ndarray:
    """z(t) / z(0) of each hand [T, H]; up is +1 or -1."""
    factors = np.array([value for name, value in values.items() if name.startswith("hand_depth.")]).reshape(image.hands, -1)
    share = values["hand_size"]
    plane = plane_depths(image, values["hand_tilt"], up)
    curve = knot_curve(factors, train_end, len(image.hand_centers))
    free = plane ** (1 - share) * image.hand_sizes.astype(np.float64) ** -share * curve
    return np.minimum(free, plane_depths(image, LEVEL, up))  # type: ignore[no-any-return]


def plane_depths(image: ImageObservations, tilt: float, up: float) -> np.ndarray:
    """p(t) [T, H]: with rays r = K^-1 [u, 1] and the plane's normal n in camera axes, p = (n . r(0)) / (n . r(t)).

    The normal of the upright plane is the horizontal part of the optical axis; `tilt`, degrees, turns it towards up.
    """
    rotation = image.camera_to_world[:3, :3]
    axis = rotation[:, 2] * [1.0, 1.0, 0.0]
    if np.linalg.norm(axis) < 1e-3:
        # Straight down: up in the image is the horizontal direction away from the camera.
        axis = -rotation[:, 1] * [1.0, 1.0, 0.0]
    angle = np.deg2rad(tilt)
    normal = (np.cos(angle) * axis / np.linalg.norm(axis) + np.sin(angle) * np.array([0.0, 0.0, -up])) @ rotation
    along = rays(image, image.hand_centers.astype(np.float64)) @ normal
    facing = along[0] * along > 0
    ratio = np.divide(np.broadcast_to(along[0], along.shape), along, out=np.full(along.shape, FARTHEST), where=facing)
    return np.clip(ratio, NEAREST, FARTHEST)  # type: ignore[no-any-return]


def knot_curve(factors: np.ndarray, train_end: int, frames: int) -> np.ndarray:
    """k(t) [frames, H] of factors [H, K] at the knots i (train_end - 1) / K, i = 1 to K."""
    from scipy.interpolate import PchipInterpolator

    count = factors.shape[1]
    if not count:
        return np.ones((frames, len(factors)))
    knots = np.linspace(0, train_end - 1, count + 1)
    logs = np.concatenate([np.zeros((len(factors), 1)), np.log(factors)], axis=1)
    curve: np.ndarray = np.exp(PchipInterpolator(knots, logs, axis=1)(np.minimum(np.arange(frames), train_end - 1))).T
    return curve


def rays(image: ImageObservations, pixels: np.ndarray) -> np.ndarray:
    """K^-1 [x, y, 1] of pixels [..., 2], [..., 3]: points at depth 1 in camera axes."""
    ones = np.ones((*pixels.shape[:-1], 1))
    return np.asarray(np.concatenate([pixels, ones], axis=-1) @ np.linalg.inv(image.intrinsics).T)


def place(image: ImageObservations, first: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Controllers [T, C, 3], m, from those of frame 0 [C, 3] and z(t) / z(0) [T, H].

    In camera axes, with the grip's point g(t) at depth z(t) on the ray through u(t): x(t) = g(t) + R(a(t)) (x(0) - g(0)), R a turn
    about that ray.
    """
    from scipy.spatial.transform import Rotation

    pose = image.camera_to_world
    local = (first - pose[:3, 3]) @ pose[:3, :3]
    result = np.empty((len(depths), *local.shape))
    directions = rays(image, image.hand_centers.astype(np.float64))
    for hand in range(image.hands):
        own = np.flatnonzero(image.hand_of == hand)
        center = directions[0, hand] * local[own, 2].mean()
        at = directions[:, hand] * (depths[:, hand] * center[2])[:, None]
        axes = directions[:, hand] / np.linalg.norm(directions[:, hand], axis=1, keepdims=True)
        turns = Rotation.from_rotvec(axes * image.hand_angles[:, hand, None].astype(np.float64))
        for frame in range(len(depths)):
            result[frame, own] = at[frame] + turns[frame].apply(local[own] - center)
    result[0] = local
    return np.asarray(result @ pose[:3, :3].T + pose[:3, 3])
