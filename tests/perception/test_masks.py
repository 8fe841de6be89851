"""Masks on disk, and the command that makes them, which repeats nothing."""

import json
import shutil

import cv2
import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.core.errors import InputError
from neuspring.data import frames
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.perception.film import CameraFilm, Carried
from neuspring.perception.marks import Marks
from neuspring.perception.masks import MasksFile, has_masks, save_carried, save_masks
from tests.support.extensions import with_extensions
from tests.support.filmed import FRAMES, film
from tests.support.marked import mark, overlap


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """Two cameras, the second one lacks a frame, without masks; the truth is kept aside."""
    folder = tmp_path_factory.mktemp("film")
    capture = film(folder, cameras=2, missing={1: (3,)})
    (folder / "mask").rename(folder / "truth")
    text = json.loads((folder / "capture.json").read_text())
    (folder / "capture.json").write_text(json.dumps(text | {"masks": False}))
    cameras = {}
    for camera in capture.cameras:
        truth = cv2.imread(str(folder / "truth" / camera / "00000.png"), cv2.IMREAD_UNCHANGED)
        cameras[camera] = tuple(polygon(truth, label, name) for label, name in ((OBJECT, "object"), (HANDS, "hand")))
    Marks(cameras=cameras).save(folder / "marks.json")
    return folder


@pytest.fixture
def folder(original, tmp_path):
    return shutil.copytree(original, tmp_path / "capture")


def polygon(truth, label, name):
    """A coarse outline, as a user draws it."""
    outlines, _ = cv2.findContours((truth == label).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    coarse = cv2.approxPolyDP(max(outlines, key=cv2.contourArea), 1.5, True)[:, 0]
    return mark(name, "polygon", [tuple(map(float, point)) for point in coarse], radius=2.0)


def test_masks_of_another_tool_become_those_of_a_capture(folder, tmp_path, capsys):
    truth = {name: folder / "truth" / name for name in ("0", "1")}
    assert main(["mask", str(folder), "--masks", str(truth["0"]), str(truth["1"])]) == 0
    assert f"camera 1: masks are in {folder}/mask/1" in capsys.readouterr().out
    capture = Capture.load(folder)
    assert capture.description.masks
    labels = capture.mask("0", 2)
    assert set(np.unique(labels)) == {0, OBJECT, HANDS}
    np.testing.assert_array_equal(labels, cv2.imread(str(truth["0"] / "00002.png"), cv2.IMREAD_UNCHANGED))
    # The same as a tool with a folder per thing writes it: each with a number of its own.
    for name, label, number in (("thing", OBJECT, 255), ("fingers", HANDS, 3)):
        (tmp_path / name).mkdir()
        for path in truth["0"].iterdir():
            mask = (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) == label) * number
            cv2.imwrite(str(tmp_path / name / path.name), mask.astype(np.uint8))
    words = ["mask", str(folder), "--cameras", "0", "--masks", str(tmp_path / "thing")]
    assert main([*words, "--hands", str(tmp_path / "fingers")]) == 0
    np.testing.assert_array_equal(capture.mask("0", 2), labels)
    assert main(words) == 0
    np.testing.assert_array_equal(capture.mask("0", 2) == OBJECT, labels == OBJECT)


