"""The masks of one camera over the video: whether object and hands are there, whole, and change as bodies and images do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from neuspring.checks.timing import small
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.frames import frames_of, gray, spread

PIECES_APART = 0.1
"""Distance between two pieces of one label, as a fraction of the image, from which they count as two objects."""
SECOND_PIECE = 0.3
"""A piece with at least this fraction of the largest piece's area counts as an object."""
LEAVES = 0.1
"""Fraction of its area in frame 0 below which an object has left the view."""
BORDER_PIXELS = 3
"""Pixels of the object on the image border from which it may go on outside."""
AREA_STEP, STEPS_SHARE, FEWEST_STEPS = 1.5, 0.1, 3
"""A smaller such ratio, and the part and number of frames with it from which a mask flickers: what is hidden once and comes back
jumps twice."""
AREA_FLOOR = 1e-4
"""Part of the image by which areas are enlarged before they are divided: a few pixels of a hidden object are no jump."""


class Shown:
    """The masks of one camera, counted frame by frame."""

    def __init__(self, frames: int, size: tuple[int, int]) -> None:
        """Nothing so far, of images of `size` (width, height)."""
        self.size = size
        self.objects = 0
        """Objects in frame 0."""
        self.areas = np.full((3, frames), np.nan)
        """Pixels of each label [3, T]; NaN without a mask."""
        self.borders = np.full((3, frames), np.nan)
        """Pixels of each label on the image border [3, T]; NaN without a mask."""

    @classmethod
    def of(cls, capture: Capture, camera: str, labels: np.ndarray) -> Shown:
        """Counts of labels [T, H, W], over the frames that the camera has."""
        shown = cls(len(labels), (labels.shape[2], labels.shape[1]))
        for frame in frames_of(capture, camera):
            shown.see(frame, labels[frame])
        return shown

    def see(self, frame: int, labels: np.ndarray) -> None:
        """Count the mask [H, W] of a frame."""
        self.areas[:, frame] = np.bincount(labels.ravel(), minlength=3)[:3]
        border = np.concatenate([labels[0], labels[-1], labels[1:-1, 0], labels[1:-1, -1]])
        self.borders[:, frame] = np.bincount(border, minlength=3)[:3]
        if frame == 0:
            own = labels == OBJECT
            # Pieces count as one object if they meet when they are grown by half of PIECES_APART.
            reach = max(int(0.5 * PIECES_APART * max(labels.shape)), 1)
            disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)
            count, pieces = cv2.connectedComponents(cv2.dilate(own.astype(np.uint8), disk))
            sizes = np.bincount(pieces[own], minlength=count)[1:]
            self.objects = int((sizes >= SECOND_PIECE * sizes.max()).sum()) if len(sizes) else 0

    @property
    def frames(self) -> np.ndarray:
        """Frames with a mask."""
        return np.flatnonzero(np.isfinite(self.borders[OBJECT]))

    @property
    def bordered(self) -> float:
        """Part of the image's border that is object, median over frames."""
        return float(np.median(self.borders[OBJECT, self.frames])) / (2 * sum(self.size) - 4) if len(self.frames) else 0.0

    def ratios(self) -> dict[int, float]:
        """Ratio of the object's areas, 1 or more, in a frame and the one before it; of frames that follow each other."""
        grown = self.areas[OBJECT] + AREA_FLOOR * self.size[0] * self.size[1]
        # A mask that begins is no jump.
        begun = [frame for frame in self.frames.tolist() if np.nansum(self.areas[OBJECT, : frame + 1])]
        return {b: float(max(grown[a] / grown[b], grown[b] / grown[a])) for a, b in pairwise(begun) if b == a + 1}

    @property
    def steps(self) -> float:
        """Part of the frames with a ratio above AREA_STEP; 0 where there are fewer than FEWEST_STEPS."""
        ratios = self.ratios().values()
        count = sum(ratio > AREA_STEP for ratio in ratios)
        return count / len(ratios) if count >= FEWEST_STEPS else 0.0


def first_area(shown: Shown, label: int) -> float | None:
    """Pixels of a label in frame 0; None without a mask of it."""
    return float(shown.areas[label, 0]) if np.isfinite(shown.areas[label, 0]) else None


def missing(shown: Shown) -> dict[str, Any] | None:
    """Frames that show almost nothing of the object of frame 0."""
    area, frames = shown.areas[OBJECT], shown.frames
    gone = frames[area[frames] < np.fmax(LEAVES * np.nan_to_num(area[0]), 1)]
    return _of_frames(gone) if len(gone) and area[0] != 0 else None


