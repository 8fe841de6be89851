"""The steps from a capture to observations, on a small film whose motion is known."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from neuspring.config import ScenarioRow
from neuspring.config.perception import Lift, Segmentation
from neuspring.core.errors import InputError
from neuspring.core.records import StageRecord
from neuspring.data.capture import Capture
from neuspring.data.results import Masks
from neuspring.stages.capture import capture
from neuspring.stages.lift import lift
from neuspring.stages.segment import segment
from tests.support.extensions import with_extensions
from tests.support.filmed import FLIP, FRAMES, SIZE, STEP, film, write_raw
from tests.support.perceived import SETTINGS, perceived


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    capture = film(folder / "capture")
    return capture, perceived(capture, folder), folder


def motion_error(observations, turn=None):
    """Distance, m, of visible points from where the film moved them."""
    moved = observations.object_points[0] + np.arange(FRAMES)[:, None, None] * (STEP if turn is None else turn @ STEP)
    return np.linalg.norm(moved - observations.object_points, axis=2)[1:][observations.object_visibility[1:]]


def segmented(seen, folder, camera="0"):
    segment(capture=seen.folder / "capture.json", camera=camera, settings=SETTINGS, device="cpu", output=folder / "masks.json")


def test_points_and_controllers_move_as_filmed(whole):
    _, observations, _ = whole
    assert observations.object_points.shape[1] > 40
    assert np.median(motion_error(observations)) < 0.002
    controllers = observations.controller_points
    assert controllers.shape[1] == 30
    moved = np.linalg.norm(controllers - controllers[0] - np.arange(FRAMES)[:, None, None] * STEP, axis=2)
    # A pixel is 4.4 mm wide there, and a ball has little to hold on to.
    assert np.median(moved[1:]) < 0.003
    assert len(observations.surface_points) > 10
    assert len(observations.interior_points) > 10
    assert observations.tracks.shape == (FRAMES, observations.tracks.shape[1], 3)


def test_each_step_names_its_backend_and_draws_a_picture(whole):
    _, observations, folder = whole
    assert StageRecord.load(folder / "0" / "masks.json").settings["perception"]["segment"]["backend"] == "given"
    tracks = StageRecord.load(folder / "0" / "tracks.json")
    assert tracks.settings["perception"]["track"]["backend"] == "opencv"
    assert 0 < tracks.facts["visible_share"] <= 1
    assert StageRecord.load(folder / "lifted.json").facts["controllers"] == 30
    for path, role in ((folder / "0" / "masks.json", "picture"), (folder / "lifted.json", "picture")):
        assert StageRecord.load(path).file(role, path).stat().st_size > 5000
    assert observations.scenario.provenance["shape prior"] == "visual_hull"


def test_cameras_may_differ_in_size_and_miss_frames(tmp_path):
    capture = film(tmp_path / "capture", cameras=2, sizes=((160, 90), (120, 100)), missing={1: (2, 3)})
    observations = perceived(capture, tmp_path)
    assert np.median(motion_error(observations)) < 0.003
    # Frames 2 and 3 have the first camera alone, frame 4 both.
    assert observations.object_visibility[2].mean() < observations.object_visibility[4].mean()


@with_extensions
def test_marks_of_a_capture_take_the_place_of_opencv(tmp_path):
    from neuspring.extensions.synthetic.make import outlines

    settings = replace(SETTINGS, perception=replace(SETTINGS.perception, segment=Segmentation(backend="opencv")))
    capture = film(tmp_path / "capture", cameras=1)
    (capture.folder / "marks.json").write_text(json.dumps({"format": 1, "cameras": outlines(capture)}))
    observations = perceived(capture, tmp_path, settings=settings)
    assert Masks.load(tmp_path / "0" / "masks.npz").backend == "marks"
    assert np.median(motion_error(observations)) < 0.003
    seen = Masks.load(tmp_path / "0" / "masks.npz").labels[0]
    truth = capture.mask("0", 0)
    for label in (1, 2):
        assert ((seen == label) & (truth == label)).sum() > 0.8 * ((seen == label) | (truth == label)).sum()


def test_phystwin_s_raw_layout_gives_the_same_observations(tmp_path):
    """Its world has z down; a capture of ours in that world, and the same written raw and imported."""
    own = film(tmp_path / "own", cameras=2, up="-z", train_end=4)
    case = write_raw(own, tmp_path / "data" / "thing")
    row = ScenarioRow(scenario="film", source="phystwin_raw", category="toy", path="thing", self_collision=False, ground=True)
    capture(scenario=row, settings=replace(SETTINGS, data_root=str(case.parent)), output=tmp_path / "imported" / "capture.json")
    imported = Capture.load(tmp_path / "imported")
    assert imported.train_end == 4
    expected, found = perceived(own, tmp_path / "a"), perceived(imported, tmp_path / "b", row)
    assert np.median(motion_error(found, FLIP[:3, :3])) < 0.003
    for name in ("object_points", "object_visibility", "object_motion_valid", "controller_points", "surface_points", "tracks"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-9, err_msg=name)


def test_an_object_that_leaves_is_said(tmp_path, capsys):
    capture = film(tmp_path / "capture", cameras=1)
    for frame in range(FRAMES):
        labels = capture.mask("0", frame)
        labels[2:22, 2:22] = 1
        labels = np.where((labels == 1) & (frame > 3), 0, labels).astype(np.uint8)
        cv2.imwrite(str(capture.path("mask", "0", frame)), labels)
    segmented(capture, tmp_path, "0")
    said = capsys.readouterr().out
    assert "frames with almost no object pixels: 2 frames (first in frame 4)" in said
    facts = StageRecord.load(tmp_path / "masks.json").facts
    assert (facts["objects"], facts["frames_without_object"]) == (2, 2)


def test_a_camera_without_object_and_hand_in_frame_0_is_not_used(tmp_path, capsys):
    capture = film(tmp_path / "capture", cameras=2)
    cv2.imwrite(str(capture.path("mask", "1", 0)), np.zeros(SIZE[::-1], np.uint8))
    observations = perceived(capture, tmp_path)
    assert "camera 1: neither object nor hands are visible in frame 0" in capsys.readouterr().out
    assert np.median(motion_error(observations)) < 0.003


def test_too_few_controllers_say_what_to_change(tmp_path, whole):
    _, _, folder = whole
    settings = replace(SETTINGS, perception=replace(SETTINGS.perception, lift=Lift(neighborhood=0.02, least_controllers=3000)))
    records = {name: [folder / camera / f"{name}.json" for camera in "012"] for name in ("masks", "tracks")}
    with pytest.raises(InputError, match=r"at least 3000 points of the hands.*controller_gaps"):
        lift(capture=whole[0].folder / "capture.json", settings=settings, output=tmp_path / "lifted.json", **records)
