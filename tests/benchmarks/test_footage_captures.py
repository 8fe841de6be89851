"""Captures of the footage, where it is: what the film, the marks and the marked points become."""

import numpy as np
import pytest

from neuspring.data.check import check_layout
from neuspring.perception.marks.marks import MARKS, Marks
from tests.benchmarks.footage import Points, film
from tests.benchmarks.footage_captures import cases_of, category_of, points_of, write_capture
from tests.support.findings import of_level
from tests.support.real import FOOTAGE

FRAMES = 5


def test_the_kind_of_object_is_in_the_name():
    kinds = {"single_lift_cloth_4": "cloth", "rope_double_hand": "rope", "weird_package": "other"}
    assert {name: category_of(name) for name in kinds} == kinds


@pytest.mark.skipif(not FOOTAGE.is_dir(), reason="the footage is not part of the repository")
def test_a_film_becomes_a_capture_of_color_alone(tmp_path):
    case = "single_lift_rope"
    capture = write_capture(FOOTAGE, tmp_path, case, FRAMES)
    about = capture.description
    assert (about.depth, about.up, about.category, about.name, about.masks) == ("none", "-z", "rope", case, True)
    np.testing.assert_array_equal(capture.color("0", 4), film(FOOTAGE, case, FRAMES)[4])
    assert (capture.mask("0", 4) == 1).sum() > 3000
    Marks.load(capture.folder / MARKS).require(capture)
    found = check_layout(capture.folder)
    assert of_level(found, "error") == []
    # The white rope is 38.7 cm long.
    assert any("object size on the table 39 x" in text for text in of_level(found, "note"))


@pytest.mark.skipif(not FOOTAGE.is_dir(), reason="the footage is not part of the repository")
def test_only_sure_points_of_marked_frames_are_kept():
    path = FOOTAGE / "tracks" / "single_lift_rope.json"
    marked, points = Points.load(path), points_of(path, 50)
    assert np.flatnonzero(np.isfinite(points).any(axis=(1, 2))).tolist() == marked.frames
    assert np.isfinite(points[..., 0]).sum() == marked.sure.sum()
    assert np.isfinite(points[0]).all()


@pytest.mark.skipif(not FOOTAGE.is_dir(), reason="the footage is not part of the repository")
def test_a_case_without_a_tracking_video_is_read_from_the_rendering():
    assert len(film(FOOTAGE, "single_lift_cloth_3", 2)) == 2 and "single_lift_cloth_3" in cases_of(FOOTAGE)
    with pytest.raises(FileNotFoundError, match="combine_tracking__nothing"):
        film(FOOTAGE, "nothing")
