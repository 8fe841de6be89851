"""check-data on capture folders: a valid capture has no errors or warnings, and every other finding is provoked once."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neuspring.checks.objects import of_body
from neuspring.core.geometry import rigid_inverse
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Capture
from neuspring.intake.check import check_layout
from tests.support.filmed import film
from tests.support.findings import holds, of_level, serious

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    return film(tmp_path_factory.mktemp("filmed") / "film", cameras=2)


@pytest.fixture
def both(filmed, tmp_path):
    """Both cameras, to change."""
    return Capture.load(shutil.copytree(filmed.folder, tmp_path / "film"))


@pytest.fixture
def capture(both):
    """One camera of it."""
    edit(both, lambda values: values.update(cameras=values["cameras"][:1]))
    return Capture.load(both.folder)


def edit(capture, change):
    path = capture.folder / CAPTURE
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


def moved(change, camera=0):
    """A change of one camera's pose."""

    def apply(values):
        entry = values["cameras"][camera]
        entry["camera_to_world"] = change(np.array(entry["camera_to_world"])).tolist()

    return apply


def shifted(x=0.0, y=0.0, z=0.0, tilt=0.0):
    """A motion of the world: a tilt about x, degrees, then a shift, m."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_euler("x", tilt, degrees=True).as_matrix(), (x, y, z)
    return lambda pose: motion @ pose


def lens(values):
    for row in (0, 1):
        values["cameras"][0]["intrinsics"][row][2] *= 0.6


def test_a_good_film_has_no_errors_and_warnings_and_a_contact_sheet(filmed, tmp_path):
    found = check_layout(filmed.folder)
    assert serious(found) == [] == serious(check_layout(filmed.folder.parent))
    assert holds(found, "note", CAPTURE, "camera 1: size of the object") and holds(found, "note", "contact_sheet.jpg", "look at it")
    sheet = cv2.imread(str(filmed.folder / "contact_sheet.jpg"))
    assert sheet.shape == (2 * 270 + 26, 4 * 480, 3)
    # Outlines, the axes of the world and the dots of the other camera are drawn.
    tile = cv2.resize(filmed.color("0", 0), (480, 270), interpolation=cv2.INTER_AREA)[..., ::-1]
    assert (np.abs(sheet[:270, :480].astype(int) - tile).max(axis=-1) > 60).mean() > 0.02
    down = film(tmp_path / "down", cameras=1, up="-z")
    assert serious(check_layout(down.folder)) == []


@pytest.mark.parametrize(
    ("change", "name", "level"),
    [
        (moved(shifted(z=0.05)), "table elsewhere", "warning"),
        (moved(shifted(tilt=5.0)), "table elsewhere", "warning"),
        (moved(shifted(tilt=40.0)), "table elsewhere", "error"),
        (moved(rigid_inverse), "table elsewhere", "error"),
        (moved(lambda pose: pose @ OPENGL), "view of the table", "warning"),
        (lambda values: values.update(up="-z"), "view of the table", "warning"),
        (lambda values: values.update(depth_unit=0.0015), "table elsewhere", "error"),
        (lambda values: values.update(depth_unit=1.0), "depth unit", "error"),
        (lens, "principal point", "warning"),
        (moved(shifted(z=-0.08)), "object below the table", "warning"),
    ],
)
def test_a_description_that_contradicts_the_images(capture, change, name, level):
    edit(capture, change)
    found = [one for one in check_layout(capture.folder) if one.name == name]
    assert [(Path(one.where).name, one.level) for one in found] == [(CAPTURE, level)]


def rewrite_depth(capture, change, names="0"):
    for name in names:
        for frame in range(capture.frame_count):
            path = capture.path("depth", name, frame)
            depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(path), change(depth, capture.mask(name, frame)).astype(np.uint16))


def test_depth_as_the_distance_to_the_camera(capture):
    camera = capture.cameras["0"]
    y, x = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
    rewrite_depth(capture, lambda depth, mask: np.round(depth * np.linalg.norm(rays, axis=-1)))
    assert holds(check_layout(capture.folder), "warning", CAPTURE, "depth along the axis", "z = r / sqrt")


@pytest.mark.parametrize(
    "change", [moved(shifted(x=0.05), camera=1), lambda values: exchange(values["cameras"])], ids=["one pose", "the order"]
)
def test_cameras_that_disagree(both, change):
    edit(both, change)
    names = {one.name for one in check_layout(both.folder) if one.level != "note"}
    assert names & {"views disagree", "table elsewhere"}


def exchange(cameras):
    one, two = (camera["camera_to_world"] for camera in cameras)
    cameras[0]["camera_to_world"], cameras[1]["camera_to_world"] = two, one


def reaching(labels, frame):
    """The hand with its arm, and 1 and 2 exchanged."""
    row, column = np.argwhere(labels == HANDS).mean(axis=0).astype(int)
    labels[row : row + 4, column:] = HANDS
    return np.choose(labels, [0, HANDS, OBJECT])


def block(labels, frame):
    if frame == 3:
        labels[20:70, 20:140] = OBJECT
    return labels


def hand_elsewhere(labels, frame):
    labels[labels == HANDS] = 0
    labels[-20:-2, 4:24] = HANDS
    return labels


@pytest.mark.parametrize(
    ("change", "name", "value"),
    [
        (lambda labels, _: np.where(labels == OBJECT, 0, labels), "no object in frame 0", 0),
        (lambda labels, _: np.where(labels == HANDS, 0, labels), "no hand in frame 0", 0),
        (lambda labels, frame: np.where((labels == OBJECT) & (frame > 3), 0, labels), "object missing", 2),
        (lambda labels, frame: np.where((labels == 0) & (frame > 2), OBJECT, labels), "background in the mask", None),
        (block, "mask jumps", None),
        (reaching, "labels exchanged", 1.0),
        (lambda labels, _: np.where(labels == 0, HANDS, labels), "hands too large", None),
        (hand_elsewhere, "hand far from the object", 0.212),
    ],
)
def test_masks_that_show_something_else(capture, change, name, value):
    for frame in range(capture.frame_count):
        labels = change(capture.mask("0", frame).copy(), frame)
        cv2.imwrite(str(capture.path("mask", "0", frame)), labels.astype(np.uint8))
    found = check_layout(capture.folder)
    assert of_level(found, "error") == []
    (one,) = (one for one in found if one.name == name)
    assert one.level == "warning" and value in (None, pytest.approx(one.value, rel=0.005))


def test_an_object_that_frame_0_does_not_show_is_one_finding(capture):
    labels = capture.mask("0", 0)
    cv2.imwrite(str(capture.path("mask", "0", 0)), np.where(labels == OBJECT, 0, labels))
    assert [one.name for one in check_layout(capture.folder) if one.level != "note"] == ["no object in frame 0"]


def test_what_is_wrong_with_every_mask_is_reported_once(capture):
    for frame in range(capture.frame_count):
        cv2.imwrite(str(capture.path("mask", "0", frame)), np.repeat(capture.mask("0", frame)[..., None], 3, axis=2))
    found = of_level(check_layout(capture.folder), "error")
    assert len(found) == 1
    assert "00000.png: masks must be gray, palette or one-bit images; received 3 color" in found[0]
    assert found[0].endswith("5 more files of the folder have the same fault.")


def test_an_object_without_depth_and_repeated_images(capture):
    rewrite_depth(capture, lambda depth, mask: np.where((mask == OBJECT) & (np.arange(mask.shape[1]) % 2 == 0), 0, depth))
    assert holds(check_layout(capture.folder), "warning", CAPTURE, "depth holes", "pixels without depth: 5")
    for kind in ("color", "depth"):
        shutil.copyfile(capture.path(kind, "0", 2), capture.path(kind, "0", 3))
    found = [one for one in check_layout(capture.folder) if one.name == "repeated images"]
    assert [(one.value, one.frames, one.level) for one in found] == [(1, (3,), "warning")] * 2


def test_images_of_another_size_or_missing(both):
    cv2.imwrite(str(both.path("depth", "1", 2)), np.zeros((10, 20), np.uint16))
    both.path("color", "1", 4).unlink()
    found = check_layout(both.folder)
    assert holds(found, "error", "00002.png", "160 x 90", "received 20 x 10")
    assert holds(found, "error", "00004.png", "cameras.1.missing")


def test_a_body_in_parts_and_one_of_few_points_keep_all_of_them():
    body = np.random.default_rng(0).uniform(0, 0.1, (400, 3))
    parted = np.concatenate([body, body[:40] + np.array([0.4, 0, 0])])
    few = np.array([[0.05, 0.02, 0], [0.06, 0.02, 0], [0.3, 0.1, 0], [0.5, 0.4, 0], [0.2, 0.3, 0.1]])
    strays = np.concatenate([body, [[0.0, 0, -0.7], [0.01, 0, -0.7], [0, 0.01, -0.71], [0, 0, 2.0]]])
    for unit in (1.0, 1000.0):
        assert all(of_body(unit * points).all() for points in (body, parted, few[2:], body[:1]))
        assert of_body(unit * strays).tolist() == [True] * 400 + [False] * 4
    assert of_body(body[:0]).tolist() == []


def test_constant_grips_are_proposed(filmed):
    from neuspring.checks import examine

    counts = np.array([1] * 40 + [2] * 60 + [0] * 20)
    (found,) = examine("grips", "capture.json", counts, 30.0, Path("captures/x"))
    assert "0-39: 1, 40-99: 2, 100-119: 0" in found.text and "cut-capture captures/x --frames 40-99 or --frames 0-39" in found.text
    assert examine("grips", "capture.json", np.ones(40), 30.0, Path("x")) == []
