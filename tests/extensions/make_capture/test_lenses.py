"""Intrinsics against images, distortion, and a ChArUco board."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.data.camera import Lens
from neuspring.extensions.make_capture.forms import read_lenses
from neuspring.extensions.make_capture.lenses import Board, Straightener, depth_ratio, require_lens, sight
from tests.extensions.make_capture.board import BENT, BOARD, LENS, MATRIX, PLAIN, board_image, depth_of_table
from tests.support.desk import looking, write_json


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        (Lens(matrix=np.diag([2.0, 2, 1]) @ MATRIX, size=(160, 120)), "--take lens_resized"),
        (Lens(matrix=MATRIX, size=(160, 120)), "if fx, fy, cx, cy are theirs, correct the size in the file"),
        (Lens(matrix=MATRIX @ np.diag([0.027, 0.027, 1])), "Focal lengths are in pixels of these images, not in millimeters"),
        (Lens(matrix=MATRIX, distortion=np.array(BENT), model="ftheta"), "one of opencv brown_conrady"),
        (Lens(matrix=MATRIX, distortion=np.array(BENT), model="none"), "received none. Undistort the images with the camera's"),
        (Lens(matrix=MATRIX, distortion=np.array(BENT), model="fisheye"), "the model fisheye has 4 coefficients; received 5"),
        (Lens(matrix=MATRIX + np.eye(3)[:, :1] @ [[0, 0, 200.0]]), "(cx, cy) must lie in the 80 x 60 image"),
    ],
)
def test_intrinsics_that_do_not_fit_the_images(tmp_path, lens, message):
    with pytest.raises(InputError, match=re.escape(message)):
        require_lens(tmp_path, "0", lens, (80, 60))


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


def through(lens, model):
    """Where the lens shows ideal pixels (x, y) [n, 2], by the equations of the model, and the pixels."""
    pixels = np.stack(np.meshgrid(np.linspace(5, 74, 8), np.linspace(5, 54, 8)), axis=-1).reshape(-1, 2)
    rays = (pixels - lens.matrix[:2, 2]) / np.diag(lens.matrix)[:2]
    if model == "fisheye":
        angle, radius = np.arctan(np.linalg.norm(rays, axis=1)), np.linalg.norm(rays, axis=1)
        bent = angle * (1 + sum(c * angle ** (2 * k + 2) for k, c in enumerate(lens.distortion)))
        rays = rays * (bent / radius)[:, None]
    else:
        k1, k2, p1, p2, k3 = lens.distortion
        (x, y), square = rays.T, (rays**2).sum(axis=1)
        scale = 1 + k1 * square + k2 * square**2 + k3 * square**3
        one = x * scale + 2 * p1 * x * y + p2 * (square + 2 * x * x)
        rays = np.stack([one, y * scale + p1 * (square + 2 * y * y) + 2 * p2 * x * y], axis=1)
    return pixels, rays * np.diag(lens.matrix)[:2] + lens.matrix[:2, 2]


@pytest.mark.parametrize("model", ["brown_conrady", "distorted_to_ideal", "kannala_brandt4"])
def test_each_model_is_undone_by_its_own_equations(model):
    bent = np.array(BENT[:4] if model == "kannala_brandt4" else BENT)
    lens = Lens(matrix=MATRIX, distortion=bent, model=model)
    straight = Straightener(lens, (80, 60))
    start, end = through(lens, "fisheye" if model == "kannala_brandt4" else "")
    # The maps say for an ideal pixel where it is seen; linear between whole pixels they are within 0.02 pixels of it.
    ideal, shown = (end, start) if model == "distorted_to_ideal" else (start, end)
    inside = ((ideal > 1) & (ideal < [78, 58])).all(axis=1)
    places = ideal[inside].T.astype(np.float32)
    found = np.stack([cv2.remap(one, *places, cv2.INTER_LINEAR).ravel() for one in straight.maps], axis=1)
    assert inside.sum() > 40
    np.testing.assert_allclose(found, shown[inside], atol=0.05)
    assert straight.most == pytest.approx(np.hypot(*(np.stack(straight.maps) - np.mgrid[:60, :80][::-1])).max(), abs=1e-3)
    assert straight.text("0").startswith(f"distortion, camera 0: removed, up to {straight.most:.1f} pixels and ")


def test_a_model_with_two_meanings_is_refused_with_both(tmp_path):
    path = write_json(tmp_path / "k.json", PLAIN | {"coeffs": BENT, "model": "distortion.inverse_brown_conrady"})
    lens = read_lenses(path, ["0"])["0"]
    with pytest.raises(InputError) as caught:
        require_lens(path, "0", lens, (80, 60))
    message = str(caught.value)
    assert "k.json: camera 0: inverse_brown_conrady has two meanings, here up to" in message
    assert '"model": "brown_conrady" if librealsense' in message and '"model": "distorted_to_ideal" if the coeff' in message
    apart = float(message.split("up to ")[1].split()[0])
    one, two = (Straightener(replace(lens, model=model), (80, 60)).most for model in ("opencv", "distorted_to_ideal"))
    assert max(one, two) < apart < one + two + 0.2


def test_a_board_gives_the_pose():
    pose = looking(np.array([0.1, -0.5, 0.5]), np.array([0.1, -0.14, 0]))
    sighting = sight("image", Board.of(BOARD), [board_image(pose)], LENS)
    # Half a pixel at this distance is half a millimeter.
    np.testing.assert_allclose(sighting.camera_to_world[:3, 3], pose[:3, 3], atol=2e-3)
    np.testing.assert_allclose(sighting.camera_to_world[:3, :3], pose[:3, :3], atol=4e-3)
    assert len(sighting.pixels) >= 20 and sighting.error < 0.5
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
