"""Operations on masks [H, W] bool for this package."""

from __future__ import annotations

import cv2
import numpy as np


def away_from(mask: np.ndarray) -> np.ndarray:
    """Distance of each pixel [H, W] from the nearest mask pixel, pixels."""
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)


def core_of(mask: np.ndarray, least: float = 0.0) -> np.ndarray:
    """The mask without its border; the full mask if at most the fraction `least` remains, as for a thin rope."""
    core = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    return core if core.sum() > least * mask.sum() or not least else mask


def disc(radius: int) -> np.ndarray:
    """Disc-shaped kernel [2 radius + 1, 2 radius + 1]."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)


def pixels_of(mask: np.ndarray) -> np.ndarray:
    """Pixels (x, y) [n, 2] of a mask, row by row."""
    y, x = np.nonzero(mask)
    return np.stack([x, y], axis=1)
