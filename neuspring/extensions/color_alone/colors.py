"""Evidence of colors: densities of nothing, object and hands as blurred histograms in Lab, and the background of a camera that
stands still, with the usual color of every pixel and the depth behind what moves.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from neuspring.extensions.color_alone.pixels import disc
from neuspring.perception.segment_opencv import bins_of as opencv_bins

LAB_BINS = (32, 64, 64)
"""Bins of L, a and b, each of which has 256 values."""
BIN_VOLUME = float(np.prod([256 / count for count in LAB_BINS]))
"""Values of (L, a, b) in a bin."""
BLUR = (1.5, 1.0, 1.0)
"""Width of the blur, bins: a color stands for its neighbors, and for a little more or less light."""
UNSEEN = 0.02
"""Part of the probability that any color has, seen or not. It is spread evenly over the colors of COLOR_SPREAD values."""
COLOR_SPREAD = 256.0 * 80.0 * 80.0
LEAST_SPREAD = np.array([4.0, 2.5, 2.5], np.float32)
"""Smallest standard deviation of L, a and b: noise of sensor and compression."""
SHADOW, SHADOW_TINTED = 0.22, 0.08
"""Probabilities that a pixel of the background lies in a shadow, and in a shadow that has the color of what throws it."""
SHADE, TINTED = 35.0, 2.0
"""Darkening by a shadow in the mean, L, and by how much more a and b vary in a tinted one."""
NEVER_SHADE = -50.0
FORGET = 0.05
"""Smallest weight of a new frame in the running mean."""
USUAL = 0.9
"""Probability that a background pixel has its usual color."""
SURE_AFTER = 3.0
"""Looks after which the usual color of a pixel is known."""
DIFFERENT = 30
"""Difference of L, a or b from which a pixel may show something that came in."""
LEAST_KNOWN = 500
"""Pixels of known background from which a change of the light is measured."""
DEPTH_NOISE = (0.003, 0.008)
"""Spread of depth: m, and per m."""
IN_FRONT = 0.5
"""Distance of things in front of the background, m; anywhere up to there."""
MOST_DEPTH = 3.0
"""Largest log ratio that a pixel's depth counts; depth is off by pixels at borders."""


def bins_of(lab: np.ndarray) -> np.ndarray:
    """The bin of every pixel [H, W]."""
    return opencv_bins(lab, LAB_BINS)


def log_density(counts: np.ndarray) -> np.ndarray:
    """Log density of colors per unit of (L, a, b) [bins], from counts [bins]."""
    blurred = gaussian_filter(counts.reshape(LAB_BINS), BLUR, mode="nearest", truncate=2.5).ravel()
    share = blurred / max(float(blurred.sum()), 1e-9)
    return np.asarray(np.log((1 - UNSEEN) * share / BIN_VOLUME + UNSEEN / COLOR_SPREAD), dtype=np.float32)


