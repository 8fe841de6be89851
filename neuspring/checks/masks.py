"""The masks of one camera over time: presence, completeness and plausible changes of object and hands."""

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
"""Distance between two pieces of one label, as a fraction of the image, above which they count as two objects."""
SECOND_PIECE = 0.3
"""A piece counts as an object if it has at least this fraction of the largest piece's area."""
LEAVES = 0.1
"""An object with less than this fraction of its area in frame 0 is missing."""
BORDER_PIXELS = 3
"""A label with at least this number of pixels on the image border may continue outside of the image."""
AREA_STEP, STEPS_SHARE, FEWEST_STEPS = 1.5, 0.1, 3
"""A mask flickers if the area changes by more than AREA_STEP in more than STEPS_SHARE of the frames, and in at least FEWEST_STEPS
frames. An object that is hidden once causes only two such changes."""
AREA_FLOOR = 1e-4
"""Fraction of the image added to areas before division, so that a few pixels of a hidden object do not count as a jump."""


class Shown:
    """Pixel counts of one camera's masks per frame."""

    def __init__(self, frames: int, size: tuple[int, int]) -> None:
        """Start empty, for images of `size` (width, height)."""
        self.size = size
        self.objects = 0
        """Number of objects in frame 0."""
        self.areas = np.full((3, frames), np.nan)
        """Pixels of each label [3, T]; NaN in frames without a mask."""
        self.borders = np.full((3, frames), np.nan)
        """Pixels of each label on the image border [3, T]; NaN in frames without a mask."""

    @classmethod
    def of(cls, capture: Capture, camera: str, labels: np.ndarray) -> Shown:
        """Count labels [T, H, W] in the camera's frames."""
        shown = cls(len(labels), (labels.shape[2], labels.shape[1]))
        for frame in frames_of(capture, camera):
            shown.see(frame, labels[frame])
        return shown

    def see(self, frame: int, labels: np.ndarray) -> None:
        """Count the labels [H, W] of a frame."""
        self.areas[:, frame] = np.bincount(labels.ravel(), minlength=3)[:3]
        border = np.concatenate([labels[0], labels[-1], labels[1:-1, 0], labels[1:-1, -1]])
        self.borders[:, frame] = np.bincount(border, minlength=3)[:3]
        if frame == 0:
            own = labels == OBJECT
            # Pieces that touch after dilation by half of PIECES_APART count as one object.
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
        """Fraction of the image border that is object, median over frames."""
        return float(np.median(self.borders[OBJECT, self.frames])) / (2 * sum(self.size) - 4) if len(self.frames) else 0.0

    def ratios(self) -> dict[int, float]:
        """Frame -> ratio, at least 1, of the object's areas in this and the previous frame; only if both frames exist."""
        enlarged = self.areas[OBJECT] + AREA_FLOOR * self.size[0] * self.size[1]
        # The first mask of the object is not a jump.
        begun = [frame for frame in self.frames.tolist() if np.nansum(self.areas[OBJECT, : frame + 1])]
        return {b: float(max(enlarged[a] / enlarged[b], enlarged[b] / enlarged[a])) for a, b in pairwise(begun) if b == a + 1}

    @property
    def steps(self) -> float:
        """Fraction of frames with a ratio above AREA_STEP; 0 if there are fewer than FEWEST_STEPS."""
        ratios = self.ratios().values()
        count = sum(ratio > AREA_STEP for ratio in ratios)
        return count / len(ratios) if count >= FEWEST_STEPS else 0.0


def first_area(shown: Shown, label: int) -> float | None:
    """Pixels of a label in frame 0; None if frame 0 has no mask."""
    return float(shown.areas[label, 0]) if np.isfinite(shown.areas[label, 0]) else None


def missing(shown: Shown) -> dict[str, Any] | None:
    """Frames with almost no pixels of an object that frame 0 shows."""
    area, frames = shown.areas[OBJECT], shown.frames
    gone = frames[area[frames] < np.fmax(LEAVES * np.nan_to_num(area[0]), 1)]
    return _of_frames(gone) if len(gone) and area[0] != 0 else None


def exchanged(shown: Shown) -> dict[str, Any] | None:
    """Fraction of the object's frames in which it is at the image border; None unless hands are visible and stay inside."""
    at_border, visible = shown.borders >= BORDER_PIXELS, shown.areas > 0
    of_object, of_hands = (np.sum(at_border[label]) / max(np.sum(visible[label]), 1) for label in (OBJECT, HANDS))
    enough = visible[HANDS].sum() >= 0.5 * len(shown.frames)
    return {"value": float(of_object)} if enough and of_hands < 0.1 else None


def jumps(shown: Shown) -> dict[str, Any] | None:
    """The largest ratio of the object's areas in neighboring frames; None for a flickering mask."""
    ratios = {} if shown.steps > STEPS_SHARE else shown.ratios()
    if not ratios:
        return None
    frame = max(ratios, key=lambda frame: ratios[frame])
    return {"value": ratios[frame], "detail": f"from frame {frame - 1} to {frame}", "frames": (frame,)}


def outside(facts: Mapping[str, float]) -> dict[str, Any]:
    """Fraction of compared frames with motion next to the object outside of all masks."""
    first = int(facts.get("first_outside", 0))
    return {"value": facts["moves_outside"], "detail": f"first in frame {first}", "frames": (first,)}


