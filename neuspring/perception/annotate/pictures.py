"""Images as the page gets them: a frame as JPEG, labels as colors that lie over it."""

from __future__ import annotations

import cv2
import numpy as np

from neuspring.data.capture import HANDS, OBJECT

COLORS = {OBJECT: (0, 200, 160), HANDS: (255, 140, 0)}
"""RGB of a label; the legend of the page has the same."""
INSIDE, BORDER = 90, 255
"""Opacity inside a mask and on its border, of 255."""
QUALITY = 95


def frame_jpeg(color: np.ndarray) -> bytes:
    """RGB [H, W, 3] uint8 as JPEG."""
    return cv2.imencode(".jpg", np.ascontiguousarray(color[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()


def overlay_png(labels: np.ndarray) -> bytes:
    """Labels [H, W] as colors with opacity, PNG: strong on borders, weak inside."""
    picture = np.zeros((*labels.shape, 4), np.uint8)
    for label, (red, green, blue) in COLORS.items():
        own = (labels == label).astype(np.uint8)
        core = cv2.erode(own, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=1)
        picture[own > 0] = (blue, green, red, BORDER)
        picture[core > 0] = (blue, green, red, INSIDE)
    return cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
