"""The masks of one camera over the video: whether object and hands are there, whole, and change as bodies and pictures do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from neuspring.core.checks import Check
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.frames import frames_of, gray, spread

PIECES_APART = 0.1
"""Distance between two pieces of one label, as a fraction of the image, from which they count as two objects."""
SECOND_PIECE = 0.3
"""A piece with at least this fraction of the largest piece's area counts as an object."""
LEAVES = 0.1
"""Fraction of its area in frame 0 below which an object has left the view."""
SMALL_MASK = 200
"""Pixels of the object in frame 0."""
BORDER_PIXELS = 3
"""Pixels of the object on the image border from which it may go on outside."""
CUT = 0.1
"""Share of the frames from which an object at the border counts as cut off; frame 0 alone does, where its shape is taken."""
ENTERS = 0.5
"""Share of the frames in which an arm enters the image; in real films and synthetic scenes it is 0.6 to 1."""
BORDERED = 0.1
"""Part of the image's border that is object, median over frames, from which the mask shows the background or a person."""
AREA_JUMP = 2.0
"""Ratio of the object's areas in neighboring frames: no body grows that fast."""
AREA_STEP, STEPS_SHARE, FEWEST_STEPS = 1.5, 0.1, 3
"""A smaller such ratio, and the part and number of frames with it from which a mask flickers: what is hidden once and comes back
jumps twice."""
AREA_FLOOR = 1e-4
"""Part of the image by which areas are enlarged before they are divided: a few pixels of a hidden object are no jump."""
MARK_REMEDY = "Mark object and hands in a few frames (`neuspring mask`), or choose another perception.segment.backend."


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
        return {b: float(max(grown[a] / grown[b], grown[b] / grown[a])) for a, b in pairwise(self.frames.tolist()) if b == a + 1}

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


def at_border(shown: Shown) -> dict[str, Any] | None:
    """Frames in which the object, and not the background with it, is cut off by the image."""
    cut = shown.frames[shown.borders[OBJECT, shown.frames] >= BORDER_PIXELS]
    cut_off = len(cut) and (cut[0] == 0 or len(cut) >= CUT * len(shown.frames))
    return _of_frames(cut) if cut_off and shown.bordered <= BORDERED else None


def exchanged(shown: Shown) -> dict[str, Any] | None:
    """Share of its frames in which the object is at the image border, where arms should enter, and the hands stay inside."""
    at_it, there = shown.borders >= BORDER_PIXELS, shown.areas > 0
    object_in, hands_in = (np.sum(at_it[label]) / max(np.sum(there[label]), 1) for label in (OBJECT, HANDS))
    enough = there[HANDS].sum() >= ENTERS * len(shown.frames)
    return {"value": float(object_in), "hands": hands_in} if enough and object_in >= ENTERS and hands_in < CUT else None


def jumps(shown: Shown) -> dict[str, Any] | None:
    """Ratio of the object's areas in the first pair of frames between which it jumps."""
    wild = {} if shown.steps > STEPS_SHARE else {frame: ratio for frame, ratio in shown.ratios().items() if ratio > AREA_JUMP}
    if not wild:
        return None
    frame = next(iter(wild))
    return _of_frames([*wild]) | {"value": wild[frame], "before": frame - 1}


def _of_frames(frames: Sequence[int] | np.ndarray) -> dict[str, Any]:
    return {"value": len(frames), "count": len(frames), "first": int(frames[0]), "frames": [int(frame) for frame in frames]}


