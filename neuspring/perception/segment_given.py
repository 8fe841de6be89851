"""Masks that the capture brings itself."""

from __future__ import annotations

import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.capture import CAPTURE, Capture
from neuspring.data.frames import frames_of


def require(capture: Capture) -> None:
    """Raise InputError if the capture has no masks."""
    if not capture.description.masks:
        rule = "perception.segment.backend: given needs masks of every camera"
        folder = capture.folder
        remedy = f"Draw some: `neuspring annotate {folder}`, or choose another backend: marks, opencv or grounded_sam2."
        raise InputError(folder / CAPTURE, rule, "masks: false", remedy)


def segment(capture: Capture, camera: str) -> np.ndarray:
    """Labels [T, H, W] of the folder mask/, 0 in frames that the camera lacks. Raises InputError if there are no masks."""
    require(capture)
    view = capture.cameras[camera]
    labels = np.zeros((capture.frame_count, view.height, view.width), dtype=np.uint8)
    for frame in frames_of(capture, camera):
        labels[frame] = capture.mask(camera, frame)
    return labels
