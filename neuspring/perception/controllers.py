"""Which points of the hands move the object: seen throughout and spread over the hands, or where hands grip, moving rigidly."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from neuspring.config.perception import Lift
from neuspring.core.errors import InputError
from neuspring.core.geometry import farthest

HAND_GAP = 0.04
"""m: a point nearer than this to a point of a hand belongs to that hand."""
LEAST_FOR_POSE = 3
"""Points that a rigid motion needs."""


def choose_controllers(
    points: np.ndarray, visible: np.ndarray, valid: np.ndarray, cloud: np.ndarray, settings: Lift, where: str
) -> tuple[np.ndarray, dict[str, float]]:
    """Controllers [T, C, 3], m, and facts about them, of hand tracks [T, n, 3] and the object's points of frame 0 `cloud` [P, 3].

    `controller_gaps: none`, as released: points visible in all frames whose motion never disagrees. `rigid`: points seen in at
    least `controller_share` of the frames; where one is not seen it goes where the rigid motion of its hand takes it. At most
    `controllers` points, each the farthest from those before. `grip: patch` takes them from `patches` instead. Raises InputError if
    fewer than `least_controllers` remain.
    """
    eligible, filled = visible.all(axis=0) & valid[:-1].all(axis=0), 0.0
    trusted = visible & np.concatenate([visible[:1], valid[:-1]])
    facts = {}
    if settings.controller_gaps == "rigid":
        eligible = trusted.mean(axis=0) >= settings.controller_share
        filled = float(1.0 - trusted[:, eligible].mean()) if eligible.any() else 0.0
    count = int(eligible.sum())
    if settings.grip == "patch" and points.shape[1]:
        candidates, misfit = patches(points, trusted, cloud, settings.grip_reach)
        facts = {"patch_points": float(candidates.shape[1]), "patch_misfit_mm": 1e3 * misfit}
        filled = 0.0
    elif settings.controller_gaps == "rigid":
        candidates = fill_rigidly(points[:, eligible], trusted[:, eligible])
    else:
        candidates = points[:, eligible]
    if candidates.shape[1] < settings.least_controllers:
        if settings.grip == "patch":
            rule = f"at least {settings.least_controllers} points of the hands must lie near the object in frame 0"
            remedy = "perception.lift has grip_reach and least_controllers."
        else:
            rule = f"at least {settings.least_controllers} points of the hands must be followed through the video"
            remedy = "Look at the overlay of tracks; perception.lift has controller_gaps, controller_share and least_controllers."
        raise InputError(where, rule, f"{candidates.shape[1]} of {visible.shape[1]}", remedy)
    controllers = candidates[:, farthest(candidates[0], settings.controllers)]
    facts |= {"controllers": float(controllers.shape[1]), "hand_tracks_kept": float(count), "controllers_filled": filled}
    return controllers, facts


def patches(points: np.ndarray, trusted: np.ndarray, cloud: np.ndarray, reach: float) -> tuple[np.ndarray, float]:
    """The points of each hand that are near the object in frame 0, moving rigidly with their hand: [T, n', 3], m; and how far
    trusted points are from that motion, m (root mean square).

    A point at distance d from `cloud` is near if d <= reach + the least such distance of its hand: a hand that has yet to come
    grips with what is foremost. A hand's motion is that of its trusted points, as in `fill_rigidly`; all others follow it too, so
    the fingertips that are hidden later still grip.
    """
    rigid = fill_rigidly(points, np.zeros_like(trusted), trusted)
    distance = cKDTree(cloud).query(points[0])[0]
    near = [hand[distance[hand] <= distance[hand].min() + reach] for hand in hands_of(points[0])]
    misfit = float(np.sqrt(np.mean(np.sum((rigid - points)[trusted] ** 2, axis=1))))
    return rigid[:, np.concatenate(near)], misfit


def fill_rigidly(points: np.ndarray, kept: np.ndarray, trusted: np.ndarray | None = None) -> np.ndarray:
    """Points [T, n, 3] with the entries that are not `kept` [T, n] replaced by the rigid motion of their hand from frame 0.

    The motion of a frame is the least-squares one of the hand's points that are `trusted` [T, n] (those that are kept); with fewer
    than three it is that of the last frame that had them.
    """
    trusted = kept if trusted is None else trusted
    result = points.copy()
    for hand in hands_of(points[0]):
        start = points[0, hand]
        rotation, shift = Rotation.identity(), np.zeros(3)
        for frame in range(1, len(points)):
            anchors = trusted[frame, hand]
            if anchors.sum() >= LEAST_FOR_POSE:
                rotation, shift = rigid_motion(start[anchors], points[frame, hand][anchors])
            missing = hand[~kept[frame, hand]]
            if len(missing):
                result[frame, missing] = rotation.apply(points[0, missing]) + shift
    return result


def rigid_motion(source: np.ndarray, target: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """Rotation R and shift t of least squares with target = R source + t (Kabsch)."""
    center, goal = source.mean(axis=0), target.mean(axis=0)
    rotation, _ = Rotation.align_vectors(target - goal, source - center)
    return rotation, goal - rotation.apply(center)


def hands_of(points: np.ndarray) -> list[np.ndarray]:
    """Indices of the points [n, 3] of each hand. Hands lie HAND_GAP or more apart; a piece too small to have a pose belongs to the
    nearest hand."""
    pairs = cKDTree(points).query_pairs(HAND_GAP, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    count, labels = connected_components(graph, directed=False)
    sizes = np.bincount(labels, minlength=count)
    if sizes.max(initial=0) >= LEAST_FOR_POSE:
        large = np.flatnonzero(sizes[labels] >= LEAST_FOR_POSE)
        labels = labels[large][cKDTree(points[large]).query(points)[1]]
    return [np.flatnonzero(labels == k) for k in np.unique(labels)]
