"""How far the labels of each frame are doubted."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from neuspring.data.capture import HANDS, OBJECT
from neuspring.perception.marks.step import Step

AROUND = 4
"""Frames before and after with whose median an area is compared."""
WHOLE = {"disagreement": 0.35, "flow": 0.8, "misfit": 0.5, "unsure": 0.5, "jump": 0.5}
"""Value of each cue that makes a doubt of 63 %."""
MISFIT = 2.0
"""Log ratio from which a color contradicts its label."""


@dataclass(frozen=True)
class Cues:
    """What speaks against one frame's labels, each 0 or more."""

    disagreement: float = 0.0
    """1 - IoU with the other direction or, outside of two marked frames, with the first pass; object or hands, the larger one."""
    flow: float = 0.0
    """Mean doubt of the flow on object and hands."""
    misfit: float = 0.0
    """Part of object and hands whose colors contradict their label."""
    unsure: float = 0.0
    """Mean of 2 (1 - p) over the pixels at the border of object and hands."""

    @classmethod
    def of(cls, step: Step, other: np.ndarray) -> Cues:
        """Of a frame, and of the labels [h, w] that it was given otherwise."""
        labels = step.probability.argmax(axis=0)
        shown = labels > 0
        apart = [1 - _overlap(labels == label, other == label) for label in (OBJECT, HANDS)]
        if not shown.any():
            return cls(disagreement=max(apart))
        inner = cv2.erode(shown.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        rim = shown & ~inner
        misfit = float((step.misfit[shown] > MISFIT).mean())
        unsure = float(2 * (1 - step.probability.max(axis=0)[rim]).mean()) if rim.any() else 0.0
        return cls(max(apart), float(step.flow_doubt[shown].mean()), misfit, unsure)


def doubt_of(labels: np.ndarray, cues: list[Cues]) -> np.ndarray:
    """Doubt [T], 0 to 1: 1 - exp(-sum of cues), each against its scale; the jump of areas is the last one."""
    names = ("disagreement", "flow", "misfit", "unsure")
    total = np.array([sum((getattr(cue, name) / WHOLE[name]) ** 2 for name in names) for cue in cues])
    for label in (OBJECT, HANDS):
        areas = (labels == label).sum(axis=(1, 2)).astype(float)
        total += (area_jumps(areas) / WHOLE["jump"]) ** 2
    return np.asarray(1 - np.exp(-total))


def area_jumps(areas: np.ndarray) -> np.ndarray:
    """|log(area / median of the frames around)| [T], with 1 % of the film's largest area added to both."""
    floor = 0.01 * max(float(areas.max(initial=0.0)), 100.0)
    logs = np.log(areas + floor)
    usual = [np.median(logs[max(frame - AROUND, 0) : frame + AROUND + 1]) for frame in range(len(logs))]
    return np.asarray(np.abs(logs - usual))


def _overlap(one: np.ndarray, other: np.ndarray) -> float:
    union = int((one | other).sum())
    return float((one & other).sum() / union) if union else 1.0
