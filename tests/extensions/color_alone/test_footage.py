"""Committed annotations and their masks on real video, if present: the numbers of perception/README.md, with a margin."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from neuspring.data.capture import HANDS, OBJECT
from neuspring.extensions.color_alone.segment import frame_mask
from neuspring.perception.marks import Marks
from tests.support.marked import Painted
from tests.support.marked import overlap as label_overlap
from tests.support.real import FOOTAGE

FILMED = pytest.mark.skipif(not FOOTAGE.is_dir(), reason="the footage is not part of the repository")


MARKS = Path(__file__).parents[2] / "data" / "marks"
LEAST = {
    "double_lift_cloth_1": 0.95,
    "double_lift_sloth": 0.85,
    "double_lift_zebra": 0.83,
    "single_lift_cloth_4": 0.93,
    "single_lift_rope": 0.78,
    "single_push_rope_4": 0.8,
}
"""Overlap of the object. Masks drawn by hand are right to 1 to 3 pixels: of thin things that is a large part."""


def beginning(case, count):
    """The first frames of the film in the left half of a video."""
    video = cv2.VideoCapture(str(FOOTAGE / "videos" / f"combine_tracking__{case}.mp4"))
    frames = [np.ascontiguousarray(video.read()[1][:, :848, ::-1]) for _ in range(count)]
    return Painted(frames, np.zeros((count, *frames[0].shape[:2]), np.uint8))


@pytest.mark.parametrize("path", sorted(MARKS.rglob("*.json")), ids=lambda path: path.stem)
def test_committed_marks_are_valid_and_few(path):
    marks = Marks.load(path).of("0")
    assert any(mark.label == "object" for mark in marks)
    assert sum(mark.frame == 0 for mark in marks) <= 5


@FILMED
@pytest.mark.parametrize("case", LEAST)
def test_frame_0_of_the_footage(case):
    truth = cv2.imread(str(FOOTAGE / "masks" / case / "0000.png"), cv2.IMREAD_UNCHANGED)
    labels = frame_mask(beginning(case, 1), 0, Marks.load(MARKS / "phystwin_camera0" / f"{case}.json").of("0"))
    assert label_overlap(labels, truth, OBJECT) > LEAST[case]
    assert label_overlap(labels, truth, HANDS) > 0.88