SAME_GRAY = 6
"""Change of gray below which a pixel did not change."""
FLICKER_PAIRS = 16
"""Number of pairs of frames that are looked at for pixels that change their label alone."""
HANDS_INSIDE = 0.25
"""Part of the hands' pixels that lie in pieces enclosed by the object, from which they are its print."""
FLICKER = 0.08
"""Pixels that change their label and not their color, as part of object and hands, from which labels are noise."""
LAG, LOOKED = 3, 24
"""Frames between two pictures that are compared, and number of such pairs."""
COMPARED_WIDTH, COLOR_MOVED = 320, 12
"""Width, pixels, at which they are compared, and the change of a color value from which a pixel moves."""
MASK_RIM, MOTION_BESIDE = 0.01, 0.075
"""Part of the width by which a mask may be too small, and beside an object within which motion belongs to it or to a hand."""
OUTSIDE = 0.25
"""Share of the moving pixels that lie in no mask. Right masks of real films and of synthetic scenes have more in at most 2 of 24
pairs; masks that lose half of the object, in 3 or more."""
OFTEN = 0.1
"""Share of the frames, or of the pairs, from which something is a warning: a rope that turns away for two frames is none."""
STIRRED = 0.05
"""Part of the object's pixels that change where it moves."""
NEW, DARKER, SHADOW_TINT = 0.01, 0.05, 0.12
"""Part of the object's pixels that must look new; how much lighter, as a log ratio, a shadow may make a pixel, and by how much the
ratios of its three colors may differ."""
LEAST_NEWLY_KEPT = 0.4
"""Share of what the object seems to cover newly that lies in its mask. Right masks of real films keep 0.52 to 0.99, and masks that
lose 80 % of it 0.2 or less. Of color alone: right masks of a real RGBD film, in which an arm comes near, keep 0.2 too."""
UNMARKED = (
    "Look there: a part of the object, or a hand that came in, lies in no mask. Mark it in that frame (`neuspring annotate`), and "
    "carry again. If neither moves there, ignore this."
)


@dataclass(frozen=True, eq=False)
class Motion:
    """The change of a camera's picture from a frame on, at COMPARED_WIDTH pixels."""

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
    frames, view = frames_of(capture, camera), capture.cameras[camera]
    scale = min(1.0, COMPARED_WIDTH / view.width)
    size = round(scale * view.width), round(scale * view.height)

    def small(frame: int) -> np.ndarray:
        image = cv2.resize(np.ascontiguousarray(capture.color(camera, frame)), size, interpolation=cv2.INTER_AREA)
        return cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0)

    def change(one: np.ndarray, other: np.ndarray, least: float) -> np.ndarray:
        changed = (np.abs(one - other).max(axis=-1) > least).astype(np.uint8)
        return cv2.morphologyEx(changed, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(bool)

    pairs = [(here, there) for here, there in zip(frames, frames[LAG:], strict=False) if there - here == LAG]
    if not pairs:
        return
    first = small(frames[0])
    for here, there in spread(pairs, LOOKED):
        image = small(here)
        three = [cv2.resize(labels[k], size, interpolation=cv2.INTER_NEAREST) for k in (here, there, frames[0])]
        ratio = np.log((image + 8) / (first + 8))
        shaded = (ratio.max(axis=-1) < DARKER) & (np.ptp(ratio, axis=-1) < SHADOW_TINT)
        yield Motion(here, change(image, small(there), COLOR_MOVED), change(image, first, 2 * COLOR_MOVED), shaded, np.stack(three))


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


def newly_kept(seen: Sequence[Motion]) -> dict[str, float]:
    """The part of what seems newly covered that lies in the object's mask, and the first frame in which that is too little."""
    newly = [(motion.frame, *motion.newly) for motion in seen if motion.newly[1] > NEW * motion.begin.sum()]
    if len(newly) < FEWEST_STEPS:
        return {}
    lost = [frame for frame, kept, found in newly if kept < LEAST_NEWLY_KEPT * found]
    share = sum(kept for _, kept, _ in newly) / sum(found for *_, found in newly)
    return {"newly_kept": share} | ({"first_newly_lost": float(lost[0])} if lost else {})


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


Facts = Mapping[str, float]


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
        **newly_kept(seen),
    }


def _median(values: Sequence[float] | np.ndarray) -> float:
    """0 of none: a camera may have no frame."""
    return float(np.median(values)) if len(values) else 0.0


def outside(facts: Facts) -> dict[str, Any]:
    """Share of the times in which something moves at the object and lies in no mask."""
    first = int(facts.get("first_outside", 0))
    return {"value": facts["moves_outside"], "first": first, "frames": (first,)}


