"""When hands let go, and take hold again: which controllers hold the object in which frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from neuspring.config.perception import Lift
from neuspring.perception.controllers import LEAST_FOR_POSE, hands_of

ALWAYS = np.zeros((0, 0), dtype=bool)
"""All controllers hold in all frames."""
GUIDES = 5
"""Followed points of the object that say which part of it is near a hand."""


@dataclass(frozen=True, eq=False)
class Body:
    """What is known of the object, and what masks show of the hands, in the training frames."""

    clouds: Sequence[np.ndarray]
    """What cameras see of the object in each frame [P_t, 3], m."""
    hands: Sequence[np.ndarray]
    """What cameras see of all hands in each frame [H_t, 3], m."""
    points: np.ndarray
    """Followed points [T, n, 3], m."""
    visible: np.ndarray
    """[T, n] bool."""

    def nearest(self, frame: int, points: np.ndarray) -> float:
        """Least distance of `points` [n, 3] to what is seen of it in a frame, m; NaN where nothing is seen."""
        cloud = self.clouds[frame]
        return float(cKDTree(cloud).query(points)[0].min()) if len(cloud) else np.nan

    def part(self, frame: int, points: np.ndarray) -> np.ndarray:
        """Places in frame 0 [GUIDES or fewer, 3], m, of the part of it that is nearest to `points` [n, 3] in a frame."""
        seen = np.flatnonzero(self.visible[frame] & self.visible[0])
        if not len(seen):
            return np.zeros((0, 3))
        distance = cKDTree(points).query(self.points[frame, seen])[0]
        return np.asarray(self.points[0, seen[np.argsort(distance, kind="stable")[:GUIDES]]])


@dataclass(frozen=True, eq=False)
class Holding:
    """Which controllers hold when."""

    valid: np.ndarray
    """[T, C] bool; `ALWAYS` if all hold in all frames."""
    elsewhere: int | None = None
    """The first frame in which a hand came back to another part of the object, which no spring joins to it."""


def holding(
    controllers: np.ndarray, hands: tuple[np.ndarray, np.ndarray], body: Body, in_view: np.ndarray, settings: Lift
) -> Holding:
    """When each of `controllers` [T, C, 3] holds; always, if `settings.release` is null.

    `hands` are tracked points [T, n, 3], m, and whether they are seen [T, n]; `in_view` [T]: whether any mask shows a hand. The
    body is known in the training frames: later a hand lets go only by leaving the view, and takes no hold.

    A hand lets go after a frame in which it was within `release` of the body: as soon as it is seen farther away, or when no hand
    was in view for `release_after` frames. If it is near again fewer than `release_after` frames later it has not let go. Later it
    takes hold again, if the part of the body that it is near lay within `release` of its controllers in frame 0, where springs are
    made; else it holds nothing any more.
    """
    if settings.release is None:
        return Holding(ALWAYS)
    points, seen = hands
    groups = hands_of(points[0])
    label = np.zeros(points.shape[1], dtype=int)
    for number, group in enumerate(groups):
        label[group] = number
    hand_of = label[cKDTree(points[0]).query(controllers[0])[1]]
    valid, elsewhere = np.ones(controllers.shape[:2], dtype=bool), list[int]()
    for number, group in enumerate(groups):
        members = np.flatnonzero(hand_of == number)
        if not len(members):
            continue
        followed = seen[:, group].sum(axis=1) >= LEAST_FOR_POSE
        apart = np.full(len(points), np.nan)
        for frame in np.flatnonzero(followed[: len(body.clouds)]).tolist():
            # Followed points lie anywhere on a hand, and of few of them the pose is rough: what masks show of it counts too.
            pixels = body.hands[frame]
            here = np.flatnonzero(seen[frame])
            own = pixels[label[here[cKDTree(points[frame, here]).query(pixels)[1]]] == number] if len(pixels) else pixels
            apart[frame] = body.nearest(frame, np.concatenate([controllers[frame, members], own]))
        for begin, end in _gaps(apart <= settings.release, apart > settings.release, in_view, settings.release_after):
            valid[begin:end, members] = False
            if end == len(points):
                break
            back = body.part(end, controllers[end, members])
            there = cKDTree(controllers[0, members]).query(back)[0] if len(back) else np.array([np.inf])
            if np.median(there) > settings.release:
                valid[end:, members] = False
                elsewhere.append(end)
                break
    return Holding(ALWAYS if valid.all() else valid, min(elsewhere, default=None))


def _gaps(near: np.ndarray, away: np.ndarray, in_view: np.ndarray, patience: int) -> list[tuple[int, int]]:
    """Frames [begin, end) in which a hand that was `near` [T] holds no more: until it is near again, or T."""
    gaps: list[tuple[int, int]] = []
    frames = np.flatnonzero(near).tolist()
    if not frames:
        return gaps
    for last, again in zip(frames, [*frames[1:], len(near)], strict=True):
        begin = _gone(last, again, away, in_view, patience)
        if begin < again and (again == len(near) or again - begin >= patience):
            gaps.append((begin, again))
    return gaps


def _gone(last: int, stop: int, away: np.ndarray, in_view: np.ndarray, patience: int) -> int:
    """The first frame after `last` in which a hand is `away` [T], or out of view for `patience` frames; else `stop`."""
    hidden = 0
    for frame in range(last + 1, stop):
        hidden = 0 if in_view[frame] else hidden + 1
        if away[frame] or hidden >= patience:
            return frame
    return stop
