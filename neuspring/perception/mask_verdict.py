"""Whether masks can be right: what speaks against them, as numbers and as findings with the next move."""

from __future__ import annotations

import cv2
import numpy as np

from neuspring.core.findings import Finding, finding
from neuspring.data.capture import HANDS, OBJECT, Capture

AT_BORDER = 0.02
"""Part of the image's border that is object, from which the object is probably the background or a person."""
JUMP = 0.4
"""|log| of the ratio of areas of two frames, one after the other, from which an area jumps."""
JUMPS = 0.1
"""Part of the frames with such jumps, from which masks flicker."""
HANDS_TO_OBJECT = 10.0
"""Area of hands, as a multiple of the object's, from which hands are probably something else."""
HANDS_INSIDE = 0.25
"""Part of the hands' pixels that lie in pieces enclosed by the object, from which they are its print."""
STILL = 6
"""Change of gray below which a pixel did not change."""
FLICKER = 0.08
"""Pixels that change their label and not their color, as part of object and hands, from which labels are noise."""
PAIRS = 16
"""How many pairs of frames are looked at for that."""


REMEDY = "Mark object and hands in a few frames (`neuspring mask`), or set a region of interest (perception.segment.opencv)."


def verdict(capture: Capture, camera: str, labels: np.ndarray) -> tuple[dict[str, float], list[Finding]]:
    """Numbers of labels [T, H, W], and findings that say what is wrong; none where masks may be right."""
    frames = np.array([frame for frame in range(capture.frame_count) if capture.has(camera, frame)])
    own = labels[frames]
    areas = {label: (own == label).sum(axis=(1, 2)).astype(float) for label in (OBJECT, HANDS)}
    facts = {
        "object_at_border": float(np.median([_rim(part == OBJECT) for part in own])),
        "area_jumps": _jumps(areas[OBJECT], own[0].size),
        "hands_to_object": float(np.median(areas[HANDS] / np.maximum(areas[OBJECT], 1.0))),
        "hands_inside": float(np.median([_inside(part) for part in own])),
        "flicker": flicker(capture, camera, labels, frames),
    }
    rules = {
        "object_at_border": (AT_BORDER, "part of the image's border is object; it holds a person, a sleeve or the table"),
        "area_jumps": (JUMPS, "part of the frames in which the object's area jumps; its mask flickers"),
        "hands_to_object": (HANDS_TO_OBJECT, "times as much hand as object; hands are something else, or the object was missed"),
        "hands_inside": (HANDS_INSIDE, "part of the hands lies inside of the object; its own colors are taken for hands"),
        "flicker": (FLICKER, "part of the masks changes its label where the image does not change"),
    }
    findings = [
        finding(
            name.replace("_", " "),
            "warning",
            f"camera {camera}",
            f"{facts[name]:.2f} {text}",
            f"at most {most:g} is expected",
            REMEDY,
        )
        for name, (most, text) in rules.items()
        if facts[name] > most
    ]
    return facts, findings


def flicker(capture: Capture, camera: str, labels: np.ndarray, frames: np.ndarray) -> float:
    """Pixels that change their label and not their color from one frame to the next, as part of object and hands."""
    flips = total = 0
    for index in np.unique(np.linspace(0, len(frames) - 2, PAIRS).astype(int)):
        here, there = frames[index], frames[index + 1]
        gray = [cv2.cvtColor(np.ascontiguousarray(capture.colour(camera, int(k))), cv2.COLOR_RGB2GRAY) for k in (here, there)]
        still = cv2.blur(cv2.absdiff(*gray), (5, 5)) < STILL
        flips += int((still & (labels[here] != labels[there])).sum())
        total += int((labels[here] > 0).sum())
    return flips / max(total, 1)


def _rim(mask: np.ndarray) -> float:
    """Part of the image's border that a mask [H, W] covers."""
    edges = np.concatenate([mask[0], mask[-1], mask[1:-1, 0], mask[1:-1, -1]])
    return float(edges.mean())


def _jumps(areas: np.ndarray, pixels: int) -> float:
    """Part of the frames whose area is another than that of the frame before."""
    logs = np.log(areas + 1e-4 * pixels)
    return float((np.abs(np.diff(logs)) > JUMP).mean()) if len(logs) > 1 else 0.0


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