def exchanged(shown: Shown) -> dict[str, Any] | None:
    """Share of its frames in which the object is at the image border, where the hands stay inside; arms should enter there."""
    at_it, there = shown.borders >= BORDER_PIXELS, shown.areas > 0
    object_in, hands_in = (np.sum(at_it[label]) / max(np.sum(there[label]), 1) for label in (OBJECT, HANDS))
    enough = there[HANDS].sum() >= 0.5 * len(shown.frames)
    return {"value": float(object_in)} if enough and hands_in < 0.1 else None


def jumps(shown: Shown) -> dict[str, Any] | None:
    """The largest ratio of the object's areas in neighboring frames, where they do not flicker."""
    ratios = {} if shown.steps > STEPS_SHARE else shown.ratios()
    if not ratios:
        return None
    frame = max(ratios, key=lambda one: ratios[one])
    return {"value": ratios[frame], "detail": f"from frame {frame - 1} to {frame}", "frames": (frame,)}


def outside(facts: Mapping[str, float]) -> dict[str, Any]:
    """Share of the times in which something moves at the object and lies in no mask."""
    first = int(facts.get("first_outside", 0))
    return {"value": facts["moves_outside"], "detail": f"first in frame {first}", "frames": (first,)}


def _of_frames(frames: np.ndarray) -> dict[str, Any]:
    return {"value": len(frames), "detail": f"first is frame {frames[0]}", "frames": frames.tolist()}


