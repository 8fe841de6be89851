"""check-data on capture folders: a good one has no errors; each finding names file, rule and value."""

import json

import cv2
import numpy as np
import pytest

from neuspring.data.capture import CAPTURE
from neuspring.data.check import check_layout
from tests.support.filmed import film
from tests.support.findings import of_level, serious


@pytest.fixture
def capture(tmp_path):
    return film(tmp_path / "film", cameras=2)


def edit(capture, change) -> None:
    path = capture.folder / CAPTURE
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


def errors(capture) -> str:
    return "\n".join(of_level(check_layout(capture.folder), "error"))


def test_a_good_capture_and_a_folder_of_them(capture):
    assert serious(check_layout(capture.folder)) == []
    assert serious(check_layout(capture.folder.parent)) == []


def test_depth_in_the_wrong_unit(capture):
    edit(capture, lambda values: values.update(depth_unit=1.0))
    assert "the median depth of camera 0 must lie between 0.1 and 10 m, with the unit of the images" in errors(capture)


def test_depth_of_another_size(capture):
    cv2.imwrite(str(capture.path("depth", "1", 2)), np.zeros((10, 20), np.uint16))
    assert "00002.png: camera 1 has images of 160 x 90; received 20 x 10" in errors(capture)


def test_a_camera_that_is_no_rotation(capture):
    edit(capture, lambda values: values["cameras"][0]["camera_to_world"][0].__setitem__(0, 3.0))
    assert "cameras.0.camera_to_world: the upper left 3 x 3 block must be a rotation" in errors(capture)


def test_a_frame_that_is_missing_but_not_declared(capture):
    capture.path("color", "1", 4).unlink()
    assert "List the frame in cameras.1.missing" in errors(capture)


def relabel(capture, change) -> None:
    for frame in range(capture.frame_count):
        cv2.imwrite(str(capture.path("mask", "0", frame)), change(capture.mask("0", frame), frame))


def warnings(capture) -> str:
    return "\n".join(of_level(check_layout(capture.folder), "warning"))


@pytest.mark.parametrize(("label", "what"), [(1, "object"), (2, "hand")])
def test_masks_without_object_or_hand(capture, label, what):
    relabel(capture, lambda labels, _: np.where(labels == label, 0, labels).astype(np.uint8))
    assert f"camera 0: no {what} in frame 0: no pixel with label {label}" in warnings(capture)


def test_two_objects(capture):
    def second(labels, _):
        doubled = labels.copy()
        doubled[2:22, 2:22] = 1
        return doubled

    relabel(capture, second)
    assert "camera 0: two objects: the object's mask of frame 0 has 2 pieces far apart" in warnings(capture)


def test_an_object_that_leaves_the_view(capture):
    relabel(capture, lambda labels, frame: np.where((labels == 1) & (frame > 3), 0, labels).astype(np.uint8))
    assert "object missing: almost nothing of the object in 2 frames, first in frame 4" in warnings(capture)


def test_an_object_inside_an_obstacle(capture):
    around = {"shape": "sphere", "center": [0.0, 0.0, 0.0], "radius": 5.0}
    beside = {"shape": "box", "center": [0.0, 9.0, 0.0], "half_sizes": [1.0, 1.0, 1.0]}
    edit(capture, lambda values: values.update(obstacles=[beside]))
    assert errors(capture) == ""
    edit(capture, lambda values: values.update(obstacles=[beside, around]))
    assert "obstacles[1]: the object of frame 0 must be outside" in errors(capture)
    assert "received 100% more than 10 mm inside" in errors(capture)
