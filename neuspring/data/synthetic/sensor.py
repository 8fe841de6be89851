"""A depth camera's flaws: noise that grows with distance and is alike in neighboring pixels, dropouts at edges and on grazing
surfaces, holes, quantization."""

from __future__ import annotations

import cv2
import numpy as np

NOISE_NEAR, NOISE_FAR = 0.0008, 0.0019
"""Standard deviation of depth, m: near + far (z - 0.4)^2, z in m (the form of Nguyen et al. 2012 for structured light)."""
CORRELATION = 1.2
"""Width of the noise's grain, pixels."""
EDGE_STEP = 0.02
"""Neighboring pixels that differ by more, m, make an edge."""
EDGE_LOSS = 0.6
"""Share of pixels at an edge without depth."""
GRAZING = 0.18
"""Cosine between normal and ray below which depth is lost."""
HOLES = 0.004
"""Share of the image in holes anywhere."""
HOLE_SIZE = 2.5
"""Width of holes, pixels."""


def measured(depth: np.ndarray, slope: np.ndarray, unit: float, rng: np.random.Generator) -> np.ndarray:
    """Depth [H, W] as a sensor gives it: uint16 in units of `unit` m, 0 where it gives nothing.

    `depth` is the truth, m, 0 where nothing is; `slope` the cosine between surface and ray.
    """
    grain = cv2.GaussianBlur(rng.normal(size=depth.shape), (0, 0), CORRELATION)
    noise = grain / grain.std() * (NOISE_NEAR + NOISE_FAR * (depth - 0.4) ** 2)
    near, far = (operation(depth.astype(np.float32), np.ones((3, 3))) for operation in (cv2.erode, cv2.dilate))
    lost = (far - near > EDGE_STEP) & (rng.random(depth.shape) < EDGE_LOSS)
    lost |= slope < GRAZING
    blobs = cv2.GaussianBlur(rng.normal(size=depth.shape), (0, 0), HOLE_SIZE)
    lost |= blobs > np.quantile(blobs, 1.0 - HOLES)
    return quantized(np.where(lost | (depth <= 0), 0.0, depth + noise), unit)


def quantized(depth: np.ndarray, unit: float) -> np.ndarray:
    """Depth, m, as uint16 in units of `unit` m."""
    return np.clip(np.round(depth / unit), 0, np.iinfo(np.uint16).max).astype(np.uint16)
