"""The 22 scenes: their bodies, frame counts and hand motions.

Names, categories and frame counts are those of the PhysTwin data; bodies, materials and motions are our own. Hands are rigid meshes
that follow key frames; they hold what they grasp, or push. The origin of a hand is the point at which its fingers meet.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from neuspring.extensions.synthetic import bodies
from neuspring.extensions.synthetic.bodies import SoftBody
from neuspring.scenes.shapes import Sdf, capsule, ellipsoid, smooth_union, sphere, surface

FIST_RADIUS = 0.032
KeyFrame = tuple[float, Sequence[float], Sequence[float]]
"""Time, s; position, m; rotation vector, rad."""


@dataclass(frozen=True)
class Hand:
    """The motion of a hand. A `grip` holds the nodes within `reach` of its origin from frame 0 on; a `fist` pushes."""

    keys: tuple[KeyFrame, ...]
    kind: Literal["grip", "fist"] = "grip"
    reach: float = 0.02
    """m."""
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Orientation of the mesh in the hand's frame: rotation vector, rad. It does not affect physics."""

    def poses(self, times: np.ndarray) -> np.ndarray:
        """Position and quaternion (x, y, z, w) [n, 7] at `times`, s: minimum jerk from key to key."""
        at = np.array([key[0] for key in self.keys])
        positions = np.array([key[1] for key in self.keys], dtype=float)
        rotations = Rotation.from_rotvec([key[2] for key in self.keys])
        if len(at) == 1:
            return np.tile(np.concatenate([positions[0], rotations[0].as_quat()]), (len(times), 1))
        piece = np.clip(np.searchsorted(at, times, side="right") - 1, 0, len(at) - 2)
        fraction = minimum_jerk((times - at[piece]) / (at[piece + 1] - at[piece]))
        place = positions[piece] + (positions[piece + 1] - positions[piece]) * fraction[:, None]
        turned = Slerp(at, rotations)(np.clip(at[piece] + (at[piece + 1] - at[piece]) * fraction, at[0], at[-1]))
        return np.concatenate([place, turned.as_quat()], axis=1)

    def mesh(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        """Vertices in the hand's frame [V, 3], m, and faces [F, 3]."""
        if self.kind == "fist":
            reach = 1.2 * FIST_RADIUS
            return surface(sphere((0, 0, 0), FIST_RADIUS), (-reach,) * 3, (reach,) * 3, spacing)
        vertices, faces = surface(_grip(), (-0.12, -0.07, -0.02), (0.07, 0.07, 0.25), spacing)
        return Rotation.from_rotvec(self.turn).apply(vertices), faces


def minimum_jerk(fraction: np.ndarray) -> np.ndarray:
    """u^3 (10 - 15 u + 6 u^2), with u clipped to [0, 1]: velocity and acceleration are zero at both ends."""
    u = np.clip(fraction, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u * u))