def kept(facts: Facts, has_depth: bool) -> dict[str, Any] | None:
    """Share of newly covered parts that the object's mask keeps, of color alone."""
    first = int(facts.get("first_newly_lost", 0))
    return None if has_depth else {"value": facts.get("newly_kept", 1.0), "first": first, "frames": (first,)}


INF = float("inf")
# fmt: off
checks = (
    Check("no object in frame 0", "masks", lambda shown: first_area(shown, OBJECT), (0.5, INF), "warning",
          f"no pixel with label {OBJECT} in frame 0; shape and points begin there.", MARK_REMEDY),
    Check("no hand in frame 0", "masks", lambda shown: first_area(shown, HANDS), (0.5, INF), "warning",
          f"no pixel with label {HANDS} in frame 0; controllers begin in frame 0, with what some camera shows of the hands there.",
          "Begin the capture when a hand is in view, or mark it."),
    Check("two objects", "masks", lambda shown: shown.objects, (0, 1), "warning",
          "the object's mask of frame 0 has {value} pieces far apart; one object is expected, whose pieces lie together; two "
          "become one twin.", MARK_REMEDY),
    Check("small object", "masks", lambda shown: first_area(shown, OBJECT) or None, (SMALL_MASK, INF), "warning",
          "{value:.0f} pixels of object in frame 0; at least {low} are expected.", "Film from nearer by."),
    Check("object missing", "masks", missing, None, "warning",
          "almost nothing of the object in {count} frames, first in frame {first}; each frame should show it; its points are "
          "invisible there.", MARK_REMEDY),
    Check("background in the mask", "masks", lambda shown: shown.bordered, (0, BORDERED), "warning",
          "{value:.0%} of the image's border is object; at most {high:.0%} is expected; the mask holds the table, a sleeve or a "
          "person.", MARK_REMEDY),
    Check("labels exchanged", "masks", exchanged, None, "warning",
          f"the object (label {OBJECT}) reaches the image border in {{value:.0%}} of its frames, the hands (label {HANDS}) in "
          "{hands:.0%} of theirs; arms enter there, and the object does not.",
          f"If they are exchanged, write {OBJECT} for the object and {HANDS} for hands."),
    Check("object at the border", "masks", at_border, None, "warning",
          "the object touches the image border in {count} frames, first in frame {first}; what is outside is neither seen nor "
          "carved.",
          "Is it the object? Then move the camera back, or keep other frames (make-capture --frames). If not, mark what it is."),
    Check("mask flickers", "masks", lambda shown: shown.steps, (0, STEPS_SHARE), "warning",
          f"the object's area changes {AREA_STEP:g}-fold or more in {{value:.0%}} of the frames; at most {{high:.0%}} are "
          "expected.", MARK_REMEDY),
    Check("mask jumps", "masks", jumps, None, "warning",
          "the object's area changes {value:.1f}-fold from frame {before} to {first} (so in {count} frames); less than "
          f"{AREA_JUMP:g}-fold is expected.", MARK_REMEDY),
    Check("hands inside the object", "segmentation", lambda facts, _: facts["hands_inside"], (0, HANDS_INSIDE), "warning",
          "{value:.0%} of the hands' pixels lie inside of the object; at most {high:.0%} are expected; its own colors are taken "
          "for hands.", MARK_REMEDY),
    Check("labels are noise", "segmentation", lambda facts, _: facts["flicker"], (0, FLICKER), "warning",
          "{value:.0%} of the masks changes its label where the image does not change; at most {high:.0%} is expected.",
          MARK_REMEDY),
    Check("motion outside of the masks", "segmentation", lambda facts, _: outside(facts), (0, OFTEN), "warning",
          f"in {{value:.0%}} of the times that were looked at, first in frame {{first}}, more than {OUTSIDE:.0%} of what moves "
          "at the object lies in no mask; less than {high:.0%} is expected.", UNMARKED),
    Check("newly covered parts lost", "segmentation", kept, (LEAST_NEWLY_KEPT, INF), "warning",
          "of what the object seems to cover newly since frame 0, its mask keeps {value:.0%}, too little first in frame {first}; "
          "at least {low:.0%} is expected.", UNMARKED),
)
