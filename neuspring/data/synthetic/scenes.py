"""The 22 scenes: which body, how many frames, what the hands do. Names, categories and frame counts are those of the PhysTwin data;
bodies, materials and motions are ours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from neuspring.data.synthetic import goods, plush
from neuspring.data.synthetic.body import Body
from neuspring.data.synthetic.hands import FIST_RADIUS, Hand, KeyFrame

MEAN_SPEED = 0.2
"""m/s of a hand on its way; the peak of minimum-jerk motion is 1.875 times as fast."""
Offsets = Sequence[Sequence[float] | np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A body, how long it is filmed, and its hands for a settled shape."""

    body: Callable[[float, float], Body]
    """Mesh spacing and skin spacing, m, in parts of the size's own (see `Size`)."""
    frames: int
    hands: Callable[[np.ndarray, float], tuple[Hand, ...]]
    """Settled nodes [N, 3], m, and duration, s -> hands."""


def wander(start: np.ndarray, offsets: Offsets, duration: float) -> tuple[KeyFrame, ...]:
    """Key frames that visit start + offset in turn, again and again, at MEAN_SPEED, until `duration` is over."""
    keys: list[KeyFrame] = [(0.0, tuple(start), (0.0, 0.0, 0.0))]
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


LIFT: Offsets = ((0, 0, 0.16), (-0.05, 0.06, 0.18), (0.04, -0.06, 0.14), (0, 0.03, 0.2), (0.03, 0.02, 0.09), (0, 0, 0.03))
TOGETHER: Offsets = ((0, 0, 0.14), (-0.015, 0.06, 0.17), (0.015, -0.06, 0.13), (0, 0.03, 0.18), (0.01, 0.02, 0.08), (0, 0, 0.03))
"""Two hands at the ends of one animal must not crush it."""
LOW_LIFT: Offsets = ((0, 0, 0.1), (-0.03, 0.05, 0.11), (0.03, -0.04, 0.06), (0, 0, 0.12))


def lift(*places: Sequence[float], reach: float = 0.02, offsets: Offsets = LIFT, turn: Sequence[float] = (0, 0, 0)) -> Callable:
    """A grip at each place (parts of the bounding box); several move together, out of step by one offset."""

    def hands(nodes: np.ndarray, duration: float) -> tuple[Hand, ...]:
        grips = []
        for k, wanted in enumerate(places):
            point = nearest(nodes, wanted)
            # The hands of one object take the same heights, not the same detours.
            own = [(x * (1 - 2 * (k % 2)), y, z) for x, y, z in offsets]
            grips.append(Hand(wander(point, own, duration), reach=reach, turn=tuple(turn)))  # type: ignore[arg-type]
        return tuple(grips)

    return hands


def stretch(first: Sequence[float], second: Sequence[float], pull: float, reach: float = 0.022) -> Callable:
    """Two grips that lift the object and pull it apart along the line between them, again and again."""

    def hands(nodes: np.ndarray, duration: float) -> tuple[Hand, ...]:
        points = [nearest(nodes, wanted) for wanted in (first, second)]
        apart = (points[0] - points[1]) * [1, 1, 0]
        apart /= np.linalg.norm(apart)
        grips = []
        for point, side in zip(points, (1.0, -1.0), strict=True):
            far, up = side * pull * apart, np.array([0.0, 0.0, 0.1])
            offsets = [up, up + far, up * 1.3 + 0.2 * far, up + far * 0.8, up * 0.5]
            grips.append(Hand(wander(point, offsets, duration), reach=reach))
        return tuple(grips)

    return hands


def push(place: Sequence[float], direction: Sequence[float], distance: float) -> Callable:
    """A fist beside the object that pushes it along the table, there, half back, and on."""

    def hands(nodes: np.ndarray, duration: float) -> tuple[Hand, ...]:
        point, along = nearest(nodes, place), np.asarray(direction, float)
        along /= np.linalg.norm(along)
        start = point - (FIST_RADIUS + 0.006) * along
        start[2] = max(start[2], FIST_RADIUS + 0.003)
        across = np.array([-along[1], along[0], 0.0])
        offsets = [along * distance, along * distance * 0.4, along * distance * 1.3 + across * 0.05, along * distance]
        return (Hand(wander(start, offsets, duration), kind="fist"),)

    return hands


