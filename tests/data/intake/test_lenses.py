"""Intrinsics and poses from files, distortion, and a ChArUco board."""

import cv2
import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.data.intake.feeds import Lens
from neuspring.data.intake.lenses import Board, Straightener, depth_ratio, read_lenses, read_poses, require_lens, sight
from tests.support.board import BOARD, LENS, board_image, depth_of_table
from tests.support.desk import camera, looking, write_json, write_poses

PLAIN = {"fx": 70, "fy": 71, "cx": 39.5, "cy": 29.5}
MATRIX = np.array([[70.0, 0, 39.5], [0, 71.0, 29.5], [0, 0, 1]])


@pytest.mark.parametrize(
    "content",
    [
        PLAIN,
        {"fx": 70, "fy": 71, "ppx": 39.5, "ppy": 29.5, "coeffs": [0, 0, 0, 0, 0], "note": "from the maker"},
        {"K": MATRIX.tolist(), "width": 80, "height": 60},
        {"intrinsic_matrix": MATRIX.T.ravel().tolist()},
        [{"K": MATRIX.tolist()}, PLAIN],
        {"cameras": {"0": PLAIN, "1": PLAIN}},
        {"0": PLAIN, "1": {"intrinsics": MATRIX.tolist()}},
    ],
)
def test_forms_of_intrinsics(tmp_path, content):
    lenses = read_lenses(write_json(tmp_path / "k.json", content), ["0", "1"])
    for name in ("0", "1"):
        np.testing.assert_array_equal(lenses[name].matrix, MATRIX)
        assert not lenses[name].distortion.any()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"fx": 70}, "intrinsics of camera 0: fx, fy, cx, cy: 4 finite numbers are required"),
        ({"focal": 70}, "intrinsics: a list for 2 cameras in their order, or an object with the keys 0 1; received ['focal']"),
        ([PLAIN], "received list of 1"),
        (PLAIN | {"distortion": [0.1, 0.2]}, "distortion: 0 or 4 or 5 or 8 or 12 or 14 finite numbers are required"),
        ({"K": [[1, 0], [0, 1]]}, "K: 3 x 3 finite numbers are required"),
        ({"0": PLAIN, "1": {"note": 1}}, "intrinsics of camera 1: fx, fy, cx, cy are required, or K [3, 3]"),
    ],
)
def test_intrinsics_that_cannot_be_read(tmp_path, content, message):
    with pytest.raises(InputError) as caught:
        read_lenses(write_json(tmp_path / "k.json", content), ["0", "1"])
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        (Lens(matrix=MATRIX, size=(160, 120)), "Scale fx and cx by 0.5, fy and cy by 0.5"),
        (Lens(matrix=MATRIX @ np.diag([0.027, 0.027, 1])), "Focal lengths are in pixels of these images, not in millimeters"),
        (Lens(matrix=MATRIX + np.eye(3)[:, :1] @ [[0, 0, 200.0]]), "(cx, cy) must lie in the 80 x 60 image"),
    ],
)
def test_intrinsics_that_do_not_fit_the_images(tmp_path, lens, message):
    with pytest.raises(InputError) as caught:
        require_lens(tmp_path, "0", lens, (80, 60))
    assert message in str(caught.value)


def test_distortion_is_removed_from_color_and_depth():
    lens = Lens(matrix=MATRIX, distortion=np.array([-0.4, 0.1, 0.0, 0.0, 0.0]))
    straight = Straightener(lens, (80, 60))
    # A vertical edge at x = 70.5 of a straight image, bent by the lens: each pixel shows what OpenCV's model says it does.
    y, x = np.mgrid[:60, :80].astype(np.float32)
    pixels = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
    ideal = cv2.undistortPoints(pixels, MATRIX, lens.distortion, P=MATRIX).reshape(60, 80, 2)
    bent = np.where(ideal[..., 0] < 70.5, 700, 900).astype(np.uint16)
    assert max(abs(int(np.argmax(row > 800)) - 71) for row in bent[10:50]) > 1
    depth = straight.depth(bent)[10:50, 20:75]
    assert set(np.unique(depth)) == {700, 900}
    # The nearest value is that of a pixel beside the right one at most.
    assert max(abs(int(np.argmax(row > 800)) + 20 - 71) for row in depth) <= 1
    color = straight.color(np.repeat((bent // 4).astype(np.uint8)[..., None], 3, axis=2))
    assert abs(float(color[30, 68, 0]) - 175) < 3 and abs(float(color[30, 74, 0]) - 225) < 3


@pytest.mark.parametrize("key", ["camera_to_world", "world_to_camera"])
def test_poses_of_either_direction(tmp_path, key):
    poses = read_poses(write_poses(tmp_path / "poses.json", key=key), ["0", "1"])
    for index in range(2):
        np.testing.assert_allclose(poses[str(index)], camera(index).camera_to_world, atol=1e-9)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"poses": []}, "exactly one of the keys camera_to_world and world_to_camera is required"),
        ({"camera_to_world": [np.eye(4).tolist()]}, "a list for 2 cameras in their order"),
        ({"camera_to_world": [np.eye(4).tolist(), np.diag([2.0, 2, 2, 1]).tolist()]}, "must be a rotation"),
        (
            {"camera_to_world": [np.eye(4).tolist(), (np.eye(4) + np.outer([1, 0, 0, 0], [0, 0, 0, 540.0])).tolist()]},
            "the position must be in meters; received one 540 m from the origin. Divide the last columns by 1000",
        ),
    ],
)
def test_poses_that_cannot_be(tmp_path, content, message):
    with pytest.raises(InputError) as caught:
        read_poses(write_json(tmp_path / "poses.json", content), ["0", "1"])
    assert message in str(caught.value)


def test_a_board_gives_the_pose():
    pose = looking(np.array([0.1, -0.5, 0.5]), np.array([0.1, -0.14, 0]))
    sighting = sight("image", Board.of(BOARD), [board_image(pose)], LENS)
    # Half a pixel at this distance is half a millimeter.
    np.testing.assert_allclose(sighting.camera_to_world[:3, 3], pose[:3, 3], atol=2e-3)
    np.testing.assert_allclose(sighting.camera_to_world[:3, :3], pose[:3, :3], atol=4e-3)
    assert sighting.corners >= 20 and sighting.error < 0.5
    depth = depth_of_table(pose)
    assert depth_ratio(sighting, depth) == pytest.approx(1.0, abs=0.01)
    assert depth_ratio(sighting, 10 * depth) == pytest.approx(10.0, abs=0.1)
    assert depth_ratio(sighting, 0 * depth) is None


def test_a_board_that_moved_or_is_not_seen():
    near, far = (looking(np.array([0.1, y, 0.5]), np.array([0.1, -0.14, 0])) for y in (-0.5, -0.6))
    with pytest.raises(InputError, match=r"corners of the board must fit within 1\.5 pixels rms.*must lie still"):
        sight("image", Board.of(BOARD), [board_image(near), board_image(far)], LENS)
    with pytest.raises(InputError, match="at least 6 corners of the 5 x 7 board"):
        sight("image", Board.of(BOARD), [np.full((480, 640, 3), 128, np.uint8)], LENS)


@pytest.mark.parametrize(
    "text", ["5x7", "5x7:0.03:0.04:DICT_5X5_100", "5x7:40:30:DICT_5X5_100", "5x7:0.04:0.03:DICT_9", "2x2:0.04:0.03:DICT_5X5_100"]
)
def test_boards_that_cannot_be(text):
    with pytest.raises(InputError, match="--board: "):
        Board.of(text)
