"""Clicks on a capture of color alone."""

import time

import pytest

from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.extensions.annotate.clicks import Annotations, Click, ClickedPoint
from neuspring.extensions.annotate.tracks import TracksMode, tracks_of
from neuspring.extensions.make_capture.make import Intake, make_capture
from tests.support.desk import write_folders, write_poses


@pytest.fixture
def capture(tmp_path):
    root = write_folders(tmp_path)
    given = {"output": root / "capture", "name": "desk", "category": "ball", "rate": 30.0, "color": (root / "color_0",)}
    given |= {"pose": "lying", "intrinsics": root / "intrinsics.json", "poses": write_poses(root / "poses.json", 1)}
    made, _ = make_capture(Intake(**given))
    return Capture.load(made.folder)


def test_clicks_stay_in_the_image(capture):
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
