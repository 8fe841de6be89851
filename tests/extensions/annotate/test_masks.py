"""Marks of the page become masks by `neuspring.perception.marks`, at the frames where they were drawn."""

import cv2
import numpy as np
import pytest

from neuspring.extensions.annotate.masks import MasksMode
from tests.support.moving import CORNER, SHIFT, SIDE, moving

MISSING = (1, 2)


@pytest.fixture
def capture(tmp_path):
    return moving(tmp_path, missing=MISSING, tint=(1.0, 0.6, 0.2))


def box(frame, label="object", **changes):
    """A box around the square."""
    corner = CORNER + frame * SHIFT
    points = [(corner - 2).tolist(), (corner + SIDE + 1).tolist()]
    return {"frame": frame, "label": label, "kind": "box", "points": points} | changes


def marks(*own, camera="0"):
    return {"format": 1, "cameras": {camera: list(own)}}


def square(frame):
    x, y = np.meshgrid(np.arange(128), np.arange(96))
    left, top = CORNER + frame * SHIFT
    return (x >= left) & (x <= left + SIDE - 1) & (y >= top) & (y <= top + SIDE - 1)


def overlap(one, other):
    return (one & other).sum() / (one | other).sum()


def page_of(capture):
    return MasksMode(capture)


def test_a_preview_is_of_the_frame_that_was_marked_also_after_missing_frames(capture):
    page = page_of(capture)
    page.write("none", marks(box(6), box(9)))
    labels = page.preview("0", 6)
    assert overlap(labels == 1, square(6)) > 0.85
    assert overlap(labels == 1, square(9)) < 0.8


def test_a_camera_without_frame_0_has_masks_too(tmp_path):
    capture = moving(tmp_path / "late", missing=(0,), tint=(1.0, 0.6, 0.2))
    page = page_of(capture)
    assert page.saved_cameras() == []
    capture.path("mask", "0", 3).parent.mkdir(parents=True)
    cv2.imwrite(str(capture.path("mask", "0", 3)), np.zeros((96, 128), np.uint8))
    assert page.saved_cameras() == ["0"]
