"""The masks of one camera over the video: whether object and hands are there, whole, and change no faster than bodies do.

`neuspring check-data` asks this of a capture's masks, the segmentation of those that it made.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import cv2
import numpy as np

from neuspring.core.findings import Finding, finding
from neuspring.data.capture import HANDS, OBJECT

APART = 0.1
"""Distance between two pieces of one label, as a fraction of the image, from which they count as two objects."""
SECOND = 0.3
"""A piece with at least this fraction of the largest piece's area counts as an object."""
LEAVES = 0.1
"""Fraction of its area in frame 0 below which an object has left the view."""
SMALL = 200
"""Pixels of the object in frame 0."""
EDGE = 3
"""Pixels of the object on the image border from which it may go on outside."""
CUT = 0.1
"""Share of the frames from which an object at the border counts as cut off; frame 0 alone does, where its shape is taken."""
BORDERED = 0.1
"""Part of the image's border that is object, median over frames, from which the mask shows the background or a person."""
JUMP = 2.0
"""Ratio of the object's areas in neighboring frames: no body grows that fast."""
STEP, STEPS, FEWEST = 1.5, 0.1, 3
"""A smaller such ratio, and the part and number of frames with it from which a mask flickers: what is hidden once and comes back
jumps twice."""
FLOOR = 1e-4
"""Part of the image by which areas are enlarged before they are divided: a few pixels of a hidden object are no jump."""
REMEDY = "Mark object and hands in a few frames (`neuspring mask`), or choose another perception.segment.backend."


def objects(labels: np.ndarray) -> int:
    """Number of objects with label 1: pieces of the mask that stay apart when it is grown by half of APART."""
    own = (labels == OBJECT).astype(np.uint8)
    reach = max(int(0.5 * APART * max(labels.shape)), 1)
    grown = cv2.dilate(own, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2))
    count, pieces = cv2.connectedComponents(grown)
    sizes = np.array([(own[pieces == k] > 0).sum() for k in range(1, count)])
    return int((sizes >= SECOND * sizes.max()).sum()) if len(sizes) else 0


class Shown:
    """What the masks of one camera show, counted frame by frame."""

    def __init__(self, frames: int, size: tuple[int, int]) -> None:
        """Nothing so far, of images of `size` (width, height)."""
        self.size, self.objects = size, 0
        self.areas = np.full((3, frames), np.nan)
        """Pixels of each label [3, T]; NaN without a mask."""
        self.rims = np.full(frames, np.nan)
        """Pixels of the object on the image border [T]."""

    def see(self, frame: int, labels: np.ndarray) -> None:
        """Count the mask [H, W] of a frame."""
        self.areas[:, frame] = np.bincount(labels.ravel(), minlength=3)[:3]
        own = labels == OBJECT
        self.rims[frame] = own[0].sum() + own[-1].sum() + own[1:-1, 0].sum() + own[1:-1, -1].sum()
        if frame == 0:
            self.objects = objects(labels)

    @property
    def frames(self) -> np.ndarray:
        """Frames with a mask."""
        return np.flatnonzero(np.isfinite(self.rims))

    @property
    def bordered(self) -> float:
        """Part of the image's border that is object, median over frames."""
        return float(np.median(self.rims[self.frames])) / (2 * sum(self.size) - 4) if len(self.frames) else 0.0

    def ratios(self) -> dict[int, float]:
        """Ratio of the object's areas, 1 or more, in a frame and the one before it; of frames that follow each other."""
        grown = self.areas[OBJECT] + FLOOR * self.size[0] * self.size[1]
        return {b: float(max(grown[a] / grown[b], grown[b] / grown[a])) for a, b in pairwise(self.frames.tolist()) if b == a + 1}

    @property
    def steps(self) -> float:
        """Part of the frames with a ratio above STEP; 0 where there are fewer than FEWEST."""
        ratios = self.ratios().values()
        count = sum(ratio > STEP for ratio in ratios)
        return count / len(ratios) if count >= FEWEST else 0.0


def mask_findings(camera: str, shown: Shown) -> list[Finding]:
    """Findings about the masks of one camera. Without a mask of frame 0 nothing is said of it."""
    area, hands, found = shown.areas[OBJECT], shown.areas[HANDS], list[Finding]()
    if not len(shown.frames):
        return found

    def say(name: str, value: str, rule: str, remedy: str = REMEDY) -> None:
        found.append(finding(name, "warning", f"camera {camera}", value, rule, remedy))

    if area[0] == 0:
        say("no object in frame 0", "no pixel with label 1 in frame 0", "shape and points begin there")
    if hands[0] == 0:
        rule = "controllers begin in frame 0, with what some camera shows of the hands there"
        say("no hand in frame 0", "no pixel with label 2 in frame 0", rule, "Begin the capture when a hand is in view, or mark it.")
    if shown.objects > 1:
        value = f"the object's mask of frame 0 has {shown.objects} pieces far apart"
        say("two objects", value, "one object is expected, whose pieces lie together; two become one twin")
    if 0 < area[0] < SMALL:
        say("small object", f"{area[0]:.0f} pixels of object in frame 0", f"at least {SMALL} are expected", "Film from nearer by.")
    gone = shown.frames[area[shown.frames] < np.fmax(LEAVES * np.nan_to_num(area[0]), 1)]
    if len(gone) and area[0] != 0:
        value = f"almost nothing of the object in {len(gone)} frames, first in frame {gone[0]}"
        say("object missing", value, "each frame should show it; its points are invisible there")
    _at_border(shown, say)
    if shown.steps > STEPS:
        value = f"the object's area changes {STEP:g}-fold or more in {shown.steps:.0%} of the frames"
        say("mask flickers", value, f"at most {STEPS:.0%} are expected")
    elif wild := {frame: ratio for frame, ratio in shown.ratios().items() if ratio > JUMP}:
        frame, ratio = next(iter(wild.items()))
        value = f"the object's area changes {ratio:.1f}-fold from frame {frame - 1} to {frame} (so in {len(wild)} frames)"
        say("mask jumps", value, f"less than {JUMP:g}-fold is expected")
    return found


def _at_border(shown: Shown, say: Callable[..., None]) -> None:
    if shown.bordered > BORDERED:
        value = f"{shown.bordered:.0%} of the image's border is object"
        rule = f"at most {BORDERED:.0%} is expected; the mask holds the table, a sleeve or a person"
        say("background in the mask", value, rule)
        return
    cut = shown.frames[shown.rims[shown.frames] >= EDGE]
    if len(cut) and (cut[0] == 0 or len(cut) >= CUT * len(shown.frames)):
        value = f"the object touches the image border in {len(cut)} frames, first in frame {cut[0]}"
        remedy = (
            "Is it the object? Then move the camera back, or keep other frames (make-capture --frames). If not, mark what it is."
        )
        say("object at the border", value, "what is outside is neither seen nor carved", remedy)
