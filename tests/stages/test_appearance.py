"""Appearance from a small film whose motion is known: splats of frame 0, carried along, drawn, scored and filmed."""

import copy
import dataclasses
import json
import shutil

import av
import cv2
import numpy as np
import pytest
import torch

from neuspring.core.errors import InputError
from neuspring.core.records import Before, Recorder, StageRecord
from neuspring.data.capture import HANDS, OBJECT, PERSON, Capture
from neuspring.data.results import Masks
from neuspring.scores import metrics
from neuspring.splats import draw
from neuspring.splats.draw import orbit_view
from neuspring.splats.model import Gaussians, Splats
from neuspring.splats.view import View
from neuspring.stages.appearance import appearance, beside_hands
from neuspring.stages.render import draw_frames
from tests.support.filmed import FLIP, FRAMES, SIZE, STEP, film
from tests.support.pictured import IMAGES, Scene
from tests.support.pictured import pictured as settings

SHORT = dataclasses.replace(IMAGES.appearance, iterations=10)
"""For tests that ask for splats, not for good ones."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("appearance")
    made = Scene(film(folder / "capture"), folder)
    made.learn(settings())
    return made


def mean(table, metric, frame, camera="0"):
    chosen = table[(table["metric"] == metric) & (table["frame"] == frame) & (table["camera"] == camera)]
    return float(chosen["value"].iloc[0])


def changed(scene, **parts):
    """The scene with other parts, the rest shared."""
    other = copy.copy(scene)
    vars(other).update(parts)
    return other


def spoiled(scene, folder, camera=None, **changes):
    """The capture with other entries, and others for camera 0; its images are shared."""
    values = json.loads((scene.capture.folder / "capture.json").read_text()) | changes
    values["cameras"][0] |= camera or {}
    folder.mkdir()
    for kind in ("color", "depth", "mask", "tracks.json"):
        (folder / kind).symlink_to(scene.capture.folder / kind)
    (folder / "capture.json").write_text(json.dumps(values))
    return Capture.load(folder)


def test_splats_show_frame_0_and_say_what_they_could_not_see(scene):
    record = StageRecord.load(scene.appearance)
    assert record.status == "ok"
    assert all(record.facts[f"psnr_{name}"] > 28 for name in scene.capture.cameras)
    # Below, no camera looks. The share is that which perception says.
    assert 0.05 < record.facts["unseen_surface"] < 0.6
    lifted = StageRecord.load(scene.folder / "lifted.json")
    assert record.facts["unseen_surface"] == lifted.facts["shape_invented_share"]
    assert record.inputs.keys() == {"capture", "images", "masks0", "masks1", "masks2", "lifted"}
    assert record.facts["backend"] == "warp"
    assert {"splats", "history", "picture"} == set(record.files)
    assert record.facts["points_beside_hands"] > 0


def test_the_true_motion_keeps_the_picture_and_none_loses_it(scene):
    moved, right = scene.render(scene.roll(STEP, "moved"), settings())
    _, still = scene.render(scene.roll(0 * STEP, "still"), settings())
    assert moved.status == "ok"
    assert mean(right, "psnr", FRAMES - 1) > mean(right, "psnr", 0) - 4
    assert mean(right, "psnr", FRAMES - 1) > mean(still, "psnr", FRAMES - 1) + 4
    assert mean(right, "iou", FRAMES - 1) > 0.85 > mean(still, "iou", FRAMES - 1)
    assert mean(right, "psnr", 0) == mean(still, "psnr", 0)
    assert moved.facts["lpips"].startswith("no AlexNet weights")
    assert {"psnr", "ssim", "iou"} <= set(right["metric"]) <= {metric.name for metric in metrics.metrics_of("pictures")} - {"lpips"}
    with av.open(scene.folder / "moved" / "video.mp4") as video:
        pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(pictures) == FRAMES
    assert pictures[0].shape[1] == 3 * SIZE[0]


def test_all_views_are_scored_if_wanted_each_with_its_own_camera(scene):
    record, table = scene.render(scene.roll(STEP, "all"), settings(views="all", video=False))
    assert set(table["camera"]) == set(scene.capture.cameras)
    assert all(mean(table, "psnr", 0, camera) > 25 for camera in scene.capture.cameras)
    assert set(record.files) == {"frames", "strip"}


def test_one_camera_that_misses_frames_and_z_down(tmp_path):
    made = Scene(film(tmp_path / "capture", cameras=1, missing={0: (2,)}, up="-z"), tmp_path)
    assert made.learn(settings(appearance=SHORT)).facts["unseen_surface"] > 0.2
    rendered, table = made.render(made.roll(FLIP[:3, :3] @ STEP, "one"), settings(video=False))
    assert sorted(table["frame"].unique()) == [0, 1, 3, 4, 5]
    assert set(metrics.score_images(table, made.observations.scenario, FRAMES, "m", 0)["frames"]) == {2}
    assert rendered.status == "ok"


def test_a_diverged_rollout_is_shown_as_far_as_it_goes_and_held_for_averages_over_all_runs(scene):
    record, table = scene.render(scene.roll(STEP, "diverged", frames=4), settings())
    assert (record.status, record.reason) == ("failed", "rollout: test")
    with av.open(scene.folder / "diverged" / "video.mp4") as video:
        assert sum(1 for _ in video.decode(video=0)) == 4
    _, whole = scene.render(scene.roll(STEP, "whole"), settings())
    assert mean(table, "iou", 3) == mean(whole, "iou", 3)
    # The picture of frame 3 against what is seen in frame 5.
    assert mean(table, "iou", FRAMES - 1) < mean(whole, "iou", FRAMES - 1)
    # Reconstruction is frames 1 to 3, the future 4 and 5.
    scores = metrics.score_images(table, scene.observations.scenario, 4, "m", 0)
    assert set(scores["task"]) == {"reconstruction"}


def test_what_cannot_be_trained_or_drawn_is_recorded_and_passed_on(scene, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(draw, "LEAST_OPACITY", 0.9999)
        rendered, table = scene.render(scene.roll(STEP, "faint"), settings())
    assert (rendered.status, table) == ("failed", None)
    assert "no splat has an opacity above 0.9999" in rendered.reason
    broken = changed(scene, appearance=tmp_path / "appearance" / "appearance.json")
    record = broken.learn(settings(appearance=dataclasses.replace(IMAGES.appearance, scale_rate=1e4)))
    assert record.status == "failed"
    rendered, _ = broken.render(scene.roll(STEP, "failed"), settings())
    assert (rendered.status, rendered.reason) == ("failed", record.reason)
    assert "splats are not finite" in rendered.reason


def test_a_frame_with_nothing_to_compare_has_no_psnr_and_is_counted(scene, tmp_path):
    """Hands all over frame 1 leave black on both sides."""
    capture = spoiled(scene, tmp_path / "covered")
    capture.folder.joinpath("mask").unlink()
    shutil.copytree(scene.capture.folder / "mask", capture.folder / "mask")
    cv2.imwrite(str(capture.path("mask", "0", 1)), np.full((SIZE[1], SIZE[0]), HANDS, np.uint8))
    record, table = changed(scene, capture=capture).render(scene.roll(STEP, "covered"), settings(video=False))
    assert record.facts["empty_frames"] == 1
    scores = metrics.score_images(table, scene.observations.scenario, FRAMES, "m", 0).set_index(["task", "metric"])
    assert np.isfinite(scores["value"]).all()
    assert scores.loc[("reconstruction", "psnr"), "frames"] == 2
    assert scores.loc[("reconstruction", "ssim"), "frames"] == 3


def test_pictures_of_any_camera_and_frame(scene, tmp_path):
    common = (scene.capture.folder, Before.load(scene.appearance), Before.load(scene.roll(STEP, "drawn")))
    made = draw_frames(*common, "2", [1, 4], "white", settings(), "cpu", tmp_path)
    assert [path.name for path in made] == ["00001.png", "00004.png"]
    white = cv2.imread(str(made[0]), cv2.IMREAD_UNCHANGED)
    black = cv2.imread(str(draw_frames(*common, "2", [1], "black", settings(), "cpu", tmp_path)[0]), cv2.IMREAD_UNCHANGED)
    assert white.shape == (SIZE[1], SIZE[0], 4)
    assert np.array_equal(white[..., 3], black[..., 3])
    # Over a background c the color is color over black + (1 - coverage) c.
    assert np.abs(white[..., :3].astype(int) - black[..., :3] - (255 - black[..., 3:].astype(int))).max() <= 2
    with pytest.raises(InputError, match="must be a camera of"):
        draw_frames(*common, "7", None, "black", settings(), "cpu", tmp_path)
    with pytest.raises(InputError, match=r"frames 0 to 5; received \[9\]"):
        draw_frames(*common, "0", [9], "black", settings(), "cpu", tmp_path)


def test_training_follows_its_seed(scene, tmp_path):
    again, learned = changed(scene, appearance=tmp_path / "appearance" / "appearance.json"), []
    for seed in (0, 1):
        again.learn(settings(appearance=SHORT), seed)
        learned.append(again.appearance.with_name("splats.ply").read_bytes())
    assert learned[0] != learned[1]


def test_pictures_from_the_side_keep_the_object_in_view(scene):
    gaussians = Gaussians.of(Splats.load(scene.appearance.with_name("splats.ply")))
    camera = scene.capture.cameras["0"]
    view = View.of(camera.camera_to_world, camera.intrinsics, camera.width, camera.height)
    pictures = [orbit_view(gaussians, view, "warp", angle) for angle in (0, 90, 180, 270)]
    for picture in pictures:
        dark = (picture.min(axis=2) < 200).mean()
        assert 0.01 < dark < 0.5
    with torch.no_grad():
        straight = gaussians.draw(view, background=(1.0, 1.0, 1.0)).rgb.clamp(0, 1).numpy()
    assert np.abs(pictures[0] / 255 - straight).max() < 0.02


def with_masks(scene, folder, labels):
    """The scene's masks, camera 0's replaced."""
    folder.mkdir()
    Masks(labels=labels, backend="given").save(folder / "masks.npz")
    Recorder("segment", folder / "masks.json").save({"masks": folder / "masks.npz"})
    return [folder / "masks.json", *scene.masks[1:]]


def test_masks_of_another_size_and_empty_ones_are_named(scene, tmp_path, capsys):
    made, short = changed(scene, appearance=tmp_path / "appearance.json"), settings(appearance=SHORT)
    made.masks = with_masks(scene, tmp_path / "small", np.ones((FRAMES, 45, 80), np.uint8))
    with pytest.raises(InputError, match=r"masks\.json.*size of camera 0.*\(6, 45, 80\)"):
        made.learn(short)
    made.masks = with_masks(scene, tmp_path / "empty", np.zeros((FRAMES, SIZE[1], SIZE[0]), np.uint8))
    record = made.learn(short)
    assert "camera 0: the object is not visible in frame 0" in capsys.readouterr().out
    assert record.facts["cameras"] == ["1", "2"]
    made.masks = made.masks[:1] * 3
    with pytest.raises(InputError, match="at least one camera must show the object"):
        made.learn(short)


@pytest.mark.parametrize("label", [HANDS, PERSON])
def test_points_beside_a_hand_or_a_person_become_no_splats(scene, label):
    """The borders of masks are off by pixels: what a mask of the object has there may be a finger."""
    capture = scene.capture
    masks = {}
    for name in capture.cameras:
        own = np.stack([capture.mask(name, 0)] * FRAMES)
        masks[name] = Masks(labels=np.where(own == HANDS, label, own).astype(np.uint8), backend="given")
    camera, labels = capture.cameras["0"], masks["0"].labels
    y, x = np.nonzero(labels[0] == OBJECT)
    away = cv2.distanceTransform((labels[0] != label).astype(np.uint8), cv2.DIST_L2, 5)[y, x]
    points = camera.lift(np.stack([x, y], axis=1).astype(float), capture.depth("0", 0)[y, x])
    one = Capture(capture.folder, dataclasses.replace(capture.description, cameras=capture.description.cameras[:1]))
    depths = {"0": capture.depth("0", 0)}
    found = beside_hands(one, masks, depths, points)
    assert found[away <= 1].all() and found.any()
    assert not found[away > 3].any()
    # What the camera sees something else before is not judged by that pixel.
    behind = camera.lift(np.stack([x, y], axis=1).astype(float), capture.depth("0", 0)[y, x] + 0.05)
    assert not beside_hands(one, masks, depths, behind).any()


def test_processed_data_need_no_lifted_points(scene, tmp_path):
    """As of PhysTwin's released cases: masks are lifted, surface points of the observations stand for the shape prior."""
    output, seen = tmp_path / "appearance.json", scene.folder / "observations.npz"
    appearance(
        capture=scene.capture.folder / "capture.json",
        masks=scene.masks,
        settings=settings(),
        seed=0,
        device="cpu",
        output=output,
        observations=seen,
    )
    facts = StageRecord.load(output).facts
    assert facts["unseen_surface"] is None
    assert all(facts[f"psnr_{name}"] > 25 for name in scene.capture.cameras)
