"""The tracks mode: the file of clicks, points that are followed and lifted, and what is said to be doubtful about them."""

import json
import re
import time
from importlib.resources import files

import cv2
import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.extensions.annotate.clicks import ANNOTATIONS, Annotations, Click, ClickedPoint, GrayImages, Trail, follow
from neuspring.extensions.annotate.tracks import TracksMode, expected_frames, join, lift_place, notes_of, tracks_of
from neuspring.extensions.make_capture.make import Intake, make_capture
from results.published.film22.films import film as real_film
from tests.support.desk import write_folders, write_poses
from tests.support.filmed import film
from tests.support.films import Errors, Film, Points
from tests.support.moving import COVERED, FRAMES, NEAR, moving, truth
from tests.support.real import FOOTAGE

POINT = (46.0, 62.0)
"""On the square, in frame 0."""
TEXTS = ("lost", "the ways from", "looks unlike", "jumps by 173 mm", "cameras disagree by 30 mm", "no depth here")
PIXELS = 0.3
"""Largest error, pixels, where texture moves rigidly."""


def click(**changes):
    return {"frame": 2, "x": 5.0, "y": 6.5} | changes


def one(*clicks, name="ear", camera="0"):
    return {"format": 1, "points": [{"name": name, "clicks": {camera: list(clicks)}}]}


def test_what_is_written_is_read_in_the_order_of_frames_and_says_no_more_than_needed(tmp_path):
    capture = moving(tmp_path)
    assert Annotations.load(capture).points == ()
    clicks = (Click(frame=0, x=5.0, y=6.5), Click(frame=3, hidden=True))
    annotations = Annotations(points=(ClickedPoint(name="left ear", clicks={"0": clicks}), ClickedPoint(name="tail")))
    annotations.save(tmp_path)
    assert Annotations.load(capture) == annotations
    stored = json.loads((tmp_path / ANNOTATIONS).read_text())
    assert stored["points"][0]["clicks"]["0"] == [{"frame": 0, "x": 5.0, "y": 6.5}, {"frame": 3, "hidden": True}]
    read = Annotations.read(one(click(frame=9), click(frame=1)), capture, "here")
    assert [click.frame for click in read.points[0].clicks["0"]] == [1, 9]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([], "here: a JSON object is required"),
        ({"format": 2, "points": []}, "format"),
        ({"format": 1, "points": [], "extra": 1}, "extra: unknown key"),
        (one(click(), name="a\nb"), "points.0.name"),
        (one(click(), camera="7"), r"points.0 \(ear\), camera 7: must be one of the cameras"),
        (one(click(frame=12)), "frames must lie below 12"),
        (one(click(frame=4)), "a click needs an image"),
        (one(click(), click()), "one click a frame"),
        (one(click(x=128.0)), "x and y must lie in the 128 x 96 image"),
        (one(click(x=float("nan"))), "points.0.clicks.0.0.x"),
        (one(click(x=None)), "a click has x and y, or it is hidden"),
        (one(click(hidden=True)), "a click has x and y, or it is hidden"),
        ({"format": 1, "points": one()["points"] * 2}, "names of points must differ"),
        ({"format": 1, "points": [{"name": f"p{k}"} for k in range(501)]}, "points: .*500"),
    ],
)
def test_bad_clicks_are_refused(tmp_path, values, message):
    with pytest.raises(InputError, match=message):
        Annotations.read(values, moving(tmp_path, missing=(4,)), "here")


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


@pytest.mark.parametrize(
    ("clicks", "missing", "known"),
    [
        ([at(2), Click(frame=4, hidden=True), at(9)], (), [0, 1, 2, 3, 9, 10, 11]),
        ([Click(frame=0, hidden=True), at(6)], (), [6, 7, 8, 9, 10, 11]),
        ([at(0)], (4, 5), [0, 1, 2, 3, 6, 7, 8, 9, 10, 11]),
    ],
)
def test_hidden_and_missing_frames_have_no_place(tmp_path, clicks, missing, known):
    trail = follow(GrayImages(moving(tmp_path, missing=missing)), "0", clicks)
    assert np.flatnonzero(np.isfinite(trail.places).all(axis=1)).tolist() == known
    assert np.nanmax(error(trail)) < PIXELS


