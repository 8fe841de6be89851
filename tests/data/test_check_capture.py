"""check-data on capture folders: a good one has measurements only, and every other finding is provoked once."""

import json
import shutil

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Capture, Writer
from neuspring.data.check import check_layout
from neuspring.data.intake.lenses import rigid_inverse
from tests.support.captures import describe, entry
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


def edit(capture, change) -> None:
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


def enlarged(values) -> None:
    values["depth_unit"] = 0.01
    for row in values["cameras"][0]["camera_to_world"][:3]:
        row[3] *= 10


def test_a_good_film_has_measurements_only(filmed, tmp_path):
    found = check_layout(filmed.folder)
    assert serious(found) == [] == serious(check_layout(filmed.folder.parent))
    for words in (("camera 0: the table is 0 mm",), ("camera 1", "depth holes: 0%"), ("size of the object",), ("cameras 0 and 1",)):
        assert holds(found, "note", CAPTURE, *words)
    assert serious(check_layout(film(tmp_path / "down", cameras=1, up="-z").folder)) == []


@pytest.mark.parametrize(
    ("change", "level", "words"),
    [
        (moved(shifted(z=0.05)), "warning", ("cameras.0.camera_to_world", "50 mm above z = 0", "--level")),
        (moved(shifted(tilt=5.0)), "warning", ("tilted by 5.0 degrees",)),
        (moved(shifted(tilt=40.0)), "error", ("must be z = 0", "tilted by 40.0 degrees")),
        (lambda values: values.update(up="-z"), "error", ("up", "received -z", "400 mm below the table")),
        (moved(rigid_inverse), "error", ("what looks like a world-to-camera matrix. Invert it",)),
        (moved(lambda pose: pose @ OPENGL), "error", ("what looks like a matrix for OpenGL's axes",)),
        (moved(lambda pose: rigid_inverse(pose @ OPENGL)), "error", ("a world-to-camera matrix for OpenGL",)),
        (lambda values: values.update(depth_unit=0.01), "error", ("depth_unit", "10 times as far", "Plausible would be 0.001")),
        (lambda values: values.update(depth_unit=1.0), "error", ("depth_unit", "between 0.1 and 10 m")),
        (enlarged, "warning", ("at most 3 m above the table", "received 4.00 m")),
        (enlarged, "warning", ("implausible size: 13",)),
        (enlarged, "warning", ("object high above the table",)),
        (lambda values: values.update(frame_rate=3000.0), "error", ("frame_rate", "received 3000")),
        (lambda values: values.update(frame_rate=0.033), "error", ("frame_rate", "received 0.033")),
        (moved(shifted(z=-0.08)), "warning", ("object below the table", "4.5 cm")),
        (lambda values: values["cameras"][0]["camera_to_world"][0].__setitem__(0, 3.0), "error", ("must be a rotation",)),
    ],
)
def test_a_description_that_contradicts_the_images(capture, change, level, words):
    edit(capture, change)
    assert holds(check_layout(capture.folder), level, CAPTURE, *words)


def second(labels, frame):
    labels[2:22, 2:22] = OBJECT
    return labels


def extended(labels, frame):
    row = int(np.nonzero((labels == OBJECT).any(axis=1))[0].mean())
    labels[row : row + 3, : int(np.nonzero(labels[row] == OBJECT)[0].min())] = OBJECT
    return labels


def hand_elsewhere(labels, frame):
    labels[labels == HANDS] = 0
    labels[-20:-2, 4:24] = HANDS
    return labels


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda labels, _: np.where(labels == OBJECT, 0, labels), ("no object in frame 0",)),
        (lambda labels, _: np.where(labels == HANDS, 0, labels), ("no hand in frame 0",)),
        (second, ("two objects", "2 pieces")),
        (
            lambda labels, frame: np.where((labels == OBJECT) & (frame > 3), 0, labels),
            ("object missing", "2 frames, first in"),
        ),
        (extended, ("object at the border", "6 frames")),
        (lambda labels, _: np.where(labels == 0, HANDS, labels), ("hands too large", "less than 1200 cm² and 12 times")),
        (hand_elsewhere, ("hand far from the object",)),
    ],
)
def test_masks_that_show_something_else(capture, change, words):
    for frame in range(capture.frame_count):
        labels = change(capture.mask("0", frame).copy(), frame)
        cv2.imwrite(str(capture.path("mask", "0", frame)), labels.astype(np.uint8))
    found = check_layout(capture.folder)
    assert of_level(found, "error") == []
    assert any(holds(found, "warning", file, "camera 0", *words) for file in (CAPTURE, "0"))


