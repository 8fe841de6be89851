"""annotations.json: what is written is read, and every refusal names the point, the camera and the rule."""

import json

import pytest

from neuspring.core.errors import InputError
from neuspring.perception.annotate.annotations import ANNOTATIONS, Annotations, Click, Point
from tests.support.moving import moving


def click(**changes):
    return {"frame": 2, "x": 5.0, "y": 6.5} | changes


def one(*clicks, name="ear", camera="0"):
    return {"format": 1, "points": [{"name": name, "clicks": {camera: list(clicks)}}]}


def test_what_is_written_is_read_and_says_no_more_than_needed(tmp_path):
    capture = moving(tmp_path)
    clicks = (Click(frame=0, x=5.0, y=6.5), Click(frame=3, hidden=True))
    annotations = Annotations(points=(Point(name="left ear", clicks={"0": clicks}), Point(name="tail")))
    annotations.save(tmp_path)
    assert Annotations.load(capture) == annotations
    stored = json.loads((tmp_path / ANNOTATIONS).read_text())
    assert stored["points"][0]["clicks"]["0"] == [{"frame": 0, "x": 5.0, "y": 6.5}, {"frame": 3, "hidden": True}]


def test_a_capture_without_the_file_has_no_points(tmp_path):
    assert Annotations.load(moving(tmp_path)).points == ()


def test_clicks_are_sorted_by_frame(tmp_path):
    read = Annotations.read(one(click(frame=9), click(frame=1)), moving(tmp_path), "here")
    assert [click.frame for click in read.points[0].clicks["0"]] == [1, 9]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([], "here: a JSON object is required; received list"),
        ({"format": 2, "points": []}, "here: \n  format"),
        ({"format": 1, "points": [], "extra": 1}, "extra: unknown key"),
        (one(click(), name=""), "points.0.name"),
        (one(click(), name="a\nb"), "points.0.name"),
        (one(click(), camera="7"), r"points.0 \(ear\), camera 7: must be one of the cameras \['0', 'covered'\]"),
        (one(click(frame=12)), "frames must lie below 12; received 12"),
        (one(click(frame=4)), "a click needs an image; received frame 4, which this camera missed"),
        (one(click(), click()), "one click a frame; received two in frame 2"),
        (one(click(x=128.0)), r"x and y must lie in the 128 x 96 image; received \(128.0, 6.5\)"),
        (one(click(x=float("nan"))), "points.0.clicks.0.0.x"),
        (one(click(x=None)), "a click has x and y, or it is hidden; received frame 2"),
        (one(click(hidden=True)), "a click has x and y, or it is hidden; received frame 2"),
        (one(click(frame="2")), "points.0.clicks.0.0.frame"),
        ({"format": 1, "points": one()["points"] * 2}, "names of points must differ; received ear"),
        ({"format": 1, "points": [{"name": f"p{k}"} for k in range(501)]}, "points: .*500"),
    ],
)
def test_bad_clicks_are_refused(tmp_path, values, message):
    with pytest.raises(InputError, match=message):
        Annotations.read(values, moving(tmp_path, missing=(4,)), "here")