def test_a_covered_point_is_lost_and_found_again(tmp_path):
    trail = follow(GrayImages(moving(tmp_path)), "covered", [at(0), at(11)])
    seen = np.isfinite(trail.places).all(axis=1)
    assert not seen[list(COVERED)].any()
    assert seen[[1, 2, 3, 4, 7, 8, 9, 10]].all()
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
            points[number] = ClickedPoint(name=str(number), clicks=clicks)
    assert len(points) >= 8
    return capture, points


def test_a_clicked_body_is_followed_to_a_pixel_and_lifted_to_millimeters(body):
    """A pixel of these small images is 4.4 mm wide where the body is."""
    capture, points = body
    images, errors = GrayImages(capture), []
    for number, point in points.items():
        for name, clicks in point.clicks.items():
            pixels, _ = capture.cameras[name].project(capture.tracks()[:, number])
            errors.append(np.linalg.norm(follow(images, name, clicks).places - pixels, axis=1)[1:-1])
    assert np.isfinite(errors).all()
    assert np.median(errors) < 0.4
    assert np.max(errors) < 1.5
    tracks, _ = tracks_of(capture, Annotations(points=tuple(points.values())))
    distance = np.linalg.norm(tracks - capture.tracks()[:, list(points)], axis=2)
    assert np.isfinite(distance).all()
    assert np.median(distance) < 0.0015
    assert np.percentile(distance, 95) < 0.006


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Capture:
    return moving(tmp_path_factory.mktemp("moving"), missing=(4,))


def test_a_place_is_lifted_at_its_own_depth(capture):
    for frame, place in enumerate(truth(POINT).tolist()):
        point = lift_place(capture, "0", frame, *place)
        if frame == 4:  # the frame that the camera missed
            assert np.isnan(point).all()
            continue
        pixel, depth = capture.cameras["0"].project(point)
        np.testing.assert_allclose(pixel, place, atol=1e-9)
        np.testing.assert_allclose(depth, NEAR)


def test_a_camera_without_depth_gives_no_point(tmp_path):
    assert np.isnan(lift_place(moving(tmp_path, depth=False), "0", 0, *POINT)).all()


@pytest.mark.parametrize(("measured", "expected"), [(0, np.nan), (3, np.nan), (4, 0.7), (25, 0.7)])
def test_the_depth_is_the_median_of_what_is_measured_around_the_place(tmp_path, measured, expected):
    capture = moving(tmp_path)
    image, near = np.zeros((96, 128), np.uint16), np.zeros(25, np.uint16)
    near[:measured] = 700
    near[:1] = min(measured, 1) * 900  # one outlier
    image[48:53, 58:63] = near.reshape(5, 5)
    cv2.imwrite(str(capture.path("depth", "0", 0)), image)
    point = lift_place(capture, "0", 0, 60.2, 49.8)
    np.testing.assert_allclose(capture.cameras["0"].project(point)[1] if np.isfinite(point).all() else np.nan, expected)


def test_cameras_are_averaged_and_their_distance_is_told(capture):
    """Both cameras have the same pose, so a place one pixel beside the other lies NEAR / 40 m beside it."""
    unknown = np.full(3, np.nan)
    seen = [lift_place(capture, "0", 0, 46, 62), lift_place(capture, "0", 1, 48.5, 60.75), unknown]
    other = [lift_place(capture, "covered", 0, 47, 62), unknown, unknown]
    places, apart = join([np.stack(seen), np.stack(other)], 3)
    np.testing.assert_allclose(places, [lift_place(capture, "0", 0, 46.5, 62), seen[1], unknown], atol=1e-9)
    np.testing.assert_allclose(apart, [NEAR / 40, np.nan, np.nan])
    assert np.isnan(join([], FRAMES)[0]).all()


def note_texts(capture, trail: Trail, track: tuple[np.ndarray, np.ndarray], *clicks: Click) -> list[tuple[int, int, int, str]]:
    """Frames of each note, and how its text begins."""
    point = ClickedPoint(name="ear", clicks={"0": clicks or (Click(frame=0, x=1.0, y=1.0),)})
    notes = notes_of(point, {"0": trail}, *track, capture)
    return [(note.first, note.last, note.frame, next(t for t in TEXTS if note.text.startswith(t))) for note in notes]


