"""Controllers: the points of the hands that move the object, and their grasps.

Controllers are tracked points that are spread over the hands, or points near the object that move rigidly with their hand. Hands
can release the object and grasp it again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from neuspring.config.perception import Lift
from neuspring.core.errors import InputError
from neuspring.core.geometry import farthest

MOST_CONTROLLERS = 30
"""Largest number of controllers."""
GRASP_REACH = 0.03
"""m: with `grip: patch`, controllers are at most this much farther from the object than the hand's nearest point in frame 0."""
HAND_GAP = 0.04
"""m: points closer than this belong to the same hand."""
LEAST_FOR_POSE = 3
"""Smallest number of points that determine a rigid motion."""
ALWAYS = np.zeros((0, 0), dtype=bool)
"""Empty array: all controllers hold the object in all frames."""
RELEASE_AFTER = 10
"""Frames without a hand in view after which hands count as released, and shortest release, frames."""
HAND_CELL = 0.01
"""m: side of the cells in which hand pixels are merged before they are grouped into pieces."""
LEAST_OF_HAND = 20
"""Smallest number of hand pixels near the object that is not mask noise."""
GRIP_GUIDES = 5
"""Tracked points of the object that locate the part of it near a hand."""


def choose_controllers(
    points: np.ndarray, visible: np.ndarray, valid: np.ndarray, cloud: np.ndarray, settings: Lift, where: str
) -> tuple[np.ndarray, dict[str, float]]:
    """Choose controllers [T, C, 3], m, from hand tracks [T, n, 3] and the object's points in frame 0 `cloud` [P, 3]; with facts.

    - `controller_gaps: none`, as released: points that are visible in all frames and whose motion never disagrees.
    - `controller_gaps: rigid`: points seen in at least `controller_share` of the frames; gaps follow the rigid motion of the
      hand.
    - `grip: patch`: points of `patches`.

    At most MOST_CONTROLLERS points are kept, by farthest point sampling. Raises InputError if fewer than `least_controllers`
    remain.
    """
    eligible, filled = visible.all(axis=0) & valid[:-1].all(axis=0), 0.0
    trusted = visible & np.concatenate([visible[:1], valid[:-1]])
    facts = {}
    if settings.controller_gaps == "rigid":
        eligible = trusted.mean(axis=0) >= settings.controller_share
        filled = float(1.0 - trusted[:, eligible].mean()) if eligible.any() else 0.0
    count = int(eligible.sum())
    if settings.grip == "patch" and points.shape[1]:
        candidates, misfit = patches(points, trusted, cloud)
        facts = {"patch_points": float(candidates.shape[1]), "patch_misfit_mm": 1e3 * misfit}
        filled = 0.0
    elif settings.controller_gaps == "rigid":
        candidates = fill_rigidly(points[:, eligible], trusted[:, eligible])
    else:
        candidates = points[:, eligible]
    if candidates.shape[1] < settings.least_controllers:
        if settings.grip == "patch":
            rule = f"at least {settings.least_controllers} points of the hands must be near the object in frame 0"
            remedy = "Check the masks of the hands, or lower perception.lift.least_controllers."
        else:
            rule = f"at least {settings.least_controllers} points of the hands must be tracked through the video"
            remedy = "Check tracks.png, or change controller_gaps, controller_share or least_controllers of perception.lift."
        raise InputError(where, rule, f"{candidates.shape[1]} of {visible.shape[1]}", remedy)
    controllers = candidates[:, farthest(candidates[0], MOST_CONTROLLERS)]
    facts |= {"controllers": float(controllers.shape[1]), "hand_tracks_kept": float(count), "controllers_filled": filled}
    return controllers, facts


