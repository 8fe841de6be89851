"""PhysTwin's raw layout through make-capture: its frames, masks and tracks come along, in the world of the table."""

import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.config import ScenarioRow
from neuspring.core.errors import InputError
from neuspring.data.capture import Capture, Writer
from neuspring.extensions.make_capture.formats.phystwin_raw import open_case
from neuspring.extensions.make_capture.poses import choose
from neuspring.intake.phystwin_raw import convert
from tests.support.captures import describe, entry
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


def numbered(root):
    """Two cameras in PhysTwin's layout; every image and mask holds the number of its frame."""
    writer = Writer(root / "film", describe(cameras=(entry(), entry(name="1")), frame_count=12, masks=True))
    for name in ("0", "1"):
        for frame in range(12):
            color, depth = np.full((24, 32, 3), 20 * frame, np.uint8), np.full((24, 32), 500 + frame, np.uint16)
            mask = np.zeros((24, 32), np.uint8)
            mask[frame] = 1
            writer.frame(name, frame, color, depth, mask)
    return write_raw(writer.finish(np.zeros((12, 1, 3))), root / "case")


def test_frames_that_cameras_lost_are_missing_and_no_mask_meets_another_color(tmp_path):
    case = numbered(tmp_path)
    for camera, lost in (("0", 3), ("1", 8)):
        (case / "color" / camera / f"{lost}.png").unlink()
        (case / "depth" / camera / f"{lost}.npy").unlink()
    (case / "color" / "1" / "11.png").unlink()
    raw = open_case(case)
    choice = choose(raw.views)
    assert (choice.numbers, choice.missing("0"), choice.missing("1")) == ([*range(12)], (3,), (8, 11))
    for view in raw.views:
        places = choice.places[view.name]
        for frame, (color, depth) in zip(places, view.read([*places.values()]), strict=True):
            assert (color[0, 0, 0] / 20, depth[0, 0] - 500) == (frame, frame)
            assert np.flatnonzero(raw.labels(view.name, choice.numbers[frame]).any(axis=1)).tolist() == [frame]
    row = ScenarioRow(scenario="thing", source="phystwin_raw", category="toy", path="x", self_collision=False, ground=True)
    with pytest.raises(InputError, match=r"3\.png: this image must exist.* `neuspring make-capture --phystwin-raw .*case`"):
        convert(row, case, tmp_path / "converted")


def test_masks_that_are_missing_and_names_that_are_no_frame_numbers_are_refused(tmp_path):
    case = numbered(tmp_path)
    for frame in (4, 5, 6, 9):
        (case / "mask" / "1" / "0" / f"{frame}.png").unlink()
    words = f"make-capture --phystwin-raw {case} --category toy --output {tmp_path / 'capture'}"
    with pytest.raises(InputError, match=r"mask/1/0: a mask of every frame with color .*received none of 4 to 6, 9\. Make them"):
        open_case(case).require_masks(dict.fromkeys("01", range(12)))
    assert main(words.split()) == 2 and not (tmp_path / "capture").exists()
    (case / "color" / "1" / "11.png").rename(case / "color" / "1" / "12.png")
    with pytest.raises(InputError, match=r"color/1: names must be frame numbers below .* metadata\.json, 12; received 0 to 10, 12"):
        open_case(case)