def _of_frames(frames: np.ndarray) -> dict[str, Any]:
    return {"value": len(frames), "detail": f"first in frame {frames[0]}", "frames": frames.tolist()}


SAME_GRAY = 6
"""Gray value change below which a pixel counts as unchanged."""
FLICKER_PAIRS = 16
"""Number of frame pairs that `flicker` compares."""
LAG, LOOKED = 3, 24
"""Frames between two compared images, and the number of such pairs."""
COLOR_MOVED = 12
"""Color value change above which a pixel counts as moving."""
MASK_RIM, MOTION_BESIDE = 0.01, 0.075
"""Fractions of the image width: tolerance of mask borders, and distance within which motion belongs to the object or a hand."""
OUTSIDE = 0.25
"""Fraction of moving pixels outside of all masks. Correct masks of real videos and synthetic scenes exceed it in at most 2 of 24
pairs; masks that lose half of the object exceed it in 3 or more."""
OFTEN = 0.1
"""Fraction of pairs above which `outside` is a warning; a rope that rotates away for two frames is not."""
STIRRED = 0.05
"""The object moves if more than this fraction of its pixels changes."""
DARKER, SHADOW_TINT = 0.05, 0.12
"""Limits of the log ratios of a pixel's colors to frame 0 in a shadow: the largest value, and the range over the three colors."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Changes of a camera's image between frames, at the reduced size of `timing.small`."""

    frame: int
    moving: np.ndarray
    """[h, w] bool: pixels that change within LAG frames."""
    since: np.ndarray
    """[h, w] bool: pixels that differ clearly from frame 0."""
    shaded: np.ndarray
    """[h, w] bool: pixels that match frame 0 in a shadow."""
    labels: np.ndarray
    """[3, h, w]: labels of this frame, of the frame LAG later, and of frame 0."""

    @cached_property
    def uncovered(self) -> bool:
        """True if much of the motion next to the object is outside of all masks."""
        both = self.labels[:2]
        near = self.moving & grown((both == OBJECT).any(axis=0), MOTION_BESIDE)
        bare = int((near & ~grown(np.any(both, axis=0), MASK_RIM)).sum())
        return bool(bare > max(OUTSIDE * near.sum(), MASK_RIM * (both[0] == OBJECT).sum()))

    @cached_property
    def newly(self) -> tuple[int, int]:
        """Number of pixels that the object probably covers newly since frame 0: those in its mask, and all.

        These pixels changed, are not in a shadow, and connect to the object. They are away from labels of frame 0 and from hands.
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
        """[h, w] bool: the object's mask in frame 0."""
        return np.asarray(self.labels[2] == OBJECT)

    @cached_property
    def stirred(self) -> bool:
        """True if the object moves: the image changed at its position of frame 0 (without hands), or where it is now."""
        own = self.since & self.begin & ~grown(np.any(self.labels >= HANDS, axis=0), MASK_RIM)
        return bool(own.sum() + self.newly[1] > STIRRED * max(self.begin.sum(), 1))


def motions(capture: Capture, camera: str, labels: np.ndarray) -> Iterator[Motion]:
    """Yield at most LOOKED evenly spaced pairs of frames; labels are [T, H, W]."""
    frames = frames_of(capture, camera)

    def change(before: np.ndarray, after: np.ndarray, least: float) -> np.ndarray:
        changed = (np.abs(before - after).max(axis=-1) > least).astype(np.uint8)
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
    """Dilate a mask [h, w] bool by a fraction of its width."""
    reach = round(share * mask.shape[1])
    return cv2.dilate(mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)).astype(bool)


def moves_outside(seen: Sequence[Motion]) -> dict[str, float]:
    """Fraction of compared frames with motion next to the object outside of all masks, and the first such frame."""
    frames = [motion.frame for motion in seen if motion.uncovered]
    if len(frames) < FEWEST_STEPS:
        return {"moves_outside": 0.0}
    return {"moves_outside": len(frames) / len(seen), "first_outside": float(frames[0])}


def object_moves(seen: Sequence[Motion], train_end: int) -> dict[str, float]:
    """Fraction of compared training frames in which the object's image changes."""
    return {"object_moves": float(np.mean([motion.stirred for motion in seen if motion.frame < train_end] or [False]))}


def flicker(capture: Capture, camera: str, labels: np.ndarray, frames: np.ndarray) -> float:
    """Fraction of object and hand pixels whose label, but not color, changes between neighboring frames."""
    flips = total = 0
    pairs = list(pairwise(frames.tolist()))
    for here, there in spread(pairs, FLICKER_PAIRS) if pairs else []:
        still = cv2.blur(cv2.absdiff(gray(capture, camera, here), gray(capture, camera, there)), (5, 5)) < SAME_GRAY
        flips += int((still & (labels[here] != labels[there])).sum())
        total += int((labels[here] > 0).sum())
    return flips / max(total, 1)


def hands_inside(labels: np.ndarray) -> float:
    """Fraction of hand pixels in pieces that are surrounded by the object (80 % of their border); labels [H, W]."""
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
    """Fractions and counts of labels [T, H, W], for the record of segmentation."""
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
    """The median; 0 of an empty sequence, because a camera may have no frame."""
    return float(np.median(values)) if len(values) else 0.0