def good() -> tuple[Trail, tuple[np.ndarray, np.ndarray]]:
    """A trail without doubt, but for the frame that the camera missed, and its places and distances in the world."""
    trail = Trail(np.ones((FRAMES, 2)), np.zeros(FRAMES), np.ones(FRAMES))
    trail.places[4] = np.nan
    world = np.zeros((FRAMES, 3))
    world[4] = np.nan
    return trail, (world, np.full(FRAMES, np.nan))


def test_a_good_track_has_no_notes(capture):
    assert note_texts(capture, *good()) == []


def test_hidden_frames_are_not_lost(capture):
    trail, track = good()
    trail.places[7:10] = np.nan
    assert note_texts(capture, trail, track) == [(7, 9, 7, "lost")]
    clicks = (Click(frame=0, x=1.0, y=1.0), Click(frame=7, hidden=True), Click(frame=10, x=1.0, y=1.0))
    assert note_texts(capture, trail, track, *clicks) == []
    assert np.flatnonzero(~expected_frames(clicks, capture, "0")).tolist() == [4, 7, 8, 9]


@pytest.mark.parametrize(
    ("what", "frames", "value", "note"),
    [
        ("trail.apart", slice(6, 9), (4, 9, 5), (6, 8, 7, "the ways from")),
        ("trail.alike", 6, 0.1, (6, 6, 6, "looks unlike")),
        ("track.places", slice(8, None), 0.1, (8, 8, 8, "jumps by 173 mm")),
        ("track.apart", 2, 0.03, (2, 2, 2, "cameras disagree by 30 mm")),
        ("track.places", slice(3), np.nan, (0, 2, 0, "no depth here")),
    ],
)
def test_what_is_doubtful_is_noted_with_its_worst_frame(capture, what, frames, value, note):
    trail, track = good()
    spoiled = {"trail.apart": trail.apart, "trail.alike": trail.alike, "track.places": track[0], "track.apart": track[1]}
    spoiled[what][frames] = value
    assert note_texts(capture, trail, track) == [note]


def test_the_script_of_the_page_makes_tracks(tmp_path):
    text = files("neuspring.extensions.annotate").joinpath("README.md").read_text()
    script = re.search("```python\n(.*?)```", text, re.DOTALL)[1]
    capture = moving(tmp_path)
    exec(script.replace("FOLDER", str(tmp_path)), {})
    assert capture.tracks().shape == (FRAMES, 1, 3)
    assert np.isfinite(capture.tracks()).any()


def test_clicks_on_color_alone_stay_in_the_image(tmp_path):
    root = write_folders(tmp_path)
    given = {"output": root / "capture", "name": "desk", "category": "ball", "rate": 30.0, "color": (root / "color_0",)}
    given |= {"pose": "lying", "intrinsics": root / "intrinsics.json", "poses": write_poses(root / "poses.json", 1)}
    capture, _ = make_capture(Intake(**given))
    clicks = Annotations(points=(ClickedPoint(name="corner", clicks={"0": (Click(frame=0, x=40.0, y=30.0),)}),))
    with pytest.raises(InputError, match=r"color alone cannot lift clicks to 3D; received none. Clicks stay in annotations.json"):
        tracks_of(capture, clicks)
    clicks.save(capture.folder)
    mode = TracksMode(capture)
    try:
        while mode.results(0)["busy"]:
            time.sleep(0.01)
        assert [note["text"] for note in mode.results(0)["points"][0]["notes"]][-1].startswith("color alone: followed")
        with pytest.raises(InputError, match="tracks in the world need depth"):
            mode.save(replace=False)
    finally:
        mode.close()
    assert not (capture.folder / "tracks.json").exists()


@pytest.mark.skipif(not FOOTAGE.is_dir(), reason="the footage is not part of the repository")
def test_one_click_per_point_follows_a_real_rope():
    """Against points that were marked by hand on real color film."""
    case = "single_lift_rope"
    own = Points.load(FOOTAGE / "tracks" / f"{case}.json")
    images = GrayImages(Film(real_film(FOOTAGE, case)))
    places = np.stack([follow(images, "0", [Click(frame=0, x=float(x), y=float(y))]).places for x, y in own.xy[:, 0]], axis=1)
    found = Errors.of(own, places, np.isfinite(places[..., 0]))
    assert found.shown == 18
    assert found.lost < 0.2
    assert found.median < 2.5
