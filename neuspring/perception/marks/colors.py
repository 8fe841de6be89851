"""Densities of the colors of nothing, object and hands: blurred histograms in Lab."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

BINS = (32, 64, 64)
"""Bins of L, a and b, each of which has 256 values."""
VOLUME = float(np.prod([256 / count for count in BINS]))
"""Values of (L, a, b) in a bin."""
BLUR = (1.5, 1.0, 1.0)
"""Width of the blur, bins: a color stands for its neighbors, and for a little more or less light."""
UNSEEN = 0.02
"""Part of the probability that any color has, seen or not. It is spread evenly over the colors of SPREAD values."""
SPREAD = 256.0 * 80.0 * 80.0


def lab_of(image: np.ndarray) -> np.ndarray:
    """Lab [H, W, 3] uint8 of RGB."""
    return cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2LAB)


def bins_of(lab: np.ndarray) -> np.ndarray:
    """The bin of every pixel [H, W]."""
    first, second, third = (lab[..., axis].astype(np.int32) * count // 256 for axis, count in enumerate(BINS))
    return np.asarray((first * BINS[1] + second) * BINS[2] + third)


@dataclass(frozen=True, eq=False)
class Colors:
    """Counts of colors, and their log density per unit of (L, a, b)."""

    counts: np.ndarray
    """[bins]."""
    logs: np.ndarray
    """[bins]."""

    @classmethod
    def of(cls, counts: np.ndarray) -> Colors:
        """From counts [bins]."""
        blurred = gaussian_filter(counts.reshape(BINS), BLUR, mode="nearest", truncate=2.5).ravel()
        share = blurred / max(float(blurred.sum()), 1e-9)
        return cls(counts, np.log((1 - UNSEEN) * share / VOLUME + UNSEEN / SPREAD).astype(np.float32))


def count(bins: np.ndarray, where: np.ndarray) -> np.ndarray:
    """How often each color is seen [bins] where a mask [H, W] is true."""
    return np.bincount(bins[where], minlength=int(np.prod(BINS))).astype(float)


def mixed(parts: list[tuple[float, np.ndarray]]) -> np.ndarray:
    """Counts with given weights, each part first scaled to a sum of 1; parts without counts are left out."""
    total = np.zeros_like(parts[0][1])
    for weight, counts in parts:
        if counts.sum() > 0:
            total += weight * counts / counts.sum()
    return total
