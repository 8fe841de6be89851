"""Segmentation without a network on a film whose masks are known."""

import numpy as np
import pytest

from neuspring.config.perception import OpenCvSegmentation
from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT, Writer
from neuspring.perception import segment_opencv
from tests.support.captures import describe, entry
from tests.support.filmed import FRAMES, film


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return film(tmp_path_factory.mktemp("film"), cameras=2, missing={1: (3,)})


def overlap(capture, labels, camera: str, frame: int, label: int) -> float:
    own, true = labels[frame] == label, capture.mask(camera, frame) == label
    return float((own & true).sum() / (own | true).sum())


@pytest.mark.parametrize("camera", ["0", "1"])
def test_object_and_hand_are_found_and_told_apart(capture, camera):
    labels = segment_opencv.segment(capture, camera, OpenCvSegmentation())
    for frame in range(FRAMES):
        if capture.has(camera, frame):
            assert overlap(capture, labels, camera, frame, OBJECT) > 0.9
            assert overlap(capture, labels, camera, frame, HANDS) > 0.85


def test_a_frame_that_is_missing_has_no_labels(capture):
    labels = segment_opencv.segment(capture, "1", OpenCvSegmentation())
    assert not labels[3].any()
    assert labels[2].any()
    assert labels[4].any()


def test_an_empty_table_has_no_object(tmp_path):
    writer = Writer(tmp_path, describe(cameras=(entry("0", 64, 48),), masks=False))
    for frame in range(5):
        writer.frame("0", frame, np.full((48, 64, 3), 120, np.uint8), np.full((48, 64), 900, np.uint16))
    with pytest.raises(InputError, match=r"an object more than 12 mm above the table z = 0 is required; received nothing"):
        segment_opencv.segment(writer.finish(), "0", OpenCvSegmentation())


def test_without_a_hand_s_color_all_is_object_and_the_settings_are_named(capture, capsys):
    labels = segment_opencv.segment(capture, "0", OpenCvSegmentation(hand_hue=(100.0, 110.0)))
    assert set(np.unique(labels)) == {0, OBJECT}
    assert "nothing above the table has the color of hands (hue in [100.0, 110.0] degrees" in capsys.readouterr().out


def test_small_pieces_of_hand_color_belong_to_the_object():
    labels = np.zeros((40, 60), np.uint8)
    labels[10:30, 5:35] = OBJECT
    labels[10:14, 5:9] = HANDS
    labels[5:25, 40:55] = HANDS
    tidy = segment_opencv._tidy(labels, OpenCvSegmentation())
    assert (tidy[10:14, 5:9] == OBJECT).all()
    assert (tidy[5:25, 40:55] == HANDS).all()


def test_small_holes_are_filled_and_large_ones_stay():
    seen = np.zeros((80, 120), bool)
    seen[5:75, 5:115] = True
    seen[10:12, 10:12] = False
    seen[20:30, 20:40] = False
    filled = seen | segment_opencv._holes(seen)
    assert filled[10:12, 10:12].all()
    assert not filled[20:30, 20:40].any()
    assert not filled[:5].any()
