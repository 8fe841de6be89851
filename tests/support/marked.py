"""A film in memory for marks: a textured square and a hand move over a still, uneven table; the truth is known."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from neuspring.data.capture import HANDS, OBJECT
from neuspring.perception.marks import Mark

SIZE = (72, 112)
"""Height, width."""


@dataclass(frozen=True, eq=False)
class Painted:
    """Frames that are drawn; implements `Images` without depth."""

    frames: list[np.ndarray]
    truth: np.ndarray
    """[T, H, W]."""

    @property
    def count(self):
        return len(self.frames)

    def color(self, frame, /):
        return self.frames[frame]

    def depth(self, frame, /):
        return None

    def height(self, frame, /):
        return None


def table(seed=0):
    """A table [H, W, 3], lit from the left and a little grained."""
    columns = np.indices(SIZE)[1]
    light = (200 - 0.3 * columns)[..., None] * np.array([1.0, 0.97, 0.92])
    return light + cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 6, (*SIZE, 3)), (0, 0), 1.0)


def painted(count=8, hand=True, step=3.0):
    """A square of 24 pixels, of blue and green, goes right; a hand comes down over its corner and goes up again."""
    rows, columns = np.indices(SIZE)
    # A grain of two pixels: flow follows it.
    pattern = cv2.GaussianBlur(np.random.default_rng(3).normal(0, 1, (40, 40)), (0, 0), 1.5)
    pattern = np.clip(0.5 + pattern / (4 * pattern.std()), 0, 1)
    frames, truth = [], np.zeros((count, *SIZE), np.uint8)
    for frame in range(count):
        image, left = table(), 20 + step * frame
        body = (columns >= left) & (columns < left + 24) & (rows >= 28) & (rows < 52)
        grain = pattern[np.clip(rows - 28, 0, 39), np.clip((columns - left).astype(int), 0, 39)]
        image[body] = (np.stack([30 + 20 * grain, 90 + 50 * grain, 170 - 60 * grain], axis=-1))[body]
        truth[frame][body] = OBJECT
        if hand:
            reach = 30 + 10 * np.sin(np.pi * frame / max(count - 1, 1))
            arm = (np.abs(columns - left - 18) < 6) & (rows < reach)
            image[arm] = np.array([190.0, 120.0, 95.0]) + 15 * grain[arm][:, None]
            truth[frame][arm] = HANDS
        noise = np.random.default_rng(frame).normal(0, 2, image.shape)
        frames.append(np.clip(image + noise, 0, 255).astype(np.uint8))
    return Painted(frames, truth)


def rope(count=6):
    """A red rope of three pixels, bent, goes down a pixel per frame."""
    frames, truth = [], np.zeros((count, *SIZE), np.uint8)
    along = np.linspace(0, 1, 60)
    for frame in range(count):
        points = np.stack([12 + 88 * along, 30 + frame + 8 * np.sin(3 * along)], axis=-1).round().astype(np.int32)[:, None]
        cv2.polylines(truth[frame], [points], False, OBJECT, 3)
        image = table()
        image[truth[frame] == OBJECT] = (170, 40, 50)
        frames.append(np.clip(image + np.random.default_rng(frame).normal(0, 2, image.shape), 0, 255).astype(np.uint8))
    return Painted(frames, truth)


def mark(label, kind, points, frame=0, radius=3.0):
    """A mark."""
    return Mark(frame=frame, label=label, kind=kind, points=tuple(points), radius=radius)


SQUARE = [
    mark("object", "polygon", [(20, 28), (43, 28), (43, 51), (20, 51)], radius=2.0),
    mark("hand", "scribble", [(38, 2), (38, 26)], radius=2.0),
]
"""Marks on frame 0 of `painted`."""


def overlap(labels, truth, label):
    """Intersection over union of one label."""
    own, true = labels == label, truth == label
    return float((own & true).sum() / max((own | true).sum(), 1))
