"""Evidence of colors: densities of nothing, object and hands as blurred Lab histograms, and the background of a static camera,
with the usual color and depth of each pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from neuspring.extensions.color_alone.pixels import disc
from neuspring.perception.segment_opencv import bins_of as opencv_bins

LAB_BINS = (32, 64, 64)
"""Numbers of bins of L, a and b, for 256 values each."""
BIN_VOLUME = float(np.prod([256 / count for count in LAB_BINS]))
"""Number of values of (L, a, b) in a bin."""
BLUR = (1.5, 1.0, 1.0)
"""Width of the blur, bins: a color supports its neighbors, and slightly different brightness."""
UNSEEN = 0.02
"""Probability that is spread uniformly over all colors; COLOR_SPREAD is their number of values."""
COLOR_SPREAD = 256.0 * 80.0 * 80.0
LEAST_SPREAD = np.array([4.0, 2.5, 2.5], np.float32)
"""Smallest standard deviations of L, a and b: noise of sensor and compression."""
SHADOW, SHADOW_TINTED = 0.22, 0.08
"""Probabilities that a background pixel is in a shadow, and in a shadow tinted by the object."""
SHADE, TINTED = 35.0, 2.0
"""Mean darkening by a shadow, L, and factor on the spread of a and b in a tinted shadow."""
NEVER_SHADE = -50.0
FORGET = 0.05
"""Smallest weight of a new frame in the running mean."""
USUAL = 0.9
"""Probability that a background pixel shows its usual color."""
SURE_AFTER = 3.0
"""Observations after which the usual color of a pixel is known."""
DIFFERENT = 30
"""Difference of L, a or b from the background above which a pixel may show something new."""
LEAST_KNOWN = 500
"""Smallest number of known background pixels for an estimate of the brightness change."""
DEPTH_NOISE = (0.003, 0.008)
"""Standard deviation of depth: constant, m, and per meter."""
IN_FRONT = 0.5
"""Largest distance of objects in front of the background, m; uniform up to it."""
MOST_DEPTH = 3.0
"""Largest log ratio from the depth of a pixel, because depth is off by pixels at borders."""


def bins_of(lab: np.ndarray) -> np.ndarray:
    """Histogram bin of each Lab pixel [H, W]."""
    return opencv_bins(lab, LAB_BINS)


def log_density(counts: np.ndarray) -> np.ndarray:
    """Log density of colors per unit of (L, a, b) [bins], from counts [bins]."""
    blurred = gaussian_filter(counts.reshape(LAB_BINS), BLUR, mode="nearest", truncate=2.5).ravel()
    share = blurred / max(float(blurred.sum()), 1e-9)
    return np.asarray(np.log((1 - UNSEEN) * share / BIN_VOLUME + UNSEEN / COLOR_SPREAD), dtype=np.float32)


def count(seen: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Histogram [bins] of the pixels in a mask [H, W]; `seen` [H, W] are their bins."""
    return np.bincount(seen[where], minlength=int(np.prod(LAB_BINS))).astype(float)


def mixed(parts: list[tuple[float, np.ndarray]]) -> np.ndarray:
    """Weighted sum of histograms, each normalized to a sum of 1; empty ones are skipped."""
    total = np.zeros_like(parts[0][1])
    for weight, counts in parts:
        if counts.sum() > 0:
            total += weight * counts / counts.sum()
    return total


