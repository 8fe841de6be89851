"""Frames of one camera, and masks as pixels: what several steps of perception need."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from neuspring.core.files import write_atomically
from neuspring.data.capture import Capture

T = TypeVar("T")


def frames_of(capture: Capture, camera: str) -> list[int]:
    """The frames that a camera has."""
    return [frame for frame in range(capture.frame_count) if capture.has(camera, frame)]


def spread(values: Sequence[T], count: int) -> list[T]:
    """At most `count` of the values, evenly spread from the first to the last."""
    return [values[index] for index in np.unique(np.linspace(0, len(values) - 1, count).astype(int))]


def gray(capture: Capture, camera: str, frame: int) -> np.ndarray:
    """The gray image [H, W] uint8."""
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(capture.color(camera, frame)), cv2.COLOR_RGB2GRAY))


def heights(capture: Capture, camera: str, depth: np.ndarray) -> np.ndarray:
    """Height [H, W], m, above the table z = 0 of what an image of depth [H, W], m, shows; NaN where nothing was measured."""
    view = capture.cameras[camera]
    pixels = np.stack(np.meshgrid(np.arange(view.width), np.arange(view.height)), axis=-1).astype(float)
    return np.where(depth > 0, capture.description.up_sign * view.lift(pixels, depth)[..., 2], np.nan)


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two masks [...] bool; NaN if both are empty."""
    union = int((one | other).sum())
    return float((one & other).sum() / union) if union else float("nan")


def write_png(path: Path, image: np.ndarray) -> Path:
    """Write an RGB image [H, W, 3], or a mask [H, W], uint8, whole or not at all; a link is replaced, not followed."""
    ok, png = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1] if image.ndim == 3 else image))
    assert ok, "an image can be encoded"
    write_atomically(path, lambda temporary: temporary.write_bytes(png.tobytes()))
    return path
