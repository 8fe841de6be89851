"""Files of intrinsics and poses in the forms of other programs: read rightly, or refused with what they are."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neuspring.core.errors import InputError
from neuspring.core.geometry import rigid_inverse
from neuspring.data.camera import Lens
from neuspring.extensions.make_capture.forms import read_lenses, read_poses
from neuspring.extensions.make_capture.lenses import Straightener, require_lens
from tests.extensions.make_capture.board import BENT, MATRIX, PLAIN
from tests.support.desk import looking, write_json


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
        {"camera_matrix": {"rows": 3, "cols": 3, "data": MATRIX.ravel().tolist()}},
        {
            "K": MATRIX.ravel().tolist(),
            "D": [0.0] * 5,
            "distortion_model": "plumb_bob",
            "R": [1.0, 0, 0, 0, 1, 0, 0, 0, 1],
            "header": {},
        },
        {"fl_x": 70, "fl_y": 71, "cx": 39.5, "cy": 29.5, "w": 80, "h": 60, "camera_model": "OPENCV", "k1": 0.0, "frames": []},
        PLAIN | {"coeffs": [0.0] * 5, "model": "distortion.inverse_brown_conrady"},
        PLAIN | {"coeffs": [0.0] * 5, "model": 2},
        {"K": MATRIX.T.ravel().tolist(), "w": 80, "h": 60, "poses": [[0.0] * 7]},
        {"cam_K": [70, 71, 39.5, 29.5], "rms_reprojection_error": 0.3, "per_view_errors": [0.2, 0.4]},
        {"K": MATRIX.tolist(), "R": np.eye(3).tolist(), "T": [0, 0, 1], "focal_length": 17.5, "horizontal_aperture": 20.0},
        {"intrinsics": {"0": {"intrinsic": PLAIN, "image_size": [80, 60]}, "1": PLAIN}},
    ],
)
def test_forms_of_intrinsics(tmp_path, content):
    lenses = read_lenses(write_json(tmp_path / "k.json", content), ["0", "1"])
    for name in ("0", "1"):
        np.testing.assert_array_equal(lenses[name].matrix, MATRIX)
        assert not lenses[name].distortion.any()


@pytest.mark.parametrize(
    "said",
    [
        {"distortion": BENT},
        {"dist": [BENT]},
        {"D": BENT, "distortion_model": "plumb_bob"},
        {"distortion_coefficients": {"rows": 1, "cols": 5, "data": BENT}},
        {"distortion_coefficients": [[value] for value in BENT]},
        {"k1": BENT[0], "k2": BENT[1], "p1": BENT[2], "p2": BENT[3], "k3": BENT[4]},
        {"distortion": {"k1": BENT[0], "k2": BENT[1], "p1": BENT[2], "p2": BENT[3], "k3": BENT[4]}, "camera_model": "OPENCV"},
        {"coeffs": BENT, "model": "distortion.brown_conrady"},
        {"dist_coeffs": BENT, "camera_model": "pinhole", "distortion_model": "radtan"},
    ],
)
def test_spellings_of_distortion_mean_the_same(tmp_path, said):
    lens = read_lenses(write_json(tmp_path / "k.json", PLAIN | said), ["0"])["0"]
    require_lens(tmp_path, "0", lens, (80, 60))
    np.testing.assert_array_equal(lens.distortion, BENT)
    right = Straightener(Lens(matrix=MATRIX, distortion=np.array(BENT)), (80, 60))
    np.testing.assert_array_equal(Straightener(lens, (80, 60)).maps, right.maps)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"fx": 70}, "intrinsics of camera 0: fx, fy, cx, cy: 4 finite numbers are required"),
        ({"ffx": 70, "cx": 39.5}, "intrinsics: fx, fy, cx, cy are required, or K [3, 3]; received ['cx', 'ffx']"),
        ({"camera_angle_x": 1.0, "frames": []}, "fx = fy = 0.5 width / tan(0.5 camera_angle_x)"),
        (PLAIN | {"focal_length": 17.5}, "received 'focal_length'. In millimeters: fx = focal_length /"),
        (PLAIN | {"K": (2 * MATRIX).tolist()}, "fx, fy, cx, cy and K must agree"),
        (PLAIN | {"width": 80}, "width and height are required, or none of them; received width alone"),
        (PLAIN | {"resolution": "VGA"}, "resolution: the size of the images in pixels is required; received VGA"),
        (PLAIN | {"image_size": [80, 60], "width": 160, "height": 120}, "one size of the images is required"),
        (PLAIN | {"depth_scale": "auto"}, "depth_scale: meters per count of depth, or counts per meter, are required"),
        ([PLAIN | {"depth_scale": 0.001}, PLAIN | {"depth_scale": 0.00025}], "one unit of depth for all cameras is required"),
        ([PLAIN], "received list of 1"),
        (PLAIN | {"distortion": [0.1, 0.2]}, "distortion: 0 or 4 or 5 or 8 or 12 or 14 finite numbers are required"),
        ({"K": [[1, 0], [0, 1]]}, "K: 3 x 3 or 9 or 4 finite numbers are required"),
        ({"0": PLAIN, "1": {"note": 1}}, "intrinsics of camera 1: fx, fy, cx, cy are required, or K [3, 3]"),
        (PLAIN | {"distortion_coef": [0.1]}, "'distortion_coef'. Is distortion_coeffs meant? Remove it if it says nothing about"),
        (PLAIN | {"k9": 0.1}, "the keys that are read are fx fl_x"),
        (PLAIN | {"model_name": "ftheta"}, "received 'model_name'"),
        (PLAIN | {"fl_x": 71}, "one spelling of a key is required; received fx and fl_x"),
        (PLAIN | {"model": "radtan", "camera_model": "fisheye"}, "one model is required; received fisheye and radtan"),
        (PLAIN | {"k1": 0.1, "dist": [0.1, 0, 0, 0]}, "coefficients are required in a list or by name, not both"),
        (PLAIN | {"k1": 0.1, "k4": 0.2, "camera_model": "OPENCV"}, "k4 to k6 differ between programs: the model must be rational_"),
        (PLAIN | {"distortion": {"k1": 0.1, "a": 0.2}}, "distortion: names k1 k2 p1"),
        ({"cameras": [PLAIN, PLAIN], "dist": [0.1] * 5}, "belongs into its camera's object; received 'dist' beside the cameras"),
    ],
)
def test_intrinsics_that_cannot_be_read(tmp_path, content, message):
    with pytest.raises(InputError, match=re.escape(message)):
        read_lenses(write_json(tmp_path / "k.json", content), ["0", "1"])


@pytest.mark.parametrize(
    "said",
    [
        {"image_size": [80, 60]},
        {"resolution": "80x60"},
        {"imageWidth": 80.0, "imageHeight": "60"},
        {"image_w": 80, "image_h": 60},
        {"img_shape": [60, 80, 3]},
        {"resolution": {"height": 60, "width": 80}},
    ],
)
def test_a_size_in_any_spelling_is_that_of_the_images(tmp_path, said):
    for content in (PLAIN | said, said | {"cameras": {"0": PLAIN}}):
        lens = read_lenses(write_json(tmp_path / "k.json", content), ["0"])["0"]
        assert (lens.size, lens.told) == ((80, 60), ())
    with pytest.raises(InputError, match="width and height must be those of its images, 81 x 60; received 80 x 60"):
        require_lens(tmp_path / "k.json", "0", lens, (81, 60))


@pytest.mark.parametrize(
    ("said", "unit"),
    [({"depth_scale": 0.00025}, 0.00025), ({"depthScale": "1000"}, 0.001), ({"depth_units": "mm"}, 0.001), ({"note": 1}, None)],
)
def test_the_unit_of_depth_is_read_wherever_it_stands(tmp_path, said, unit):
    for content in (PLAIN | said, {"color": {"0": PLAIN}, "depth": said}):
        assert read_lenses(write_json(tmp_path / "k.json", content), ["0"])["0"].unit == unit


def test_two_sensors_are_chosen_by_their_keys(tmp_path):
    both = {"depth_intrinsics": PLAIN | {"fx": 60, "fy": 60}, "color_intrinsics": PLAIN}
    with pytest.raises(InputError, match=r"received \['depth_intrinsics', 'color_intrinsics'\].*--cameras color_intrinsics"):
        read_lenses(write_json(tmp_path / "k.json", both), ["0"])
    np.testing.assert_array_equal(read_lenses(tmp_path / "k.json", ["color_intrinsics"])["color_intrinsics"].matrix, MATRIX)


def test_a_table_of_one_size_is_read_and_said(tmp_path):
    bent = dict(zip(("k1", "k2", "p1", "p2", "k3"), BENT, strict=True))
    entry = {"width": 80, "height": 60, "intrinsic": PLAIN, "distortion": bent}
    lens = read_lenses(write_json(tmp_path / "k.json", {"color_by_size": {"80x60": entry}}), ["0"])["0"]
    assert (lens.size, lens.told) == ((80, 60), ("those of color_by_size.80x60",))
    np.testing.assert_array_equal(lens.distortion, BENT)


@pytest.mark.parametrize(
    ("said", "model", "told"),
    [
        ({"model": 4}, "brown_conrady", True),
        ({"model": "5"}, "kannala_brandt4", True),
        ({"camera_model": "ZED-M"}, "opencv", True),
        ({"model": "Intel RealSense D435", "distortion_model": "plumb_bob"}, "plumb_bob", True),
        ({"camera_model": "OPENCV_FISHEYE"}, "opencv_fisheye", False),
    ],
)
def test_models_by_number_and_names_of_cameras(tmp_path, said, model, told):
    lens = read_lenses(write_json(tmp_path / "k.json", PLAIN | {"dist": BENT} | said), ["0"])["0"]
    assert (lens.model, bool(lens.told)) == (model, told)


POSES = [looking(np.array([0.4 + k, -0.5, 0.6]), np.zeros(3)) for k in range(2)]
"""Camera to world."""


def listed(function):
    """Plain lists of what a function makes of each pose."""
    return [np.asarray(function(pose)).tolist() for pose in POSES]


def quaternion(pose):
    x, y, z, w = Rotation.from_matrix(rigid_inverse(pose)[:3, :3]).as_quat()
    return [w, x, y, z]


TURNED, MOVED = listed(lambda pose: rigid_inverse(pose)[:3, :3]), listed(lambda pose: rigid_inverse(pose)[:3, 3])
GL = listed(lambda pose: pose @ np.diag([1.0, -1, -1, 1]))


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ({"c2w": listed(lambda pose: pose.ravel())}, ""),
        ({"camera_to_world": dict(zip("01", listed(lambda pose: pose[:3].ravel()), strict=True))}, ""),
        ({"0": {"world_to_camera": listed(rigid_inverse)[0]}, "1": {"camera_to_world": POSES[1].tolist()}}, ""),
        ({"camera_to_world": listed(np.transpose)}, "by columns"),
        ({"camera_to_world": listed(lambda pose: pose.T.ravel())}, "by columns"),
        ({"camera_to_world": listed(lambda pose: pose[:3].T)}, "by columns"),
        ({"fl_x": 70, "frames": [{"file_path": str(k), "transform_matrix": GL[k]} for k in (0, 1)]}, "OpenGL"),
        ({"applied_transform": [], "frames": [{"transform_matrix": one} for one in GL]}, "applied_transform is not undone"),
        ({"R": TURNED, "T": [[[value] for value in one] for one in MOVED]}, "OpenCV's, world to camera"),
        ({"0": {"R": TURNED[0], "t": MOVED[0]}, "1": {"R": TURNED[1], "t": MOVED[1]}}, "OpenCV's, world to camera"),
        ([{"rvec": Rotation.from_matrix(TURNED[k]).as_rotvec().tolist(), "tvec": MOVED[k]} for k in (0, 1)], "OpenCV's"),
        ({"images": [{"qvec": quaternion(POSES[k]), "tvec": MOVED[k], "name": "a.png"} for k in (0, 1)]}, "COLMAP's"),
    ],
)
def test_forms_of_poses(tmp_path, content, told):
    poses, text = read_poses(write_json(tmp_path / "poses.json", content), ["0", "1"])
    np.testing.assert_allclose([poses["0"], poses["1"]], POSES, atol=1e-12)
    assert told in text and bool(told) == bool(text)


def test_one_pose_for_all_frames_of_a_still_camera(tmp_path):
    frames = [{"file_path": f"{k}.png", "transform_matrix": GL[0]} for k in range(5)]
    poses, _ = read_poses(write_json(tmp_path / "transforms.json", {"frames": frames}), ["left"])
    np.testing.assert_allclose(poses["left"], POSES[0], atol=1e-12)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"cam0": {"rotation": np.eye(3).tolist(), "translation": [0, 0, 1]}}, "received rotation translation. Write {"),
        ({"extrinsics": [np.eye(4).tolist()] * 2}, "received extrinsics. Write {"),
        ({"camera_to_world": [POSES[0].round(2).tolist(), np.eye(4).tolist()]}, "of too few digits: write six decimals"),
        ({"camera_to_world": [np.diag([1.0, 1, -1, 1]).tolist(), np.eye(4).tolist()]}, "and a mirror image"),
        ({"applied_scale": 0.5, "frames": [{"transform_matrix": one} for one in GL]}, "applied_scale must be 1"),
        ({"cam0": {"R": TURNED[0], "T": MOVED[0]}, "cam1": {"R": TURNED[1], "T": MOVED[1]}}, "--cameras cam0 cam1"),
        ({"0": {"R": TURNED[0], "T": MOVED[0]}, "1": {"note": 1}}, "pose of camera 1: one of the forms is required"),
        ({"camera_to_world": listed(np.asarray), "world_to_camera": listed(rigid_inverse)}, "exactly one of the keys"),
        ({"poses": []}, "exactly one of the keys camera_to_world and world_to_camera is required"),
        ({"camera_to_world": [np.eye(4).tolist()]}, "a list for 2 cameras in their order"),
        ({"camera_to_world": [np.eye(4).tolist(), np.diag([2.0, 2, 2, 1]).tolist()]}, "must be a rotation"),
        ({"c2w": [POSES[0].tolist(), (np.eye(4) + 540 * np.eye(4, k=3)).tolist()]}, "received one 540 m from the origin. Divide"),
    ],
)
def test_poses_that_cannot_be(tmp_path, content, message):
    with pytest.raises(InputError, match=re.escape(message)):
        read_poses(write_json(tmp_path / "poses.json", content), ["0", "1"])