@dataclass(eq=False)
class Background:
    """Running mean and variance of Lab per pixel, over frames in which it shows the background."""

    mean: np.ndarray
    """[H, W, 3] float32."""
    variance: np.ndarray
    """[H, W, 3] float32."""
    seen: np.ndarray
    """[H, W] float32, number of observations."""
    depth: np.ndarray
    """[H, W] float32, m, running mean; 0 if never measured."""

    @classmethod
    def empty(cls, size: tuple[int, int]) -> Background:
        """A background without observations."""
        color = (*size, 3)
        mean, variance, seen, depth = (np.zeros(shape, np.float32) for shape in (color, color, size, size))
        return cls(mean, variance, seen, depth)

    def part(self, window: tuple[slice, slice]) -> Background:
        """A view of a window of the image, without a copy."""
        return Background(self.mean[window], self.variance[window], self.seen[window], self.depth[window])

    def learn(self, lab: np.ndarray, where: np.ndarray, depth: np.ndarray | None = None) -> None:
        """Update with the pixels [H, W, 3] of a frame where it shows the background [H, W] bool; depth [H, W], m, 0 none."""
        self.seen += where
        weight = np.where(where, np.maximum(1.0 / np.maximum(self.seen, 1.0), FORGET), 0.0).astype(np.float32)[..., None]
        step = lab.astype(np.float32) - self.mean
        # A first observation has no variance; its step is the color itself.
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
        """Log densities [H, W] of the background, from `logs`, those of its histogram, and the usual color of each pixel."""
        known = np.clip(self.seen / SURE_AFTER, 0, 1) * USUAL
        # Density of the background or a shadow on it, per unit of (L, a, b); undefined where `seen` is 0.
        usual = shaded_density(lab.astype(np.float32) - self.mean - gain, np.sqrt(self.variance + LEAST_SPREAD**2))
        mixture = np.logaddexp(np.log(known + 1e-9) + usual, np.log(1 - known) + logs)
        return np.asarray(np.where(known > 0, mixture, logs), dtype=np.float32)

    def gain(self, lab: np.ndarray, where: np.ndarray) -> np.ndarray:
        """Brightness change [3] of a frame, from its background pixels `where` [H, W]; 0 if few are known."""
        sparse = (slice(None, None, 3), slice(None, None, 3))
        known = where[sparse] & (self.seen[sparse] > 0)
        if known.sum() < LEAST_KNOWN:
            return np.zeros(3, np.float32)
        return np.asarray(np.median(lab[sparse][known].astype(np.float32) - self.mean[sparse][known], axis=0), dtype=np.float32)

    def changed(self, lab: np.ndarray) -> np.ndarray:
        """True for pixels [H, W] that differ clearly from the known background."""
        difference = cv2.absdiff(np.ascontiguousarray(lab), self.mean.astype(np.uint8)).max(axis=-1)
        return np.asarray((difference > DIFFERENT) & (self.seen > 0))

    def depth_log_ratio(self, depth: np.ndarray) -> np.ndarray:
        """Log ratio [H, W] of a depth, m, under the background and under an object in front of it; 0 if unknown."""
        least, share = DEPTH_NOISE
        spread = least + share * self.depth
        same = -0.5 * ((depth - self.depth) / spread) ** 2 - np.log(np.sqrt(2 * np.pi) * spread)
        ratio = np.clip(same + np.log(IN_FRONT), -MOST_DEPTH, MOST_DEPTH)
        return np.where((depth > 0) & (self.depth > 0), ratio, 0.0).astype(np.float32)


def shaded_density(step: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Log density [H, W], per unit of (L, a, b), of colors that differ by `step` [H, W, 3] from a usual color with this spread.

    A mixture of three components: a normal density; a shadow, darker by d in L with density exp(-d / s) / s, s = SHADE, and
    normal in a and b; and a tinted shadow, with TINTED times the spread of a and b.
    """
    near = step / spread
    hue = 0.5 * (near[..., 1] ** 2 + near[..., 2] ** 2)
    area = np.log(2 * np.pi * spread[..., 1] * spread[..., 2])
    lit = np.log(1 - SHADOW - SHADOW_TINTED) - 0.5 * near[..., 0] ** 2 - np.log(np.sqrt(2 * np.pi) * spread[..., 0]) - hue
    darker = np.where(step[..., 0] < 0, step[..., 0] / SHADE - np.log(SHADE), NEVER_SHADE)
    shaded = np.logaddexp(np.log(SHADOW) - hue, np.log(SHADOW_TINTED) - hue / TINTED**2 - 2 * np.log(TINTED))
    return np.asarray(np.logaddexp(lit, darker + shaded) - area, dtype=np.float32)


def apart(labels: np.ndarray, distance: int) -> np.ndarray:
    """True for pixels [H, W] without a label within `distance` pixels."""
    return np.asarray(cv2.dilate((labels > 0).astype(np.uint8), disc(distance)) == 0)
