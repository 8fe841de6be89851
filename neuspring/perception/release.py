"""When hands let go: which controllers hold the object in which frames."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from neuspring.config.perception import Lift
from neuspring.perception.controllers import LEAST_FOR_POSE, hands_of

ALWAYS = np.zeros((0, 0), dtype=bool)
"""All controllers hold in all frames."""


def holding(
    controllers: np.ndarray,
    hands: tuple[np.ndarray, np.ndarray],
    body: tuple[np.ndarray, np.ndarray],
    in_view: np.ndarray,
    train_end: int,
    settings: Lift,
) -> np.ndarray:
    """Whether each of `controllers` [T, C, 3] holds in each frame [T, C]; `ALWAYS` if all do, or `settings.release` is null.

    `hands` and `body` are tracked points [T, n, 3], m, and whether they are seen [T, n]; `in_view` [T]: whether any mask shows a
    hand. Points of the body after the training frames are not read: from `train_end` on a hand lets go only by leaving the view. A
    hand lets go after the last frame in which it was within `release` of the body: as soon as it is seen farther away, or
    when no hand was in view for `release_after` frames. A hand that comes near again has not let go before: springs of a new grip
    would need rest lengths of that moment.
    """
    if settings.release is None:
        return ALWAYS
    (points, seen), (own, shown) = hands, body
    trees = [cKDTree(own[frame, shown[frame]]) if shown[frame].any() else None for frame in range(train_end)]
    groups = hands_of(points[0])
    label = np.zeros(points.shape[1], dtype=int)
    for number, group in enumerate(groups):
        label[group] = number
    hand_of = label[cKDTree(points[0]).query(controllers[0])[1]]
    result = np.ones(controllers.shape[:2], dtype=bool)
    for number, group in enumerate(groups):
        members = np.flatnonzero(hand_of == number)
        if not len(members):
            continue
        followed = seen[:, group].sum(axis=1) >= LEAST_FOR_POSE
        apart = np.full(len(own), np.nan)
        for frame, tree in enumerate(trees):
            if tree is not None:
                apart[frame] = tree.query(controllers[frame, members])[0].min()
        near = np.flatnonzero(followed & (apart <= settings.release))
        if len(near):
            result[_gone(near[-1], followed & (apart > settings.release), in_view, settings.release_after) :, members] = False
    return ALWAYS if result.all() else result


def _gone(last: int, away: np.ndarray, in_view: np.ndarray, patience: int) -> int:
    """The first frame after `last` in which a hand is `away` [T], or out of view for `patience` frames; T if there is none."""
    hidden = 0
    for frame in range(last + 1, len(away)):
        hidden = 0 if in_view[frame] else hidden + 1
        if away[frame] or hidden >= patience:
            return frame
    return len(away)
