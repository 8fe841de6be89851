"""Which points of the hands move the object, and when they hold it.

Controllers are seen throughout and spread over the hands, or lie where hands grip and move rigidly. Hands let go, and take hold
again.
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
"""Largest number of controller points."""
GRASP_REACH = 0.03
"""m by which controllers of `grip: patch` may lie farther from the object than a hand's nearest point in frame 0."""
HAND_GAP = 0.04
"""m: a point nearer than this to a point of a hand belongs to that hand."""
LEAST_FOR_POSE = 3
"""Points that a rigid motion needs."""
ALWAYS = np.zeros((0, 0), dtype=bool)
"""All controllers hold in all frames."""
RELEASE_AFTER = 10
"""Frames without any hand in view after which hands have let go, and the fewest that a hand is away."""
HAND_CELL = 0.01
"""m: pixels of hands in one cube count once where pieces of them are sought."""
LEAST_OF_HAND = 20
"""Pixels of a hand near the object that are not noise of a mask."""
GRIP_GUIDES = 5
"""Followed points of the object that say which part of it is near a hand."""


def choose_controllers(
    points: np.ndarray, visible: np.ndarray, valid: np.ndarray, cloud: np.ndarray, settings: Lift, where: str
) -> tuple[np.ndarray, dict[str, float]]:
    """Controllers [T, C, 3], m, and facts about them, of hand tracks [T, n, 3] and the object's points of frame 0 `cloud` [P, 3].

    `controller_gaps: none`, as released: points visible in all frames whose motion never disagrees. `rigid`: points seen in at
    least `controller_share` of the frames; where one is not seen it goes where the rigid motion of its hand takes it. At most
    MOST_CONTROLLERS points, each the farthest from those before. `grip: patch` takes them from `patches` instead. Raises
    InputError if fewer than `least_controllers` remain.
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
            rule = f"at least {settings.least_controllers} points of the hands must lie near the object in frame 0"
            remedy = "perception.lift has least_controllers."
        else:
            rule = f"at least {settings.least_controllers} points of the hands must be followed through the video"
            remedy = "Look at the overlay of tracks; perception.lift has controller_gaps, controller_share and least_controllers."
        raise InputError(where, rule, f"{candidates.shape[1]} of {visible.shape[1]}", remedy)
    controllers = candidates[:, farthest(candidates[0], MOST_CONTROLLERS)]
    facts |= {"controllers": float(controllers.shape[1]), "hand_tracks_kept": float(count), "controllers_filled": filled}
    return controllers, facts


def patches(points: np.ndarray, trusted: np.ndarray, cloud: np.ndarray) -> tuple[np.ndarray, float]:
    """The points of each hand that are near the object in frame 0, moving rigidly with their hand: [T, n', 3], m; and how far
    trusted points are from that motion, m (root mean square).

    A point at distance d from `cloud` is near if d <= GRASP_REACH + the least such distance of its hand: a hand that has yet to
    come grips with what is foremost. A hand's motion is that of its trusted points, as in `fill_rigidly`; all others follow it too,
    so the fingertips that are hidden later still grip.
    """
    rigid = fill_rigidly(points, np.zeros_like(trusted), trusted)
    distance = cKDTree(cloud).query(points[0])[0]
    near = [hand[distance[hand] <= distance[hand].min() + GRASP_REACH] for hand in hands_of(points[0])]
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
            if len(missing := hand[~kept[frame, hand]]):
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


@dataclass(frozen=True, eq=False)
class SeenBody:
    """Evidence of the object, and of the hands in the masks, in the training frames."""

    clouds: Sequence[np.ndarray]
    """Points of the object that cameras see in each frame [P_t, 3], m."""
    hands: Sequence[np.ndarray]
    """Points of all hands that cameras see in each frame [H_t, 3], m."""
    points: np.ndarray
    """Followed points [T, n, 3], m."""
    visible: np.ndarray
    """[T, n] bool."""


@dataclass(frozen=True, eq=False)
class Grips:
    """When controllers hold, and hands that none of them stands for."""

    holds: np.ndarray
    """[T, C] bool; `ALWAYS` if all hold in all frames."""
    elsewhere: int | None
    """The first frame in which a hand came back to another part of the object, which no spring joins to it."""
    strays: list[int]
    """Frames in which a hand without controllers is within `release` of the body."""


def holding(
    controllers: np.ndarray, hands: tuple[np.ndarray, np.ndarray], body: SeenBody, in_view: np.ndarray, release: float
) -> Grips:
    """When each of `controllers` [T, C, 3] holds, and where pixels of hands have no controllers.

    `hands` are tracked points [T, n, 3], m, and whether they are seen [T, n]; `in_view` [T]: whether any mask shows a hand. The
    body is known in the training frames: later a hand lets go only by leaving the view, and takes no hold.

    A hand lets go after a frame in which it was within `release`, m, of the body: as soon as it is seen farther away, or when no
    hand was in view for RELEASE_AFTER frames. If it is near again fewer than RELEASE_AFTER frames later it has not let go. Later it
    takes hold again, if the part of the body that it is near lay within `release` of its controllers in frame 0, where springs are
    made; else it holds nothing any more.
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
        # Followed points lie anywhere on a hand, and of few of them the pose is rough: what masks show of it counts too.
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
            # The part of the body that is near the hand now, where it was in frame 0.
            known = np.flatnonzero(body.visible[end] & body.visible[0])
            nearest = np.argsort(cKDTree(controllers[end, members]).query(body.points[end, known])[0], kind="stable")[:GRIP_GUIDES]
            there = cKDTree(controllers[0, members]).query(body.points[0, known[nearest]])[0]
            if not len(known) or np.median(there) > release:
                valid[end:, members] = False
                elsewhere.append(end)
                break
    return Grips(ALWAYS if valid.all() else valid, min(elsewhere, default=None), strays)


def _owners(pixels: np.ndarray, known: np.ndarray, hand: np.ndarray) -> np.ndarray:
    """The hand [P] of each pixel of hands [P, 3], m, by the `known` points [n, 3] of hand `hand` [n]; -1: of none of them.

    Pixels in one piece that known points lie on belong to the hand of the nearest. A piece without any is another hand: it came
    later, or its tracks are lost.
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
    """Frames [begin, end) in which a hand that was `near` [T] holds no more: until it is near again, or T.

    It is gone in the first frame in which it is `away` [T], or out of view for RELEASE_AFTER frames.
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