def _cloth(name: str) -> Callable[[float, float], Body]:
    return lambda spacing, skin: goods.cloth(name, 0.72 * spacing, 0.75 * skin)


def _rope(name: str) -> Callable[[float, float], Body]:
    return lambda spacing, skin: goods.rope(name, 0.57 * spacing, 0.5 * skin)


def _package(spacing: float, skin: float) -> Body:
    return goods.package(0.86 * spacing, skin)


CORNER, OTHER_CORNER, MIDDLE = (1.0, 0.0, 0.5), (1.0, 1.0, 0.5), (0.5, 0.5, 0.5)
SCENES: dict[str, Scene] = {
    "double_lift_cloth_1": Scene(body=_cloth("napkin"), frames=116, hands=lift(CORNER, OTHER_CORNER)),
    "double_lift_cloth_3": Scene(body=_cloth("scarf"), frames=118, hands=lift(CORNER, OTHER_CORNER)),
    "single_clift_cloth_1": Scene(body=_cloth("napkin"), frames=80, hands=lift(MIDDLE)),
    "single_clift_cloth_3": Scene(body=_cloth("scarf"), frames=97, hands=lift(MIDDLE)),
    "single_lift_cloth": Scene(body=_cloth("towel"), frames=173, hands=lift(CORNER)),
    "single_lift_cloth_1": Scene(body=_cloth("napkin"), frames=110, hands=lift(OTHER_CORNER)),
    "single_lift_cloth_3": Scene(body=_cloth("scarf"), frames=156, hands=lift(CORNER)),
    "single_lift_cloth_4": Scene(body=_cloth("sheet"), frames=172, hands=lift(CORNER)),
    "weird_package": Scene(body=_package, frames=39, hands=lift((1.0, 0.5, 1.0), reach=0.028, offsets=LOW_LIFT)),
    "double_lift_sloth": Scene(body=plush.sloth, frames=62, hands=lift((0.95, 0.0, 0.1), (0.95, 1.0, 0.1), reach=0.025)),
    "double_stretch_sloth": Scene(body=plush.sloth, frames=192, hands=stretch((0.9, 1.0, 0.2), (0.0, 0.1, 0.2), 0.05)),
    "single_lift_sloth": Scene(body=plush.sloth, frames=85, hands=lift((0.95, 1.0, 0.1), reach=0.025)),
    "single_push_sloth": Scene(body=plush.sloth, frames=68, hands=push((0.4, 0.1, 0.5), (0, 1, 0), 0.1)),
    "double_lift_zebra": Scene(
        body=plush.zebra, frames=58, hands=lift((0.85, 0.5, 1.0), (0.15, 0.5, 0.75), reach=0.025, offsets=TOGETHER)
    ),
    "double_stretch_zebra": Scene(body=plush.zebra, frames=198, hands=stretch((0.95, 0.5, 0.8), (0.1, 0.5, 0.6), 0.04)),
    "single_lift_zebra": Scene(body=plush.zebra, frames=66, hands=lift((0.4, 0.5, 1.0), reach=0.028)),
    "single_lift_dinosor": Scene(body=plush.dinosaur, frames=86, hands=lift((0.0, 0.5, 0.1), reach=0.03, offsets=LOW_LIFT)),
    "rope_double_hand": Scene(body=_rope("twine"), frames=264, hands=lift((0.02, 0.5, 0.5), (0.98, 0.5, 0.5), reach=0.016)),
    "single_lift_rope": Scene(body=_rope("cord"), frames=50, hands=lift((0.03, 0.5, 0.5), reach=0.016)),
    "single_push_rope": Scene(body=_rope("twine"), frames=58, hands=push((0.5, 0.0, 0.5), (0, 1, 0), 0.1)),
    "single_push_rope_1": Scene(body=_rope("twine"), frames=92, hands=push((0.25, 0.0, 0.5), (0.3, 1, 0), 0.12)),
    "single_push_rope_4": Scene(body=_rope("cord"), frames=83, hands=push((0.7, 0.0, 0.5), (-0.2, 1, 0), 0.1)),
}
