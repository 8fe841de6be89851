"""Marks carried through real films, where they are: no image of them belongs to the repository."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from neuspring.config.perception import MarksSegmentation
from neuspring.data.capture import HANDS, OBJECT
from neuspring.perception.marks.carry import carry, frame_mask
from neuspring.perception.marks.marks import Marks
from tests.support.marked import Painted, overlap
from tests.support.real import FOOTAGE, PLUSH

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
CASES = sorted(LEAST)


def film(case: str, count: int) -> Painted:
    """The first frames of the film in the left half of a video."""
    video = cv2.VideoCapture(str(FOOTAGE / "videos" / f"combine_tracking__{case}.mp4"))
    frames = [np.ascontiguousarray(video.read()[1][:, :848, ::-1]) for _ in range(count)]
    return Painted(frames, np.zeros((count, *frames[0].shape[:2]), np.uint8))


@pytest.mark.parametrize("path", sorted(MARKS.rglob("*.json")), ids=lambda path: path.stem)
def test_committed_marks_are_valid_and_few(path):
    marks = Marks.load(path).of("0")
    assert any(mark.label == "object" for mark in marks)
    assert sum(mark.frame == 0 for mark in marks) <= 5


@pytest.mark.skipif(not FOOTAGE.is_dir(), reason="the footage is not part of the repository")
@pytest.mark.parametrize("case", CASES)
def test_frame_0_of_the_footage(case):
    truth = cv2.imread(str(FOOTAGE / "masks" / case / "0000.png"), cv2.IMREAD_UNCHANGED)
    labels = frame_mask(film(case, 1), 0, Marks.load(MARKS / "phystwin_camera0" / f"{case}.json").of("0"), MarksSegmentation())
    assert overlap(labels, truth, OBJECT) > LEAST[case]
    assert overlap(labels, truth, HANDS) > 0.88


@pytest.mark.skipif(not PLUSH.is_dir(), reason="the recording is not part of the repository")
def test_the_plush_recording_is_carried_for_a_few_frames():
    frames = [np.ascontiguousarray(cv2.imread(str(PLUSH / "color" / f"{250 + k:06d}.png"))[..., ::-1]) for k in range(4)]
    truth = [cv2.imread(str(PLUSH / "masks_250_335" / f"{k:05d}.png"), cv2.IMREAD_UNCHANGED) for k in range(4)]
    marks = [mark for mark in Marks.load(MARKS / "rgbd_plush.json").of("0") if mark.frame == 90]
    carried = carry(Painted(frames, np.stack(truth)), [replace(mark, frame=0) for mark in marks], MarksSegmentation())
    assert overlap(carried.labels[3], truth[3], OBJECT) > 0.85