SAME_GRAY = 6
"""Change of gray below which a pixel did not change."""
FLICKER_PAIRS = 16
"""Number of pairs of frames that are looked at for pixels that change their label alone."""
LAG, LOOKED = 3, 24
"""Frames between two pictures that are compared, and number of such pairs."""
COLOR_MOVED = 12
"""Change of a color value from which a pixel moves."""
MASK_RIM, MOTION_BESIDE = 0.01, 0.075
"""Part of the width by which a mask may be too small, and beside an object within which motion belongs to it or to a hand."""
OUTSIDE = 0.25
"""Share of the moving pixels that lie in no mask. Right masks of real films and of synthetic scenes have more in at most 2 of 24
pairs; masks that lose half of the object, in 3 or more."""
OFTEN = 0.1
"""Share of the frames, or of the pairs, from which something is a warning: a rope that turns away for two frames is none."""
STIRRED = 0.05
"""Part of the object's pixels that change where it moves."""
DARKER, SHADOW_TINT = 0.05, 0.12
"""How much lighter, as a log ratio, a shadow may make a pixel, and by how much the
ratios of its three colors may differ."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The change of a camera's picture from a frame on, at WATCHED_WIDE pixels."""

    frame: int
    moving: np.ndarray
    """[h, w] bool: what changes within LAG frames."""
    since: np.ndarray
    """[h, w] bool: what has changed plainly since frame 0."""
    shaded: np.ndarray
    """[h, w] bool: what looks as in frame 0 in a shadow."""
    labels: np.ndarray
    """[3, h, w]: of the frame, of that LAG later, and of frame 0."""

    @cached_property
    def uncovered(self) -> bool:
        """True where much of what moves at the object lies in no mask."""
        both = self.labels[:2]
        near = self.moving & grown((both == OBJECT).any(axis=0), MOTION_BESIDE)
        bare = int((near & ~grown(np.any(both, axis=0), MASK_RIM)).sum())
        return bool(bare > max(OUTSIDE * near.sum(), MASK_RIM * (both[0] == OBJECT).sum()))

    @cached_property
    def newly(self) -> tuple[int, int]:
        """Pixels that the object seems to cover newly since frame 0: those in its mask, and all.

        They changed where neither object nor hand was or is near, are no shadow, and touch the object.
        """
        now, first = self.labels[0], self.labels[2]
        new = cv2.morphologyEx((self.since & ~self.shaded).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
        new &= ~grown((first > 0) | (now >= HANDS), MASK_RIM)
        around = grown((first == OBJECT) | (now == OBJECT), 2 * MASK_RIM)
        pieces = cv2.connectedComponents((new | around).astype(np.uint8))[1]
        new &= np.isin(pieces, np.unique(pieces[around]))
        return int((new & (now == OBJECT)).sum()), int(new.sum())

    @property
    def begin(self) -> np.ndarray:
        """[h, w] bool: the object in frame 0."""
        return np.asarray(self.labels[2] == OBJECT)

    @cached_property
    def stirred(self) -> bool:
        """True where the picture is another where the object was in frame 0 and no hand is, or where it seems to be since."""
        own = self.since & self.begin & ~grown(np.any(self.labels >= HANDS, axis=0), MASK_RIM)
        return bool(own.sum() + self.newly[1] > STIRRED * max(self.begin.sum(), 1))


def motions(capture: Capture, camera: str, labels: np.ndarray) -> Iterator[Motion]:
    """At most LOOKED of them, evenly spread."""
    frames = frames_of(capture, camera)

    def change(one: np.ndarray, other: np.ndarray, least: float) -> np.ndarray:
        changed = (np.abs(one - other).max(axis=-1) > least).astype(np.uint8)
        return cv2.morphologyEx(changed, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(bool)

    pairs = [
        (here, there)
        for here, there in zip(frames, frames[LAG:], strict=False)
        if there - here == LAG and capture.shows(camera, here)
    ]
    if not pairs:
        return
    first = small(capture.color(camera, frames[0]))
    for here, there in spread(pairs, LOOKED):
        image, later = (small(capture.color(camera, frame)) for frame in (here, there))
        three = [cv2.resize(labels[k], first.shape[1::-1], interpolation=cv2.INTER_NEAREST) for k in (here, there, frames[0])]
        ratio = np.log((image + 8) / (first + 8))
        shaded = (ratio.max(axis=-1) < DARKER) & (np.ptp(ratio, axis=-1) < SHADOW_TINT)
        yield Motion(here, change(image, later, COLOR_MOVED), change(image, first, 2 * COLOR_MOVED), shaded, np.stack(three))


def grown(mask: np.ndarray, share: float) -> np.ndarray:
    """A mask [h, w] bool grown by a part of its width."""
    reach = round(share * mask.shape[1])
    return cv2.dilate(mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)).astype(bool)


def moves_outside(seen: Sequence[Motion]) -> dict[str, float]:
    """Share of the times with motion at the object that no mask covers, and the first of them."""
    frames = [motion.frame for motion in seen if motion.uncovered]
    if len(frames) < FEWEST_STEPS:
        return {"moves_outside": 0.0}
    return {"moves_outside": len(frames) / len(seen), "first_outside": float(frames[0])}


def object_moves(seen: Sequence[Motion], train_end: int) -> dict[str, float]:
    """Share of training frames in which the object moves, as the picture shows it."""
    return {"object_moves": float(np.mean([motion.stirred for motion in seen if motion.frame < train_end] or [False]))}


def flicker(capture: Capture, camera: str, labels: np.ndarray, frames: np.ndarray) -> float:
    """Pixels that change their label and not their color from one frame to the next, as part of object and hands."""
    flips = total = 0
    pairs = list(pairwise(frames.tolist()))
    for here, there in spread(pairs, FLICKER_PAIRS) if pairs else []:
        still = cv2.blur(cv2.absdiff(gray(capture, camera, here), gray(capture, camera, there)), (5, 5)) < SAME_GRAY
        flips += int((still & (labels[here] != labels[there])).sum())
        total += int((labels[here] > 0).sum())
    return flips / max(total, 1)


def hands_inside(labels: np.ndarray) -> float:
    """Part of the hands' pixels [H, W] in pieces whose surroundings are nearly all object."""
    hands = (labels == HANDS).astype(np.uint8)
    count, pieces, boxes, _ = cv2.connectedComponentsWithStats(hands)
    inside = 0
    for piece in range(1, count):
        own = (pieces == piece).astype(np.uint8)
        around = cv2.dilate(own, np.ones((5, 5), np.uint8)).astype(bool) & (own == 0)
        if around.any() and (labels[around] == OBJECT).mean() > 0.8:
            inside += int(boxes[piece, cv2.CC_STAT_AREA])
    return inside / max(int(hands.sum()), 1)


def mask_facts(capture: Capture, camera: str, labels: np.ndarray) -> dict[str, float]:
    """Shares and counts of labels [T, H, W], which the record of segmentation keeps."""
    shown, seen = Shown.of(capture, camera, labels), list(motions(capture, camera, labels))
    frames, areas = shown.frames, shown.areas[:, shown.frames]
    return {
        "object_share": float((labels == OBJECT).mean()),
        "hand_share": float((labels == HANDS).mean()),
        "objects": float(shown.objects),
        "frames_without_object": float((areas[OBJECT] == 0).sum()),
        "frames_missing": float(len(labels) - len(frames)),
        "object_at_border": shown.bordered,
        "area_jumps": shown.steps,
        "hands_to_object": _median(areas[HANDS] / np.maximum(areas[OBJECT], 1.0)),
        "hands_inside": _median([hands_inside(labels[frame]) for frame in frames]),
        "flicker": flicker(capture, camera, labels, frames),
        **moves_outside(seen),
        **object_moves(seen, capture.train_end),
    }


def _median(values: Sequence[float] | np.ndarray) -> float:
    """0 of none: a camera may have no frame."""
    return float(np.median(values)) if len(values) else 0.0
