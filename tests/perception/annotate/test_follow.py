"""Points that were clicked are followed where the truth says that they went."""

import numpy as np
import pytest

from neuspring.perception.annotate.annotations import Annotations, Click, Point
from neuspring.perception.annotate.follow import GrayImages, follow
from neuspring.perception.annotate.tracks import tracks_of
from tests.support.filmed import film
from tests.support.moving import COVERED, moving, truth

POINT = (46.0, 62.0)
"""On the square, in frame 0."""
PIXELS = 0.3
"""Largest error, pixels, where texture moves rigidly."""


def at(frame: int, offset: tuple[float, float] = (0.0, 0.0)) -> Click:
    """A click on POINT in a frame, and beside it."""
    x, y = truth(POINT)[frame] + offset
    return Click(frame=frame, x=float(x), y=float(y))


def error(trail) -> np.ndarray:
    return np.linalg.norm(trail.places - truth(POINT), axis=1)


@pytest.mark.parametrize("frames", [(0,), (5,), (11,), (0, 11), (3, 8)])
def test_a_point_is_followed_forward_and_backward(tmp_path, frames):
    trail = follow(GrayImages(moving(tmp_path)), "0", [at(frame) for frame in frames])
    assert error(trail).max() < PIXELS
    assert (error(trail)[list(frames)] == 0).all()


def test_between_two_clicks_both_directions_count_by_their_distance(tmp_path):
    """The second click lies 2 px beside the first one's point: the way from it does too, and the blend goes over linearly."""
    trail = follow(GrayImages(moving(tmp_path)), "0", [at(0), at(10, (2.0, 0.0))])
    offset = (trail.places - truth(POINT))[:11]
    np.testing.assert_allclose(offset[:, 0], np.linspace(0, 2, 11), atol=PIXELS)
    np.testing.assert_allclose(offset[:, 1], 0, atol=PIXELS)
    np.testing.assert_allclose(trail.apart[1:10], 2, atol=PIXELS)


def test_hidden_frames_have_no_place(tmp_path):
    clicks = [at(2), Click(frame=4, hidden=True), at(9)]
    known = np.isfinite(follow(GrayImages(moving(tmp_path)), "0", clicks).places).all(axis=1)
    assert known.tolist() == [True] * 4 + [False] * 5 + [True] * 3


def test_a_point_that_is_hidden_from_the_start_appears_with_its_click(tmp_path):
    trail = follow(GrayImages(moving(tmp_path)), "0", [Click(frame=0, hidden=True), at(6)])
    assert np.isfinite(trail.places).all(axis=1).tolist() == [False] * 6 + [True] * 6


def test_a_covered_point_is_lost_and_found_again(tmp_path):
    trail = follow(GrayImages(moving(tmp_path)), "covered", [at(0), at(11)])
    seen = np.isfinite(trail.places).all(axis=1)
    assert not seen[list(COVERED)].any()
    assert seen[[1, 2, 3, 4, 7, 8, 9, 10]].all()
    assert np.nanmax(error(trail)) < PIXELS


def test_missing_frames_are_skipped(tmp_path):
    trail = follow(GrayImages(moving(tmp_path, missing=(4, 5))), "0", [at(0)])
    seen = np.isfinite(trail.places).all(axis=1)
    assert np.flatnonzero(~seen).tolist() == [4, 5]
    assert np.nanmax(error(trail)) < PIXELS


@pytest.fixture(scope="module")
def body(tmp_path_factory):
    """A film of a body, and clicks on its annotated vertices in the first and the last frame of every camera that sees them."""
    capture, points = film(tmp_path_factory.mktemp("film")), {}
    for number, vertex in enumerate(np.swapaxes(capture.tracks(), 0, 1)):
        clicks = {}
        for name, camera in capture.cameras.items():
            pixels, distance = camera.project(vertex)
            x, y = np.round(pixels).astype(int).T
            measured = [capture.depth(name, frame)[y[frame], x[frame]] for frame in range(capture.frame_count)]
            if (np.abs(measured - distance) < 0.003).all():
                ends = (0, capture.frame_count - 1)
                clicks[name] = tuple(Click(frame=t, x=float(pixels[t, 0]), y=float(pixels[t, 1])) for t in ends)
        if clicks:
            points[number] = Point(name=str(number), clicks=clicks)
    assert len(points) >= 8
    return capture, points


def test_a_clicked_body_is_followed_to_a_pixel_in_every_camera(body):
    capture, points = body
    images, errors = GrayImages(capture), []
    for number, point in points.items():
        for name, clicks in point.clicks.items():
            pixels, _ = capture.cameras[name].project(capture.tracks()[:, number])
            errors.append(np.linalg.norm(follow(images, name, clicks).places - pixels, axis=1)[1:-1])
    assert np.isfinite(errors).all()
    assert np.median(errors) < 0.4
    assert np.max(errors) < 1.5


def test_a_clicked_body_is_lifted_to_millimeters(body):
    """A pixel of these small images is 4.4 mm wide where the body is."""
    capture, points = body
    tracks, _ = tracks_of(capture, Annotations(points=tuple(points.values())))
    distance = np.linalg.norm(tracks - capture.tracks()[:, list(points)], axis=2)
    assert np.isfinite(distance).all()
    assert np.median(distance) < 0.0015
    assert np.percentile(distance, 95) < 0.006