def patches(points: np.ndarray, trusted: np.ndarray, cloud: np.ndarray) -> tuple[np.ndarray, float]:
    """Points of the hands near the object in frame 0, moved rigidly with their hand [T, n', 3], m; and the misfit, m.

    A point at distance d from `cloud` is near if d <= GRASP_REACH + (smallest distance of its hand), so that a hand that arrives
    later grasps with its foremost part. The trusted points of a hand determine its motion, as in `fill_rigidly`, and all its
    points follow it: fingertips that are hidden later still grasp. The misfit is the RMS distance of trusted points from that
    motion.
    """
    rigid = fill_rigidly(points, np.zeros_like(trusted), trusted)
    distance = cKDTree(cloud).query(points[0])[0]
    near = [hand[distance[hand] <= distance[hand].min() + GRASP_REACH] for hand in hands_of(points[0])]
    misfit = float(np.sqrt(np.mean(np.sum((rigid - points)[trusted] ** 2, axis=1))))
    return rigid[:, np.concatenate(near)], misfit


def fill_rigidly(points: np.ndarray, kept: np.ndarray, trusted: np.ndarray | None = None) -> np.ndarray:
    """Points [T, n, 3]; entries that are not `kept` [T, n] follow the rigid motion of their hand from frame 0.

    The motion in a frame is the least-squares fit to the hand's `trusted` points [T, n], by default the kept ones. With fewer
    than three trusted points, the motion of the last frame is used.
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
            if len(missing := hand[~kept[frame, hand]]):
                result[frame, missing] = rotation.apply(points[0, missing]) + shift
    return result


def rigid_motion(source: np.ndarray, target: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """Least-squares rotation R and translation t with target = R source + t (Kabsch)."""
    center, goal = source.mean(axis=0), target.mean(axis=0)
    rotation, _ = Rotation.align_vectors(target - goal, source - center)
    return rotation, goal - rotation.apply(center)


def hands_of(points: np.ndarray) -> list[np.ndarray]:
    """Indices of the points [n, 3] of each hand: clusters at least HAND_GAP apart.

    A cluster with too few points for a pose belongs to the nearest hand.
    """
    pairs = cKDTree(points).query_pairs(HAND_GAP, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    count, labels = connected_components(graph, directed=False)
    sizes = np.bincount(labels, minlength=count)
    if sizes.max(initial=0) >= LEAST_FOR_POSE:
        large = np.flatnonzero(sizes[labels] >= LEAST_FOR_POSE)
        labels = labels[large][cKDTree(points[large]).query(points)[1]]
    return [np.flatnonzero(labels == k) for k in np.unique(labels)]


@dataclass(frozen=True, eq=False)
class SeenBody:
    """Observed object, and hands in the masks, in the training frames."""

    clouds: Sequence[np.ndarray]
    """Visible points of the object in each frame [P_t, 3], m."""
    hands: Sequence[np.ndarray]
    """Visible points of all hands in each frame [H_t, 3], m."""
    points: np.ndarray
    """Tracked points of the object [T, n, 3], m."""
    visible: np.ndarray
    """[T, n] bool."""


@dataclass(frozen=True, eq=False)
class Grips:
    """Grasps of the controllers, and hands without controllers."""

    holds: np.ndarray
    """[T, C] bool: the controller holds the object; `ALWAYS` if all do in all frames."""
    elsewhere: int | None
    """First frame in which a hand grasps another part of the object, to which no spring connects it."""
    strays: list[int]
    """Frames in which a hand without controllers is within `release` of the object."""


def holding(
    controllers: np.ndarray, hands: tuple[np.ndarray, np.ndarray], body: SeenBody, in_view: np.ndarray, release: float
) -> Grips:
    """Find the frames in which each of `controllers` [T, C, 3], m, holds the object, and hands without controllers.

    Args: `hands`: tracked points [T, n, 3], m, and their visibility [T, n]; `in_view` [T]: some mask shows a hand; `release`, m.

    - A hand releases the object when it is seen farther than `release` from it, or when no hand is in view for RELEASE_AFTER
      frames.
    - A hand that is near again within RELEASE_AFTER frames did not release the object.
    - A later grasp counts only if that part of the object was within `release` of the hand's controllers in frame 0, because
      springs are made in frame 0. After a grasp of another part, the hand holds nothing.
    - The object is observed only in training frames. In future frames, a hand releases only by leaving the view, and never
      grasps.
    """
    points, seen = hands
    label = np.zeros(points.shape[1], dtype=int)
    for number, group in enumerate(groups := hands_of(points[0])):
        label[group] = number
    hand_of = label[cKDTree(points[0]).query(controllers[0])[1]]
    followed = np.stack([seen[:, group].sum(axis=1) >= LEAST_FOR_POSE for group in groups])
    apart, strays = np.full(followed.shape, np.nan), list[int]()
    for frame, (cloud, pixels) in enumerate(zip(body.clouds, body.hands, strict=True)):
        if not len(cloud):
            continue
        # Tracked points can be far from the fingers, and few give a rough pose: pixels of the mask count too.
        here, posed = np.flatnonzero(seen[frame] & np.isin(label, hand_of)), followed[hand_of, frame]
        known = np.concatenate([points[frame, here], controllers[frame, posed]])
        owner = _owners(pixels, known, np.concatenate([label[here], hand_of[posed]]))
        distance = cKDTree(cloud).query(pixels)[0]
        if (distance[owner < 0] <= release).sum() >= LEAST_OF_HAND:
            strays.append(frame)
        for number in np.unique(hand_of[posed]):
            own = cKDTree(cloud).query(controllers[frame, hand_of == number])[0]
            apart[number, frame] = np.concatenate([own, distance[owner == number]]).min()
    valid, elsewhere = np.ones(controllers.shape[:2], dtype=bool), list[int]()
    for number in np.unique(hand_of):
        members = np.flatnonzero(hand_of == number)
        for begin, end in _gaps(apart[number] <= release, apart[number] > release, in_view):
            valid[begin:end, members] = False
            if end == len(points):
                break
            # The part of the object that is now near the hand, at its position in frame 0.
            known = np.flatnonzero(body.visible[end] & body.visible[0])
            nearest = np.argsort(cKDTree(controllers[end, members]).query(body.points[end, known])[0], kind="stable")[:GRIP_GUIDES]
            there = cKDTree(controllers[0, members]).query(body.points[0, known[nearest]])[0]
            if not len(known) or np.median(there) > release:
                valid[end:, members] = False
                elsewhere.append(end)
                break
    return Grips(ALWAYS if valid.all() else valid, min(elsewhere, default=None), strays)


def _owners(pixels: np.ndarray, known: np.ndarray, hand: np.ndarray) -> np.ndarray:
    """Hand index [P] of each hand pixel [P, 3], m, from `known` points [n, 3] of hand `hand` [n]; -1: another hand.

    In a connected piece with known points, a pixel belongs to the hand of the nearest one. A piece without known points is
    another hand, which came later or lost its tracks.
    """
    owner = np.full(len(pixels), -1)
    if not len(pixels) or not len(known):
        return owner
    cells, cell_of = np.unique(np.floor(pixels / HAND_CELL).astype(int), axis=0, return_inverse=True)
    for piece in hands_of(HAND_CELL * cells):
        own = np.isin(cell_of.ravel(), piece)
        if (on_it := cKDTree(pixels[own]).query(known)[0] <= HAND_GAP).any():
            owner[own] = hand[on_it][cKDTree(known[on_it]).query(pixels[own])[1]]
    return owner


def _gaps(near: np.ndarray, away: np.ndarray, in_view: np.ndarray) -> list[tuple[int, int]]:
    """Frame ranges [begin, end) in which a hand that was `near` [T] does not hold: until it is near again, or until T.

    A range begins when the hand is `away` [T], or after RELEASE_AFTER frames out of view.
    """
    gaps: list[tuple[int, int]] = []
    frames = np.flatnonzero(near).tolist()
    for last, again in pairwise([*frames, len(near)]):
        hidden = 0
        for frame in range(last + 1, again):
            hidden = 0 if in_view[frame] else hidden + 1
            if away[frame] or hidden >= RELEASE_AFTER:
                if again == len(near) or again - frame >= RELEASE_AFTER:
                    gaps.append((frame, again))
                break
    return gaps
