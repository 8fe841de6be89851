"""Places in images to points in the world, and what is said to be doubtful about them."""

import re
from importlib.resources import files

import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.perception.annotate.annotations import Annotations, Click, Point
from neuspring.perception.annotate.follow import Trail
from neuspring.perception.annotate.notes import expected_frames, notes_of
from neuspring.perception.annotate.tracks import tracks_of
from neuspring.perception.annotate.world import Lifted, depth_reader, join, lift_places, lift_track
from tests.support.moving import FRAMES, NEAR, moving, truth


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Capture:
    return moving(tmp_path_factory.mktemp("moving"), missing=(4,))


def places(*rows: tuple[float, float] | None) -> np.ndarray:
    """Places of the first frames; unknown afterwards."""
    result = np.full((FRAMES, 2), np.nan)
    for frame, row in enumerate(rows):
        if row is not None:
            result[frame] = row
    return result


def test_a_place_is_lifted_at_its_own_depth(capture):
    camera = capture.cameras["0"]
    points = lift_places(camera, depth_reader(capture, "0"), truth((46.0, 62.0)))
    assert np.flatnonzero(np.isnan(points).any(axis=1)).tolist() == [4]  # the frame that the camera missed
    pixels, depth = camera.project(np.delete(points, 4, axis=0))
    np.testing.assert_allclose(pixels, np.delete(truth((46.0, 62.0)), 4, axis=0), atol=1e-9)
    np.testing.assert_allclose(depth, NEAR)


@pytest.mark.parametrize(("measured", "expected"), [(0, np.nan), (3, np.nan), (4, 0.7), (25, 0.7)])
def test_the_depth_is_the_median_of_what_is_measured_around_the_place(capture, measured, expected):
    image, near = np.zeros((96, 128)), np.zeros(25)
    near[:measured] = 0.7
    near[:1] = min(measured, 1) * 0.9  # one outlier
    image[48:53, 58:63] = near.reshape(5, 5)
    point = lift_places(capture.cameras["0"], lambda _: image, places((60.2, 49.8)))[0]
    np.testing.assert_allclose(capture.cameras["0"].project(point)[1] if np.isfinite(point).all() else np.nan, expected)


def test_a_camera_without_depth_gives_no_point(tmp_path):
    flat = moving(tmp_path, depth=False)
    assert np.isnan(lift_track(flat, {"0": truth((46.0, 62.0))}).track).all()


def test_cameras_are_averaged_and_their_distance_is_told(capture):
    """Both cameras have the same pose, so a place one pixel beside the other lies NEAR / 40 m beside it."""
    lifted = lift_track(capture, {"0": places((46, 62), (48.5, 60.75)), "covered": places((47, 62))})
    one = lift_places(capture.cameras["0"], depth_reader(capture, "0"), places((46.5, 62), (48.5, 60.75)))
    np.testing.assert_allclose(lifted.track, one, atol=1e-9)
    np.testing.assert_allclose(lifted.apart[:2], [NEAR / 40, np.nan])


def test_no_camera_is_no_point(capture):
    assert np.isnan(join([], capture).track).all()


def note_texts(capture, trail: Trail, lifted: Lifted, *clicks: Click) -> list[tuple[int, int, int, str]]:
    point = Point(name="ear", clicks={"0": clicks or (Click(frame=0, x=1.0, y=1.0),)})
    return [(note.first, note.last, note.frame, note.text) for note in notes_of(point, {"0": trail}, lifted, capture)]


def good() -> tuple[Trail, Lifted]:
    """A trail without doubt, but for the frame that the camera missed."""
    trail = Trail(np.ones((FRAMES, 2)), np.zeros(FRAMES), np.ones(FRAMES))
    trail.places[4] = np.nan
    track = np.zeros((FRAMES, 3))
    track[4] = np.nan
    return trail, Lifted(track, np.full(FRAMES, np.nan))


def test_a_good_track_has_no_notes(capture):
    assert note_texts(capture, *good()) == []


def test_a_lost_point_is_noted_once(capture):
    trail, lifted = good()
    trail.places[7:10] = np.nan
    assert note_texts(capture, trail, lifted) == [(7, 9, 7, "lost: click it again, or mark it hidden")]


def test_hidden_frames_are_not_lost(capture):
    trail, lifted = good()
    trail.places[7:10] = np.nan
    clicks = (Click(frame=0, x=1.0, y=1.0), Click(frame=7, hidden=True), Click(frame=10, x=1.0, y=1.0))
    assert note_texts(capture, trail, lifted, *clicks) == []
    assert np.flatnonzero(~expected_frames(clicks, capture, "0")).tolist() == [4, 7, 8, 9]


def test_the_worst_frame_of_a_note_comes_first(capture):
    trail, lifted = good()
    trail.apart[6:9] = 4, 9, 5
    assert note_texts(capture, trail, lifted) == [(6, 8, 7, "the ways from the two clicks are 9 px apart: click it here")]


def test_jumps_disagreements_and_missing_depth_are_noted(capture):
    trail, lifted = good()
    lifted.track[8:] += 0.1
    lifted.apart[2] = 0.03
    assert note_texts(capture, trail, lifted) == [
        (2, 2, 2, "cameras disagree by 30 mm"),
        (8, 8, 8, "jumps by 173 mm in one frame: is the point hidden here?"),
    ]
    trail, lifted = good()
    lifted.track[:3] = np.nan
    assert note_texts(capture, trail, lifted) == [(0, 2, 0, "no depth here: null in tracks.json")]


def test_looks_are_noted(capture):
    trail, lifted = good()
    trail.alike[6] = 0.1
    assert note_texts(capture, trail, lifted) == [(6, 6, 6, "looks unlike the click: check it here")]


def test_tracks_need_a_point(capture):
    with pytest.raises(InputError, match=r"annotations\.json: a point or more must be clicked; received 0"):
        tracks_of(capture, Annotations())


def test_the_script_of_the_page_makes_tracks(tmp_path):
    text = files("neuspring.perception").joinpath("README.md").read_text().split("## The page of annotate")[1]
    script = re.search("```python\n(.*?)```", text, re.DOTALL)[1]
    capture = moving(tmp_path)
    exec(script.replace("FOLDER", str(tmp_path)), {})
    assert capture.tracks().shape == (FRAMES, 1, 3)
    assert np.isfinite(capture.tracks()).any()
