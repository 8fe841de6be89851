"""Every finding of plausibility provoked once, on a small film: what check-data then says, and what it says to do."""

import json
import shutil

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Capture
from neuspring.data.check import check_layout
from neuspring.data.intake.lenses import rigid_inverse
from tests.support.filmed import film
from tests.support.findings import of_level, serious

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    return film(tmp_path_factory.mktemp("filmed") / "film", cameras=2)


@pytest.fixture
def capture(filmed, tmp_path):
    """One camera of it, to change."""
    copy = Capture.load(shutil.copytree(filmed.folder, tmp_path / "film"))
    edit(copy, lambda values: values.update(cameras=values["cameras"][:1]))
    return Capture.load(copy.folder)


def edit(capture, change) -> None:
    path = capture.folder / CAPTURE
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


def move(capture, change, camera=0) -> None:
    def apply(values):
        entry = values["cameras"][camera]
        entry["camera_to_world"] = change(np.array(entry["camera_to_world"])).tolist()

    edit(capture, apply)


def shifted(x=0.0, y=0.0, z=0.0, tilt=0.0):
    """A motion of the world: a tilt about x, degrees, then a shift, m."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_euler("x", tilt, degrees=True).as_matrix(), (x, y, z)
    return lambda pose: motion @ pose


def relabel(capture, change) -> None:
    for frame in range(capture.frame_count):
        labels = change(capture.mask("0", frame).copy())
        cv2.imwrite(str(capture.path("mask", "0", frame)), labels.astype(np.uint8))


def errors(capture) -> str:
    return "\n".join(of_level(check_layout(capture.folder), "error"))


def warnings(capture) -> str:
    found = check_layout(capture.folder)
    assert of_level(found, "error") == []
    return "\n".join(of_level(found, "warning"))


def test_a_good_film_has_measurements_only(filmed):
    found = check_layout(filmed.folder)
    assert serious(found) == []
    notes = "\n".join(of_level(found, "note"))
    assert "camera 0: the table is 0 mm" in notes and "looking down at it by 30 degrees" in notes
    assert "camera 1: depth holes: 0% of the object's pixels have no depth" in notes
    assert "camera 0, object: size of the object: " in notes and "cm above the table" in notes
    assert "cameras 0 and 1 agree: 0% of the points" in notes


def test_a_film_in_a_world_with_z_down(tmp_path):
    assert serious(check_layout(film(tmp_path / "down", cameras=1, up="-z").folder)) == []


def test_a_table_that_is_off(capture):
    move(capture, shifted(z=0.05))
    text = warnings(capture)
    assert "cameras.0.camera_to_world: the table that the camera sees should be z = 0; received 50 mm above z = 0" in text
    assert "`neuspring make-capture --level` puts the table at z = 0" in text


def test_a_table_that_is_tilted(capture):
    move(capture, shifted(tilt=5.0))
    assert "tilted by 5.0 degrees" in warnings(capture)


def test_a_table_that_is_elsewhere(capture):
    move(capture, shifted(tilt=40.0))
    assert "the table that the camera sees must be z = 0; received" in errors(capture)
    assert "tilted by 40.0 degrees" in errors(capture)


def test_up_that_is_down(capture):
    edit(capture, lambda values: values.update(up="-z"))
    rule = (
        "up: must be the side of the table on which the cameras are: +z; received -z, by which camera 0 is 400 mm below the table"
    )
    assert rule in errors(capture)


def test_the_inverse_of_a_pose(capture):
    move(capture, rigid_inverse)
    assert "received what looks like a world-to-camera matrix. Invert it" in errors(capture)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda pose: pose @ OPENGL, "a matrix for OpenGL's axes"),
        (lambda pose: rigid_inverse(pose @ OPENGL), "a world-to-camera matrix for OpenGL"),
    ],
)
def test_axes_of_opengl(capture, change, what):
    move(capture, change)
    assert f"received what looks like {what}" in errors(capture)


def test_a_unit_of_depth_ten_times_too_large(capture):
    edit(capture, lambda values: values.update(depth_unit=0.01))
    text = "depth_unit: the table must be as far from camera 0 as its pose says; received 0.01, which makes it 10 times as far"
    assert f"{text}. Plausible would be 0.001" in errors(capture)


def test_a_unit_of_depth_by_which_all_is_large(capture):
    def enlarge(values):
        values["depth_unit"] = 0.01
        for row in values["cameras"][0]["camera_to_world"][:3]:
            row[3] *= 10

    edit(capture, enlarge)
    text = warnings(capture)
    assert "a camera should be at most 3 m above the table; received 4.00 m. Check depth_unit" in text
    assert "camera 0, object: implausible size: 13" in text and "cm long; 2 to 120 cm are expected" in text
    assert "object high above the table: it is up to" in text


@pytest.mark.parametrize("rate", [3000.0, 0.033])
def test_a_frame_rate_that_no_camera_has(capture, rate):
    edit(capture, lambda values: values.update(frame_rate=rate))
    assert f"frame_rate: frames per second at which it was filmed are required, 1 to 240; received {rate:g}" in errors(capture)


def test_an_object_below_the_table(capture):
    move(capture, shifted(z=-0.08))
    assert "camera 0, object: object below the table: it reaches 4.5 cm" in warnings(capture)


def test_an_object_without_depth(capture):
    for frame in range(capture.frame_count):
        path = capture.path("depth", "0", frame)
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        y, x = np.nonzero(capture.mask("0", frame) == OBJECT)
        depth[y[x % 2 == 0], x[x % 2 == 0]] = 0
        cv2.imwrite(str(path), depth)
    text = warnings(capture)
    assert "camera 0: depth holes: 50% of the object's pixels have no depth" in text
    assert "Film from farther than the sensor's least distance" in text


def test_an_object_at_the_border(capture):
    def extend(labels):
        row = int(np.nonzero((labels == OBJECT).any(axis=1))[0].mean())
        labels[row : row + 3, : int(np.nonzero(labels[row] == OBJECT)[0].min())] = OBJECT
        return labels

    relabel(capture, extend)
    text = warnings(capture)
    assert "camera 0: object at the border: the object touches the image border in 6 frames, first in frame 0" in text


def test_hands_that_are_the_table(capture):
    relabel(capture, lambda labels: np.where(labels == 0, HANDS, labels))
    text = warnings(capture)
    assert "camera 0: hands too large: hands (label 2) of " in text and "less than 1200 cm² and 12 times" in text
    assert "Sleeves, torso or table are no hands" in text


def test_a_hand_that_never_comes_near(capture):
    def elsewhere(labels):
        labels[labels == HANDS] = 0
        labels[-20:-2, 4:24] = HANDS
        return labels

    relabel(capture, elsewhere)
    assert "camera 0: hand far from the object: the hand is never nearer to the object than" in warnings(capture)


def test_cameras_that_disagree(filmed, tmp_path):
    copy = Capture.load(shutil.copytree(filmed.folder, tmp_path / "film"))
    move(copy, shifted(x=0.05), camera=1)
    text = warnings(copy)
    assert "cameras 0 and 1 should see the same surfaces above the table in the same place; received" in text
    assert "Calibrate again with one board that both see" in text


def test_a_table_that_is_not_seen(capture):
    for frame in range(capture.frame_count):
        path = capture.path("depth", "0", frame)
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), np.where(capture.mask("0", frame) == OBJECT, depth, 0).astype(np.uint16))
    assert any("z = 0 and up are not checked" in text for text in of_level(check_layout(capture.folder), "note"))