def count(seen: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Counts of each color [bins] where a mask [H, W] is true; `seen` [H, W] are the bins of pixels."""
    return np.bincount(seen[where], minlength=int(np.prod(LAB_BINS))).astype(float)


def mixed(parts: list[tuple[float, np.ndarray]]) -> np.ndarray:
    """Counts with given weights, each part first scaled to a sum of 1; parts without counts are left out."""
    total = np.zeros_like(parts[0][1])
    for weight, counts in parts:
        if counts.sum() > 0:
            total += weight * counts / counts.sum()
    return total


@dataclass(eq=False)
class Background:
    """Running mean and variance of Lab per pixel, over the frames in which the pixel showed the background."""

    mean: np.ndarray
    """[H, W, 3] float32."""
    variance: np.ndarray
    """[H, W, 3] float32."""
    seen: np.ndarray
    """[H, W] float32, how often."""
    depth: np.ndarray
    """[H, W] float32, m, running mean; 0 where never measured."""

    @classmethod
    def empty(cls, size: tuple[int, int]) -> Background:
        """Nothing is known."""
        color = (*size, 3)
        mean, variance, seen, depth = (np.zeros(shape, np.float32) for shape in (color, color, size, size))
        return cls(mean, variance, seen, depth)

    def part(self, window: tuple[slice, slice]) -> Background:
        """A window of it, without a copy."""
        return Background(self.mean[window], self.variance[window], self.seen[window], self.depth[window])

    def learn(self, lab: np.ndarray, where: np.ndarray, depth: np.ndarray | None = None) -> None:
        """Take a frame's pixels [H, W, 3] where it shows the background [H, W] bool, and their depth [H, W], m, 0 none."""
        self.seen += where
        weight = np.where(where, np.maximum(1.0 / np.maximum(self.seen, 1.0), FORGET), 0.0).astype(np.float32)[..., None]
        step = lab.astype(np.float32) - self.mean
        # A first look has no spread; its step is the color itself.
        first = where & (self.seen <= 1)
        self.mean += weight * step
        self.variance = (1 - weight) * (self.variance + weight * step**2)
        self.variance[first] = 0.0
        if depth is not None:
            measured = where & (depth > 0)
            new = measured & (self.depth == 0)
            self.depth[measured] += 0.2 * (depth[measured] - self.depth[measured])
            self.depth[new] = depth[new]

    def explain(self, logs: np.ndarray, lab: np.ndarray, gain: np.ndarray) -> np.ndarray:
        """Log densities [H, W] of the background: from `logs`, those of its colors anywhere, and the usual color of each pixel."""
        known = np.clip(self.seen / SURE_AFTER, 0, 1) * USUAL
        # Of the background or a shadow on it, per unit of (L, a, b); meaningless where `seen` is 0.
        usual = shaded_density(lab.astype(np.float32) - self.mean - gain, np.sqrt(self.variance + LEAST_SPREAD**2))
        mixture = np.logaddexp(np.log(known + 1e-9) + usual, np.log(1 - known) + logs)
        return np.asarray(np.where(known > 0, mixture, logs), dtype=np.float32)

    def gain(self, lab: np.ndarray, where: np.ndarray) -> np.ndarray:
        """By how much the frame is lighter [3], from pixels `where` [H, W] it shows the background; 0 where few are known."""
        sparse = (slice(None, None, 3), slice(None, None, 3))
        known = where[sparse] & (self.seen[sparse] > 0)
        if known.sum() < LEAST_KNOWN:
            return np.zeros(3, np.float32)
        return np.asarray(np.median(lab[sparse][known].astype(np.float32) - self.mean[sparse][known], axis=0), dtype=np.float32)

    def changed(self, lab: np.ndarray) -> np.ndarray:
        """Pixels at which a frame differs plainly from the known background [H, W] bool."""
        difference = cv2.absdiff(np.ascontiguousarray(lab), self.mean.astype(np.uint8)).max(axis=-1)
        return np.asarray((difference > DIFFERENT) & (self.seen > 0))

    def depth_log_ratio(self, depth: np.ndarray) -> np.ndarray:
        """Log ratio [H, W] of a depth, m, as that of the background, to one of something in front of it; 0 where not known."""
        least, share = DEPTH_NOISE
        spread = least + share * self.depth
        same = -0.5 * ((depth - self.depth) / spread) ** 2 - np.log(np.sqrt(2 * np.pi) * spread)
        ratio = np.clip(same + np.log(IN_FRONT), -MOST_DEPTH, MOST_DEPTH)
        return np.where((depth > 0) & (self.depth > 0), ratio, 0.0).astype(np.float32)


def shaded_density(step: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Log density [H, W] per unit of (L, a, b) of colors that differ by `step` [H, W, 3] from a usual color of this spread.

    A mixture of three: normal; a shadow, darker by d in L, of density exp(-d / s) / s, a and b as usual; and a shadow that has the
    color of what throws it, a and b TINTED times as wide.
    """
    near = step / spread
    hue = 0.5 * (near[..., 1] ** 2 + near[..., 2] ** 2)
    area = np.log(2 * np.pi * spread[..., 1] * spread[..., 2])
    lit = np.log(1 - SHADOW - SHADOW_TINTED) - 0.5 * near[..., 0] ** 2 - np.log(np.sqrt(2 * np.pi) * spread[..., 0]) - hue
    darker = np.where(step[..., 0] < 0, step[..., 0] / SHADE - np.log(SHADE), NEVER_SHADE)
    shaded = np.logaddexp(np.log(SHADOW) - hue, np.log(SHADOW_TINTED) - hue / TINTED**2 - 2 * np.log(TINTED))
    return np.asarray(np.logaddexp(lit, darker + shaded) - area, dtype=np.float32)


def apart(labels: np.ndarray, distance: int) -> np.ndarray:
    """Pixels of a mask [H, W] without a label within `distance` pixels."""
    return np.asarray(cv2.dilate((labels > 0).astype(np.uint8), disc(distance)) == 0)
