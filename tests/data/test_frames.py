"""Labels as pixels."""

import numpy as np
import pytest

from neuspring.data import frames
from neuspring.data.capture import HANDS, OBJECT, PERSON
from neuspring.data.frames import without_islands
from tests.support.moving import FRAMES, SIZE, moving


def labelled(*islands):
    """Labels [T, H, W] with a body of 26 x 20 pixels on the near square, and islands of 3 x 3 at (row, column) of frame 0."""
    labels = np.zeros((FRAMES, *SIZE[::-1]), np.uint8)
    labels[:, 48:74, 32:52] = OBJECT
    for row, column in islands:
        labels[0, row : row + 3, column : column + 3] = OBJECT
    return labels


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return moving(tmp_path_factory.mktemp("islands") / "capture")


def test_a_small_far_piece_of_the_object_goes_and_the_log_says_so(capture, capsys):
    left = without_islands(capture, "0", labelled((10, 100), (60, 54)))
    np.testing.assert_array_equal(left, labelled((60, 54)))  # that one is 3 pixels from the body
    assert "camera 0: removed 1 small distant pieces" in (said := capsys.readouterr().out)
    assert "frames 0 to 0, at most 9 pixels each" in said
    assert without_islands(capture, "0", left) is not left
    assert not capsys.readouterr().out


def test_depth_keeps_what_is_near_in_space(capture, tmp_path, monkeypatch):
    """A pixel of this wide camera is 15 mm wide at the body, so that 6 pixels are 9 cm."""
    monkeypatch.setattr(frames, "ISLAND_AWAY", 0.12)
    beside, flat = labelled((60, 57)), moving(tmp_path / "flat", depth=False)
    assert (without_islands(capture, "0", beside) == beside).all()
    assert (without_islands(flat, "0", beside) == labelled()).all(), "without depth the pixels decide"
    behind = labelled((40, 57))  # on the wall, 20 cm behind
    assert (without_islands(capture, "0", behind) == labelled()).all()


@pytest.mark.parametrize("between", [HANDS, PERSON])
def test_what_shows_behind_a_hand_is_no_island(capture, between):
    labels = labelled((60, 90))
    labels[0, 55:70, 52:90] = between
    np.testing.assert_array_equal(without_islands(capture, "0", labels), labels)


def test_pieces_that_are_large_or_in_a_row_stay(capture):
    row = labelled((60, 54), (60, 60), (60, 66))
    row[0, 10:30, 90:120] = OBJECT
    np.testing.assert_array_equal(without_islands(capture, "0", row)[0], row[0])
