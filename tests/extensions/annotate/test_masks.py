"""Marks of the page become masks by `neuspring.perception.marks`, at the frames where they were drawn."""

import json

import cv2
import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.extensions.annotate.masks import MasksMode
from neuspring.perception.masks import MasksFile
from tests.support.moving import CORNER, FRAMES, SHIFT, SIDE, moving

MISSING = (1, 2)


@pytest.fixture
def capture(tmp_path) -> Capture:
    return moving(tmp_path, missing=MISSING, tint=(1.0, 0.6, 0.2))


def box(frame: int, label: str = "object", **changes) -> dict:
    """A box around the square."""
    corner = CORNER + frame * SHIFT
    points = [(corner - 2).tolist(), (corner + SIDE + 1).tolist()]
    return {"frame": frame, "label": label, "kind": "box", "points": points} | changes


def marks(*own, camera: str = "0") -> dict:
    return {"format": 1, "cameras": {camera: list(own)}}


def square(frame: int) -> np.ndarray:
    x, y = np.meshgrid(np.arange(128), np.arange(96))
    left, top = CORNER + frame * SHIFT
    return (x >= left) & (x <= left + SIDE - 1) & (y >= top) & (y <= top + SIDE - 1)


def overlap(one, other) -> float:
    return (one & other).sum() / (one | other).sum()


def page_of(capture: Capture) -> MasksMode:
    return MasksMode(capture)


def test_a_preview_is_of_the_frame_that_was_marked_also_after_missing_frames(capture):
    page = page_of(capture)
    page.write("none", marks(box(6), box(9)))
    labels = page.preview("0", 6)
    assert overlap(labels == 1, square(6)) > 0.85
    assert overlap(labels == 1, square(9)) < 0.8


def test_masks_are_saved_with_what_they_were_made_from_and_found_again(capture):
    page = page_of(capture)
    page.write("none", marks(box(0)))
    page.carry(["0"])
    page.job.join()
    assert page.job.plain()["state"] == "done", page.job.plain()
    assert page.save() == ["0"]
    assert (capture.folder / "mask_0.png").exists()
    assert len(page_of(capture).plain()["saved"]["0"]) == FRAMES
    assert MasksFile.of(capture).cameras["0"].backend == "marks"
    assert not capture.path("mask", "0", MISSING[0]).exists()
    assert overlap(capture.mask("0", 5) == 1, square(5)) > 0.85
    assert not json.loads((capture.folder / "capture.json").read_text())["masks"]  # camera "covered" has none


def test_a_camera_without_frame_0_has_masks_too(tmp_path):
    capture = moving(tmp_path / "late", missing=(0,), tint=(1.0, 0.6, 0.2))
    page = page_of(capture)
    assert page.saved_cameras() == []
    capture.path("mask", "0", 3).parent.mkdir(parents=True)
    cv2.imwrite(str(capture.path("mask", "0", 3)), np.zeros((96, 128), np.uint8))
    assert page.saved_cameras() == ["0"]


def test_bad_marks_are_refused(capture):
    """All that a file may not say either is tested beside it: marks/test_marks.py."""
    for values, message in ((None, "a JSON object is required"), (marks(box(0), camera="7"), "cameras.7: the capture must have")):
        with pytest.raises(InputError, match=message):
            page_of(capture).write("none", values)