def test_masks_of_another_tool_that_do_not_fit(folder, capsys):
    truth = folder / "truth"
    assert main(["mask", str(folder), "--masks", str(truth / "0")]) == 2
    assert "one folder is required per camera (0 1); --cameras selects cameras; received 1 and 0" in capsys.readouterr().err
    whole = cv2.imread(str(truth / "0" / "00000.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(truth / "0" / "00000.png"), whole[::2, ::2])
    assert main(["mask", str(folder), "--masks", str(truth / "0"), "--cameras", "0"]) == 2
    assert "masks must have the size of the images of camera 0" in capsys.readouterr().err
    cv2.imwrite(str(truth / "0" / "00000.png"), whole)
    (truth / "0" / "00004.png").rename(truth / "0" / "00044.png")
    assert main(["mask", str(folder), "--masks", str(truth / "0"), "--cameras", "0"]) == 2
    assert "a mask of frame 4 of camera 0 is required, named by its frame number: 00004.png; received" in capsys.readouterr().err


@with_extensions
def test_marks_become_the_masks_of_a_capture(folder, capsys):
    assert main(["mask", str(folder)]) == 0
    out, err = capsys.readouterr()
    assert "camera 0: most doubtful frames: " in out
    assert "camera 1 8/8" not in out
    assert "camera 1 8/8" in err
    capture = Capture.load(folder)
    assert capture.description.masks
    for camera in capture.cameras:
        for frame in range(FRAMES):
            if capture.has(camera, frame):
                truth = cv2.imread(str(folder / "truth" / camera / f"{frame:05d}.png"), cv2.IMREAD_UNCHANGED)
                assert overlap(capture.mask(camera, frame), truth, OBJECT) > 0.85, (camera, frame)
                assert overlap(capture.mask(camera, frame), truth, HANDS) > 0.8, (camera, frame)
    assert not capture.path("mask", "1", 3).exists()
    assert cv2.imread(str(folder / "mask_0.png")).shape[1] == 4 * 160
    assert len(MasksFile.of(capture).cameras["0"].doubt) == FRAMES

    times = {path: path.stat().st_mtime_ns for path in (folder / "mask").rglob("*.png")}
    assert main(["mask", str(folder)]) == 0
    assert "camera 0: annotations, images and settings are unchanged; its masks are kept" in capsys.readouterr().out
    assert times == {path: path.stat().st_mtime_ns for path in (folder / "mask").rglob("*.png")}

    marks = Marks.load(folder / "marks.json")
    Marks(cameras=marks.cameras | {"1": (*marks.of("1"), mark("ignore", "click", [(2, 2)]))}).save(folder / "marks.json")
    assert main(["mask", str(folder)]) == 0
    out = capsys.readouterr().out
    assert "camera 0: annotations, images and settings are unchanged" in out
    assert "camera 1: masks are in" in out


def test_masks_are_announced_when_every_camera_has_them(folder):
    capture = Capture.load(folder)
    for camera, announced in (("0", False), ("1", True)):
        save_masks(capture, camera, np.ones((FRAMES, 90, 160), np.uint8))
        assert Capture.load(folder).description.masks == announced
    assert has_masks(capture)


def test_masks_that_are_half_written_are_not_taken_for_those_before(folder, monkeypatch):
    capture = Capture.load(folder)
    carried = Carried(np.ones((FRAMES, 90, 160), np.uint8), np.zeros(FRAMES))
    save_carried(capture, "0", carried, "sha256:before", "marks")
    assert MasksFile.of(capture).holds(capture, "0", "sha256:before")

    def full(path, write):
        raise OSError("no space left on device")

    monkeypatch.setattr(frames, "write_atomically", full)
    with pytest.raises(OSError, match="no space"):
        save_masks(capture, "0", np.zeros((FRAMES, 90, 160), np.uint8))
    assert not MasksFile.of(capture).holds(capture, "0", "sha256:before")


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (np.zeros((FRAMES, 90, 161), np.uint8), r"labels must be uint8 of shape \(6, 90, 160\)"),
        (np.full((FRAMES, 90, 160), 4, np.uint8), "labels must be 0 .* received 4"),
    ],
)
def test_masks_that_do_not_fit_are_refused(folder, labels, message):
    with pytest.raises(InputError, match=message):
        save_masks(Capture.load(folder), "0", labels)
    assert not (folder / "mask").exists()


def test_frames_have_heights_above_the_table(folder):
    height = CameraFilm(Capture.load(folder), "0").height(0)
    truth = cv2.imread(str(folder / "truth" / "0" / "00000.png"), cv2.IMREAD_UNCHANGED)
    assert abs(np.nanmedian(height[truth == 0])) < 0.003
    assert np.nanmedian(height[truth == OBJECT]) > 0.03


@with_extensions
def test_a_camera_without_marks_and_damaged_files_are_named(folder, capsys):
    Marks(cameras={"0": Marks.load(folder / "marks.json").of("0")}).save(folder / "one.json")
    assert main(["mask", str(folder), "--marks", str(folder / "one.json"), "--cameras", "1"]) == 2
    assert "camera 1 requires annotations; received ['0']" in capsys.readouterr().err
    (folder / "masks.json").write_text("[]")
    assert main(["mask", str(folder)]) == 2
    assert "masks.json: a JSON object is required; received list. Delete this file" in capsys.readouterr().err


def test_masks_are_compared_frame_by_frame(folder, capsys):
    one, two = folder / "one", folder / "two"
    for path, width in ((one, 10), (two, 5)):
        path.mkdir()
        image = np.zeros((20, 20), np.uint8)
        image[:10, :width] = OBJECT
        cv2.imwrite(str(path / "0003.png"), image)
    assert main(["compare-masks", str(one), str(two)]) == 0
    assert "    3   0.500" in capsys.readouterr().out
    cv2.imwrite(str(two / "4.png"), image)
    assert main(["compare-masks", str(one), str(two)]) == 2
    assert "a mask of frame 4 is required" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("shirt", "seen"), [((200, 195, 190), frames.TINTS[HANDS]), ((110, 125, 190), None)], ids=["a gray shirt", "a blue shirt"]
)
def test_masks_are_drawn_in_colors_that_the_picture_does_not_have(shirt, seen):
    image, labels = np.full((60, 80, 3), shirt, np.uint8), np.zeros((60, 80), np.uint8)
    labels[20:40, 20:40], labels[20:40, 45:60] = OBJECT, HANDS
    image[labels == HANDS] = skin = np.array([200, 150, 125])
    tints = frames.tints_of(image, labels)
    assert tints[OBJECT] == frames.TINTS[OBJECT]
    assert tints[HANDS] == seen if seen else tints[HANDS] in frames.OTHERS
    drawn = frames.overlay(image, labels, tints)
    np.testing.assert_array_equal(drawn[5, 5], shirt)
    np.testing.assert_allclose(drawn[30, 50], 0.6 * skin + 0.4 * np.array(tints[HANDS]), atol=1)