def place(vertices: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Vertices [n, V, 3] of a mesh [V, 3] at poses [n, 7]."""
    turned = np.stack([Rotation.from_quat(pose[3:]).apply(vertices) for pose in poses])
    return np.asarray(turned + poses[:, None, :3])


def _grip() -> Sdf:
    """Palm, wrist, four fingers and a thumb that close at the origin, coming from above."""
    parts = [ellipsoid((-0.01, 0, 0.075), (0.03, 0.042, 0.03)), capsule((-0.02, 0, 0.1), (-0.07, 0, 0.2), 0.027)]
    for y in (-0.03, -0.01, 0.01, 0.03):
        parts.append(capsule((0.012, y, 0.08), (0.035, 0.8 * y, 0.045), 0.0095))
        parts.append(capsule((0.035, 0.8 * y, 0.045), (0.02, 0.6 * y, 0.006), 0.0085))
    parts.append(capsule((-0.03, 0, 0.07), (-0.035, 0, 0.04), 0.011))
    parts.append(capsule((-0.035, 0, 0.04), (-0.018, 0, 0.006), 0.0095))
    return smooth_union(parts, 0.004)


MEAN_SPEED = 0.2
"""m/s. Mean speed of a hand between key frames; minimum-jerk motion peaks at 1.875 times this speed."""
Offsets = Sequence[Sequence[float] | np.ndarray]


@dataclass(frozen=True)
class SyntheticScene:
    """A body, its number of frames, and its hands."""

    body: Callable[[float, float], SoftBody]
    """Mesh spacing and skin spacing of the size (see `CaptureSize`), m -> body, which scales them."""
    frames: int
    hands: Callable[[np.ndarray, float], tuple[Hand, ...]]
    """Settled nodes [N, 3], m, and duration, s -> hands."""
    marked: bool = False
    """True if the capture contains annotations of frame 0, as a careful user draws them: object and table have the same colors."""


def wander(start: np.ndarray, offsets: Offsets, duration: float) -> tuple[KeyFrame, ...]:
    """Key frames that visit start + offset in turn, repeatedly, at MEAN_SPEED, until `duration`, s, is over."""
    keys = [(0.0, tuple(start), (0.0, 0.0, 0.0))]
    now, here, k = 0.0, np.asarray(start, float), 0
    while now < duration:
        there = start + np.asarray(offsets[k % len(offsets)])
        now += max(float(np.linalg.norm(there - here)) / MEAN_SPEED, 0.2)
        keys.append((now, tuple(there), (0.0, 0.0, 0.0)))
        here, k = there, k + 1
    return tuple(keys)


def nearest(nodes: np.ndarray, wanted: Sequence[float]) -> np.ndarray:
    """The node nearest to `wanted`, in fractions of the bounding box (0 to 1 along x, y, z)."""
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    return np.asarray(nodes[np.argmin((((nodes - low) / np.maximum(high - low, 1e-9) - np.asarray(wanted)) ** 2).sum(axis=1))])


LIFT = ((0, 0, 0.16), (-0.05, 0.06, 0.18), (0.04, -0.06, 0.14), (0, 0.03, 0.2), (0.03, 0.02, 0.09), (0, 0, 0.03))
TOGETHER = ((0, 0, 0.14), (-0.015, 0.06, 0.17), (0.015, -0.06, 0.13), (0, 0.03, 0.18), (0.01, 0.02, 0.08), (0, 0, 0.03))
"""Offsets for two hands at the ends of an animal, which must not crush it."""
LOW_LIFT = ((0, 0, 0.1), (-0.03, 0.05, 0.11), (0.03, -0.04, 0.06), (0, 0, 0.12))


def lift(*places: Sequence[float], reach: float = 0.02, offsets: Offsets = LIFT, turn: Sequence[float] = (0, 0, 0)) -> Callable:
    """One grip at each of `places`, in fractions of the bounding box; every second grip mirrors the offsets along x."""

    def hands(nodes: np.ndarray, duration: float) -> tuple[Hand, ...]:
        grips = []
        for k, wanted in enumerate(places):
            point = nearest(nodes, wanted)
            # The hands of one object move to the same heights, but sideways in opposite directions.
            mirrored = [(x * (1 - 2 * (k % 2)), y, z) for x, y, z in offsets]
            grips.append(Hand(wander(point, mirrored, duration), reach=reach, turn=tuple(turn)))  # type: ignore[arg-type]
        return tuple(grips)

    return hands


def stretch(first: Sequence[float], second: Sequence[float], pull: float) -> Callable:
    """Two grips that lift the object and pull it repeatedly along the line between them, by `pull` m each."""

    def hands(nodes: np.ndarray, duration: float) -> tuple[Hand, ...]:
        points = [nearest(nodes, wanted) for wanted in (first, second)]
        apart = (points[0] - points[1]) * [1, 1, 0]
        apart /= np.linalg.norm(apart)
        grips = []
        for point, side in zip(points, (1.0, -1.0), strict=True):
            far, up = side * pull * apart, np.array([0.0, 0.0, 0.1])
            offsets = [up, up + far, up * 1.3 + 0.2 * far, up + far * 0.8, up * 0.5]
            grips.append(Hand(wander(point, offsets, duration), reach=0.022))
        return tuple(grips)

    return hands


def push(place: Sequence[float], direction: Sequence[float], distance: float) -> Callable:
    """A fist next to the object that pushes it along the table by `distance` m, moves back, and pushes farther."""

    def hands(nodes: np.ndarray, duration: float) -> tuple[Hand, ...]:
        point, along = nearest(nodes, place), np.asarray(direction, float)
        along /= np.linalg.norm(along)
        start = point - (FIST_RADIUS + 0.006) * along
        start[2] = max(start[2], FIST_RADIUS + 0.003)
        across = np.array([-along[1], along[0], 0.0])
        offsets = [along * distance, along * distance * 0.4, along * distance * 1.3 + across * 0.05, along * distance]
        return (Hand(wander(start, offsets, duration), kind="fist"),)

    return hands


def _cloth(name: str) -> Callable[[float, float], SoftBody]:
    return lambda spacing, skin: bodies.cloth(name, 0.72 * spacing, 0.75 * skin)


def _rope(name: str) -> Callable[[float, float], SoftBody]:
    return lambda spacing, skin: bodies.rope(name, 0.57 * spacing, 0.5 * skin)


def _package(spacing: float, skin: float) -> SoftBody:
    return bodies.package(0.86 * spacing, skin)


GRIPPED_CORNER, OTHER_CORNER, GRIPPED_MIDDLE = (1.0, 0.0, 0.5), (1.0, 1.0, 0.5), (0.5, 0.5, 0.5)
SCENES = {
    "double_lift_cloth_1": SyntheticScene(_cloth("napkin"), 116, lift(GRIPPED_CORNER, OTHER_CORNER)),
    "double_lift_cloth_3": SyntheticScene(_cloth("scarf"), 118, lift(GRIPPED_CORNER, OTHER_CORNER)),
    "single_clift_cloth_1": SyntheticScene(_cloth("napkin"), 80, lift(GRIPPED_MIDDLE)),
    "single_clift_cloth_3": SyntheticScene(_cloth("scarf"), 97, lift(GRIPPED_MIDDLE)),
    "single_lift_cloth": SyntheticScene(_cloth("towel"), 173, lift(GRIPPED_CORNER)),
    "single_lift_cloth_1": SyntheticScene(_cloth("napkin"), 110, lift(OTHER_CORNER)),
    "single_lift_cloth_3": SyntheticScene(_cloth("scarf"), 156, lift(GRIPPED_CORNER)),
    "single_lift_cloth_4": SyntheticScene(_cloth("sheet"), 172, lift(GRIPPED_CORNER)),
    "weird_package": SyntheticScene(_package, 39, lift((1.0, 0.5, 1.0), reach=0.028, offsets=LOW_LIFT)),
    "double_lift_sloth": SyntheticScene(bodies.sloth, 62, lift((0.95, 0.0, 0.1), (0.95, 1.0, 0.1), reach=0.025)),
    "double_stretch_sloth": SyntheticScene(bodies.sloth, 192, stretch((0.9, 1.0, 0.2), (0.0, 0.1, 0.2), 0.05)),
    "single_lift_sloth": SyntheticScene(bodies.sloth, 85, lift((0.95, 1.0, 0.1), reach=0.025)),
    "single_push_sloth": SyntheticScene(bodies.sloth, 68, push((0.4, 0.1, 0.5), (0, 1, 0), 0.1)),
    "double_lift_zebra": SyntheticScene(bodies.zebra, 58, lift((0.85, 0.5, 1.0), (0.15, 0.5, 0.75), reach=0.025, offsets=TOGETHER)),
    "double_stretch_zebra": SyntheticScene(bodies.zebra, 198, stretch((0.95, 0.5, 0.8), (0.1, 0.5, 0.6), 0.04)),
    "single_lift_zebra": SyntheticScene(bodies.zebra, 66, lift((0.4, 0.5, 1.0), reach=0.028)),
    "single_lift_dinosor": SyntheticScene(bodies.dinosaur, 86, lift((0.0, 0.5, 0.1), reach=0.03, offsets=LOW_LIFT)),
    "rope_double_hand": SyntheticScene(_rope("twine"), 264, lift((0.02, 0.5, 0.5), (0.98, 0.5, 0.5), reach=0.016), marked=True),
    "single_lift_rope": SyntheticScene(_rope("cord"), 50, lift((0.03, 0.5, 0.5), reach=0.016)),
    "single_push_rope": SyntheticScene(_rope("twine"), 58, push((0.5, 0.0, 0.5), (0, 1, 0), 0.1)),
    "single_push_rope_1": SyntheticScene(_rope("twine"), 92, push((0.25, 0.0, 0.5), (0.3, 1, 0), 0.12)),
    "single_push_rope_4": SyntheticScene(_rope("cord"), 83, push((0.7, 0.0, 0.5), (-0.2, 1, 0), 0.1)),
}
