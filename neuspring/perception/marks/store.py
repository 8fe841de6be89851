"""Masks of a capture on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neuspring.data.capture import Capture
from neuspring.perception.marks.carry import Images


def film_of(capture: Capture, camera: str) -> Images:
    """The frames that a camera has, in their order (missing ones left out), as `carry` takes them."""
    raise NotImplementedError


def save_masks(capture: Capture, camera: str, labels: np.ndarray) -> Path:
    """Write mask/<camera>/<frame>.png of labels [T, H, W] uint8, and `masks: true` once every camera has masks.

    Frames that the camera lacks are skipped. Returns the folder. Raises InputError where the shape or a label is wrong.
    """
    raise NotImplementedError
