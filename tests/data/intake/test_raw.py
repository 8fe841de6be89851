"""PhysTwin's raw layout through make-capture: its frames, masks and tracks come along, in the world of the table."""

import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.data.capture import Capture
from tests.support.filmed import film, write_raw


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("raw")
    original = film(folder / "film", cameras=1, up="-z")
    return original, write_raw(original, folder / "case")


def test_a_case_keeps_masks_tracks_and_split(case, tmp_path):
    original, folder = case
    output = tmp_path / "capture"
    assert main(["make-capture", "--phystwin-raw", str(folder), "--category", "toy", "--output", str(output)]) == 0
    capture = Capture.load(output)
    assert (capture.description.up, capture.train_end, capture.description.frame_rate) == ("-z", 4, 30.0)
    np.testing.assert_array_equal(capture.mask("0", 3), original.mask("0", 3))
    np.testing.assert_array_equal(capture.color("0", 3), original.color("0", 3))
    np.testing.assert_allclose(capture.tracks(), original.tracks(), atol=2e-6)


def test_a_part_of_it_has_its_part_of_the_tracks(case, tmp_path):
    original, folder = case
    words = f"make-capture --phystwin-raw {folder} --category toy --frames 1-5 --level --output {tmp_path / 'capture'}"
    assert main(words.split()) == 0
    capture = Capture.load(tmp_path / "capture")
    assert capture.frame_count == 5
    np.testing.assert_array_equal(capture.mask("0", 0), original.mask("0", 1))
    # The film's table is z = 0 already: leveling moves it by less than a tenth of depth's millimeters.
    np.testing.assert_allclose(capture.tracks(), original.tracks()[1:], atol=3e-4)
