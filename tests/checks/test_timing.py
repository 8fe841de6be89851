"""Time shift of two streams by their motion: closed form, and videos of a desk with wrong pairs."""

from types import SimpleNamespace

import numpy as np
import pytest

from neuspring.checks import examine
from neuspring.checks.timing import CELLS, Streams, Watched, follows, in_space, measure, on_images
from neuspring.data.camera import Camera
from tests.support import desk
from tests.support.desk import RADIUS, TARGET, K, seen

FRAMES, STRIDE = 24, 3
"""Pictures, and frames of the desk from one to the next: its ball moves by 15 mm."""


def bumps(shift=0.0, count=40, cells=60, at=0):
    """A bump that runs over cells with changing speed [T, n], from cell `at` on, seen `shift` frames late."""
    time = np.arange(count) - shift
    place = at + 30 + 20 * np.sin(time / 5) + 0.2 * time
    return np.exp(-0.5 * ((np.arange(cells) - place[:, None]) / 3) ** 2)


@pytest.mark.parametrize("shift", [0.0, 0.25, -0.75, 1.0, -3.5, 12.0])
def test_a_shift_is_measured_to_a_tenth_of_a_frame(shift):
    found = measure(bumps(), bumps(shift))
    assert found.known and found.frames == pytest.approx(shift, abs=0.1)
    assert found.wrong == (abs(shift) >= 0.5)


def test_unknown_frames_do_not_count_and_stillness_says_nothing():
    gaps = bumps(1.0)
    gaps[[7, 8, 20]] = np.nan
    assert measure(bumps(), gaps).frames == pytest.approx(1.0, abs=0.1)
    assert measure(bumps(), np.zeros((40, 60))) is None
    other = measure(bumps(), np.random.default_rng(0).random((40, 60)))
    assert not other.known and not other.wrong


def camera(index=0):
    """A camera before the desk with finer pictures."""
    pose = desk.looking(np.array(((0.05, -0.5, 0.35), (0.3, -0.4, 0.4))[index]), TARGET)
    return Camera(str(index), 240, 180, np.diag([3.0, 3.0, 1.0]) @ K, pose)


def film(index=0, late=0, still=False):
    """Images of a camera of the desk, with depth `late` frames later than color."""
    watched = Watched(FRAMES)
    for frame in range(FRAMES):
        depth = seen(camera(index), 0 if still else STRIDE * (frame - late) + 9)[1]
        watched.see(frame, seen(camera(index), 0 if still else STRIDE * frame + 9)[0], depth)
    return watched


@pytest.mark.parametrize("late", [0, 1, -2])
def test_depth_of_other_moments_is_found(late):
    one = film(late=late)
    shift = measure(one.color, one.depth)
    found = examine("streams", "x", [Streams("color", "depth", shift, "--shift 0.depth={frames}")])
    assert [(found_.level, found_.remedy, round(found_.value)) for found_ in found] == (
        [("error", f"--shift 0.depth={late}", late)] if late else []
    )


def test_a_film_in_which_nothing_moves_has_no_shift():
    one = film(still=True)
    assert measure(one.color, one.depth) is None


@pytest.mark.parametrize(("each", "found"), [(1, []), (2, [3, 5, 7])])
def test_an_encoded_video_that_repeats_its_images(each, found):
    """Encoded again, equal images differ a little."""
    one, noise = Watched(10), np.random.default_rng(0)
    for frame in range(10):
        image = seen(camera(), 3 * STRIDE * (frame // each))[0].astype(int) + noise.integers(-1, 2, (180, 240, 3))
        one.see(frame, image.clip(0, 255).astype(np.uint8))
    capture = SimpleNamespace(repeats={"0": {"color": [], "depth": []}})
    assert [list(one.frames) for one in examine("repeats", "x", capture, "0", one)] == [found] * bool(found)


def test_masks_of_another_camera_are_known_by_their_motion():
    watched = {"0": Watched(FRAMES), "1": Watched(FRAMES)}
    watched["0"].color[1:], watched["1"].color[1:] = (bumps(cells=CELLS[0] * CELLS[1], at=at)[1:FRAMES] for at in (0, 100))
    for one in watched.values():
        one.masks = watched["0"].color
    (found,) = examine("mask fit", "x", watched)
    assert (found.where, found.level) == ("camera 1", "error") and "masks match camera 0: 1.00, and 1: " in found.text
    watched["1"].masks = watched["1"].color
    assert examine("mask fit", "x", watched) == []


def test_a_label_that_appears_is_no_motion():
    one, image = Watched(3), np.zeros((180, 240, 3), np.uint8)
    for frame in range(3):
        mask = np.zeros((180, 240), np.uint8)
        mask[frame * 10 : 60 + frame * 10, :60] = frame > 0
        one.see(frame, image, mask=mask)
    assert np.isnan(one.masks[1]).all() and one.masks[2].sum() > 0


def test_cameras_of_other_moments_are_found_in_space():
    watched = {"0": film(0), "1": film(1)}
    maps = in_space(watched, {name: camera(int(name)) for name in watched})
    assert abs(measure(maps["0"], maps["1"]).frames) < 0.4
    shift = measure(maps["0"][:-1], maps["1"][1:])
    assert shift.wrong and shift.frames == pytest.approx(-1, abs=0.4)


def test_points_in_space_are_compared_with_the_film():
    around = np.random.default_rng(0).normal(size=(1, 500, 3))
    around *= RADIUS / np.linalg.norm(around, axis=2, keepdims=True)
    points = TARGET + (0, 0, RADIUS) + around + (0.005, 0, 0) * (STRIDE * np.arange(FRAMES)[:, None, None] + 9)
    one = film()
    assert on_images(points, camera()).shape == (FRAMES, CELLS[0] * CELLS[1])
    assert abs(measure(one.color, on_images(points, camera())).frames) < 0.5
    late = measure(one.color[2:], on_images(points, camera())[:-2])
    assert late.wrong and late.frames == pytest.approx(2, abs=0.5)


@pytest.mark.parametrize(("early", "found"), [(0, None), (12, -12), (-12, None)])
def test_a_body_that_moves_before_the_hands_is_of_other_moments(early, found):
    lift = 0.12 * np.clip((np.arange(60)[:, None, None] - 20) / 25, 0, 1) ** 2
    hands = np.tile((0.2, 0.0, 0.0), (60, 4, 1)) + lift * (0, 0, 1)
    points = np.linspace(0, 0.2, 6)[None, :, None] * (1, 0, 0) + lift * (0, 0, 1) * np.linspace(0.1, 1, 6)[None, :, None]
    points = np.roll(points, -early, axis=0)
    shift = follows(hands, points)
    assert bool(shift and shift.wrong) == (found is not None)
    assert found is None or shift.frames == pytest.approx(found, abs=0.5)
