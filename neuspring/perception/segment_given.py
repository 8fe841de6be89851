"""Segmentation by masks that the capture contains."""

from __future__ import annotations

import numpy as np

from neuspring.data.capture import Capture
from neuspring.data.frames import frames_of


def segment(capture: Capture, camera: str) -> np.ndarray:
    """Labels [T, H, W] of the folder mask/; 0 in missing frames."""
    view = capture.cameras[camera]
    labels = np.zeros((capture.frame_count, view.height, view.width), dtype=np.uint8)
    for frame in frames_of(capture, camera):
        labels[frame] = capture.mask(camera, frame)
    return labels
