"""Quality numbers of the masks of one camera."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.plausible_masks import Shown

STILL = 6
"""Change of gray below which a pixel did not change."""
PAIRS = 16
"""How many pairs of frames are looked at for pixels that change their label alone."""


def mask_facts(capture: Capture, camera: str, labels: np.ndarray) -> dict[str, float]:
    """Shares and counts of labels [T, H, W]; `look` says what they mean."""
    shown = shown_by(capture, camera, labels)
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
        "hands_inside": _median([_inside(labels[frame]) for frame in frames]),
        "flicker": _flicker(capture, camera, labels, frames),
    }


def shown_by(capture: Capture, camera: str, labels: np.ndarray) -> Shown:
    """Counts of labels [T, H, W], over the frames that the camera has."""
    shown = Shown(len(labels), (labels.shape[2], labels.shape[1]))
    for frame in range(capture.frame_count):
        if capture.has(camera, frame):
            shown.see(frame, labels[frame])
    return shown


def _median(values: Sequence[float] | np.ndarray) -> float:
    """0 of none: a camera may have no frame."""
    return float(np.median(values)) if len(values) else 0.0


def _flicker(capture: Capture, camera: str, labels: np.ndarray, frames: np.ndarray) -> float:
    """Pixels that change their label and not their color from one frame to the next, as part of object and hands."""
    flips = total = 0
    for index in np.unique(np.linspace(0, max(len(frames) - 2, 0), min(PAIRS, max(len(frames) - 1, 0))).astype(int)):
        here, there = frames[index], frames[index + 1]
        gray = [cv2.cvtColor(np.ascontiguousarray(capture.color(camera, int(k))), cv2.COLOR_RGB2GRAY) for k in (here, there)]
        still = cv2.blur(cv2.absdiff(*gray), (5, 5)) < STILL
        flips += int((still & (labels[here] != labels[there])).sum())
        total += int((labels[here] > 0).sum())
    return flips / max(total, 1)


def _inside(labels: np.ndarray) -> float:
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
