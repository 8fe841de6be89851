"""The background of a camera that stands still: the usual color of every pixel, and the depth behind what moves."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

LEAST_SPREAD = np.array([4.0, 2.5, 2.5], np.float32)
"""Smallest standard deviation of L, a and b: noise of sensor and compression."""
SHADOW = 0.3
"""Probability that a pixel of the background lies in a shadow: darker by up to DARKEST, of almost the same hue."""
DARKEST = 90.0
TINTED = 2.0
"""How much more a and b vary in a shadow: the object throws its color there."""
FORGET = 0.05
"""Smallest weight of a new frame in the running mean."""


@dataclass(eq=False)
class Background:
    """Running mean and variance of Lab per pixel, over the frames in which the pixel showed the background."""

    mean: np.ndarray
    """[H, W, 3] float32."""
    variance: np.ndarray
    """[H, W, 3] float32."""
    seen: np.ndarray
    """[H, W] float32, how often."""

    @classmethod
    def empty(cls, size: tuple[int, int]) -> Background:
        """Nothing is known."""
        return cls(np.zeros((*size, 3), np.float32), np.zeros((*size, 3), np.float32), np.zeros(size, np.float32))

    def learn(self, lab: np.ndarray, where: np.ndarray) -> None:
        """Take a frame's pixels [H, W, 3] where it shows the background [H, W] bool."""
        self.seen += where
        weight = np.where(where, np.maximum(1.0 / np.maximum(self.seen, 1.0), FORGET), 0.0).astype(np.float32)[..., None]
        step = lab.astype(np.float32) - self.mean
        # A first look has no spread; its step is the color itself.
        first = (self.seen <= 1)[..., None]
        self.mean += weight * step
        self.variance = np.where(first, 0.0, (1 - weight) * (self.variance + weight * step**2)).astype(np.float32)

    def log_density(self, lab: np.ndarray, gain: np.ndarray) -> np.ndarray:
        """Log density [H, W] per unit of (L, a, b) of a frame's colors, if the pixel shows the background or a shadow on it.

        `gain` [3] is what the whole image has become lighter by. Meaningless where `seen` is 0.
        """
        step = lab.astype(np.float32) - self.mean - gain
        spread = np.sqrt(self.variance + LEAST_SPREAD**2)
        return shaded_density(step, spread)

    def gain(self, lab: np.ndarray, where: np.ndarray) -> np.ndarray:
        """By how much the frame is lighter [3], from pixels `where` [H, W] it shows the background; 0 where few are known."""
        known = where & (self.seen > 0)
        if known.sum() < 500:
            return np.zeros(3, np.float32)
        return np.asarray(np.median(lab[known].astype(np.float32) - self.mean[known], axis=0), dtype=np.float32)


def apart(labels: np.ndarray, distance: int) -> np.ndarray:
    """Where a mask [H, W] has no label within `distance` pixels."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * distance + 1,) * 2)
    return cv2.dilate((labels > 0).astype(np.uint8), kernel) == 0


def shaded_density(step: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Log density [H, W] per unit of (L, a, b) of colors that differ by `step` [H, W, 3] from a usual color of this spread.

    Normal, or with SHADOW a shadow: L is darker by anything up to DARKEST, a and b are as usual.
    """
    near = step / spread
    hue = 0.5 * (near[..., 1] ** 2 + near[..., 2] ** 2)
    area = np.log(2 * np.pi * spread[..., 1] * spread[..., 2])
    lit = -0.5 * near[..., 0] ** 2 - np.log(np.sqrt(2 * np.pi) * spread[..., 0]) - hue - area
    shaded = -np.log(DARKEST) - hue / TINTED**2 - area - 2 * np.log(TINTED)
    darker = (step[..., 0] < 0) & (step[..., 0] > -DARKEST)
    shaded = np.where(darker, shaded, -50.0)
    return np.asarray(np.logaddexp(np.log(1 - SHADOW) + lit, np.log(SHADOW) + shaded), dtype=np.float32)
