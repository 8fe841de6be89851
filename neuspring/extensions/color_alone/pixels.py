"""Operations on masks [H, W] bool that all of this package needs."""

from __future__ import annotations

import cv2
import numpy as np


def away_from(mask: np.ndarray) -> np.ndarray:
    """Distance of each pixel [H, W] from the nearest one of a mask, pixels."""
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)


def core_of(mask: np.ndarray, least: float = 0.0) -> np.ndarray:
    """The mask without its border; all of it where no more than the part `least` is left: a thin rope has no core."""
    core = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    return core if core.sum() > least * mask.sum() or not least else mask


def disc(radius: int) -> np.ndarray:
    """A disc [2 radius + 1, 2 radius + 1] to dilate with."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)


def pixels_of(mask: np.ndarray) -> np.ndarray:
    """Pixels (x, y) [n, 2] of a mask, row by row."""
    y, x = np.nonzero(mask)
    return np.stack([x, y], axis=1)