def test_what_is_wrong_with_every_mask_is_said_once(capture):
    for frame in range(capture.frame_count):
        cv2.imwrite(str(capture.path("mask", "0", frame)), np.repeat(capture.mask("0", frame)[..., None], 3, axis=2))
    found = of_level(check_layout(capture.folder), "error")
    assert len(found) == 1
    assert "00000.png: masks are gray, palette or one-bit images; received 3 channels" in found[0]
    assert found[0].endswith("The same in 5 more files of the folder.")


def test_depth_of_a_sensor_that_stands_elsewhere(capture):
    rewrite_depth(capture, lambda depth, mask: np.roll(depth, 8, axis=1))
    words = ("camera 0: depth not aligned to color", "moved 8 pixels to the left", "rs.align")
    assert holds(check_layout(capture.folder), "warning", CAPTURE, *words)


def rewrite_depth(capture, change) -> None:
    for frame in range(capture.frame_count):
        path = capture.path("depth", "0", frame)
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), change(depth, capture.mask("0", frame)).astype(np.uint16))


def test_an_object_without_depth_and_a_table_that_is_not_seen(capture):
    rewrite_depth(capture, lambda depth, mask: np.where((mask == OBJECT) & (np.arange(mask.shape[1]) % 2 == 0), 0, depth))
    assert holds(check_layout(capture.folder), "warning", CAPTURE, "depth holes: 50%", "Film from farther")
    rewrite_depth(capture, lambda depth, mask: np.where(mask == OBJECT, depth, 0))
    assert holds(check_layout(capture.folder), "note", CAPTURE, "z = 0 and up are not checked")


def test_cameras_that_disagree(both):
    edit(both, moved(shifted(x=0.05), camera=1))
    assert holds(check_layout(both.folder), "warning", CAPTURE, "cameras 0 and 1 should see the same", "Calibrate again")


def test_images_of_another_size_or_missing(both):
    cv2.imwrite(str(both.path("depth", "1", 2)), np.zeros((10, 20), np.uint16))
    both.path("color", "1", 4).unlink()
    found = check_layout(both.folder)
    assert holds(found, "error", "00002.png", "160 x 90", "received 20 x 10")
    assert holds(found, "error", "00004.png", "cameras.1.missing")


def test_an_object_inside_an_obstacle(capture):
    around = {"shape": "sphere", "center": [0.0, 0.0, 0.0], "radius": 5.0}
    beside = {"shape": "box", "center": [0.0, 9.0, 0.0], "half_sizes": [1.0, 1.0, 1.0]}
    edit(capture, lambda values: values.update(obstacles=[beside]))
    assert of_level(check_layout(capture.folder), "error") == []
    edit(capture, lambda values: values.update(obstacles=[beside, around]))
    assert holds(check_layout(capture.folder), "error", CAPTURE, "obstacles[1]", "100% more than 10 mm inside")


def test_times_with_one_constant_grip_are_proposed(tmp_path):
    """Of two hands one lets go in frame 20 of 60; at 10 frames/s both times last longer than a second."""
    writer = Writer(tmp_path, describe(frame_count=60, frame_rate=10.0, cameras=(entry(width=120, height=68),)))
    for frame in range(60):
        labels = np.zeros((68, 120), np.uint8)
        labels[20:50, 40:80], labels[20:40, 30:40] = OBJECT, HANDS
        labels[20:40, 80:90] = HANDS if frame < 20 else 0
        writer.frame("0", frame, np.zeros((68, 120, 3), np.uint8), np.full((68, 120), 900, np.uint16), labels)
    found = check_layout(writer.finish().folder)
    words = ("hands within 6 cm of the object, by frames: 0-19: 2, 20-59: 1.", "--frames 20-59 or --frames 0-19 --output")
    assert holds(found, "note", CAPTURE, *words)
