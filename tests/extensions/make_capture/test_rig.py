"""rig.json: keys are stated or asked for, and files of other programs are refused with the keys they become."""

import json
from importlib.resources import files

import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.extensions.make_capture.make import make_capture
from neuspring.extensions.make_capture.options import Intake
from neuspring.extensions.make_capture.rig import KEYS, Straightener, read_rig
from tests.support.desk import LENS, SIZE, K, camera, write_folders, write_json, write_rig

PLAIN = {"fx": 407.25, "fy": 407.25, "cx": 211.5, "cy": 119.5}
POSE = np.linalg.inv(camera().camera_to_world)
OTHERS = {
    "open3d": {"width": 424, "height": 240, "intrinsic_matrix": [407.25, 0, 0, 0, 407.25, 0, 211.5, 119.5, 1]},
    "opencv": {"cameras": [{"camera_matrix_3x3": K.tolist(), "dist_coeffs_array": [0.1, 0, 0, 0, 0]}]},
    "numbers as text": {"cameras": [{key: str(value) for key, value in PLAIN.items()}]},
    "nerfstudio": {"fl_x": 407.25, "frames": [{"transform_matrix": POSE.tolist()}]},
    "flat pose": {"cameras": [{"pose": POSE.ravel().tolist()}]},
    "a list": [PLAIN],
}
"""Files of the field; none has the keys of rig.json."""


@pytest.mark.parametrize("name", OTHERS)
def test_a_file_of_another_program_is_refused_with_the_keys_it_becomes(tmp_path, name):
    with pytest.raises(InputError, match=r"rig\.json") as refused:
        read_rig(write_json(tmp_path / "rig.json", OTHERS[name]))
    assert all(f"\n  {program}: {theirs} -> {ours}" in str(refused.value) for program, theirs, ours in KEYS)


def test_the_page_has_the_table_of_keys():
    page = files("neuspring.extensions.make_capture").joinpath("README.md").read_text()
    assert len(KEYS) >= 10
    assert all(f"| {program} | {theirs} | {ours} |" in page for program, theirs, ours in KEYS)


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    return write_folders(tmp_path_factory.mktemp("desk"), 2)


def made(desk, tmp_path, count=1, **changes):
    streams = {kind: tuple(desk / f"{kind}_{k}" for k in range(count)) for kind in ("color", "depth")}
    rig = write_rig(tmp_path / "rig.json", count, **changes)
    return make_capture(Intake(output=tmp_path / "capture", category="ball", rig=rig, **streams))


def lens(**changes):
    return {"cameras": [LENS | {"pose": camera().camera_to_world.tolist()} | changes]}


@pytest.mark.parametrize("key", ["frame_rate", "depth_unit", "poses", "axes", "up", "cameras"])
def test_a_key_that_is_not_stated_is_asked_for_with_an_example(desk, tmp_path, key):
    with pytest.raises(InputError, match=r"is required; received none\. State it"):
        made(desk, tmp_path, **{key: None})
    assert not (tmp_path / "capture").exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (lens(distortion_model=None), "distortion_model: is required"),
        (lens(width=1280, height=720), "width and height must be those of its images, 80 x 60; received 1280 x 720"),
        (lens(cx=200.0), r"\(cx, cy\) must lie in the 80 x 60 image"),
        (lens(fx=3.7, fy=3.7), "a field of view between 10 and 150 degrees"),
        (lens(distortion_model="opencv"), "distortion: is required"),
        (lens(distortion_model="fisheye", distortion=[0.1, 0.1]), "received fisheye with 2"),
        (lens(distortion=[0.1, 0, 0, 0, 0]), "received none with 5"),
        (lens(pose=np.transpose(camera().camera_to_world).tolist()), "stored by columns, transpose it"),
        (lens(pose=camera().camera_to_world.round(2).tolist()), "too few digits"),
        ({"poses": "table", "cameras": [LENS] * 2}, "one entry with its own name is required for each of the 1 cameras"),
        ({"poses": "board"}, "board: is required"),
        ({"depth_unit": 0.0}, "depth_unit"),
        ({"frame_rate": "stamps"}, "frame_rate: stamps of one rate are required; received none"),
        ({"up": "z"}, "up"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(desk, tmp_path, changes, words):
    with pytest.raises(InputError, match=words):
        made(desk, tmp_path, **changes)
    assert not (tmp_path / "capture").exists()


def test_stated_poses_units_and_axes_become_those_of_the_capture(desk, tmp_path):
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    upright = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # z up -> y up
    forms = {
        "inverse": {"poses": "world_to_camera", "cameras": [LENS | {"pose": np.linalg.inv(camera().camera_to_world).tolist()}]},
        "opengl": {"axes": "opengl", "cameras": [LENS | {"pose": (camera().camera_to_world @ opengl).tolist()}]},
        "y up": {"up": "+y", "cameras": [LENS | {"pose": (upright @ camera().camera_to_world).tolist()}]},
    }
    for name, changes in forms.items():
        (tmp_path / name).mkdir()
        capture, _ = made(desk, tmp_path / name, **changes)
        np.testing.assert_allclose(capture.cameras["0"].camera_to_world, camera().camera_to_world, atol=1e-9)
        assert (capture.description.up, capture.description.depth_unit, capture.description.frame_rate) == ("+z", 0.001, 30)
    assert json.loads((tmp_path / "opengl" / "capture" / "capture.json").read_text())["format"] == 1


def test_a_lens_with_distortion_is_straightened():
    cv = read_lens("opencv", [-0.25, 0.12, 0.001, -0.002, 0.03])
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float32)
    # OpenCV shows ideal (x, y) at (x, y) (1 + k1 r^2 + ...): what is drawn at the distorted place comes back to the ideal one.
    ideal = (np.stack([x, y], axis=-1) - K[:2, 2]) / 70
    r2 = (ideal**2).sum(axis=-1)
    k1, k2, p1, p2, k3 = cv.distortion
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = ideal[..., 0] * radial + 2 * p1 * ideal.prod(axis=-1) + p2 * (r2 + 2 * ideal[..., 0] ** 2)
    straight = Straightener(cv, SIZE)
    np.testing.assert_allclose(straight.maps[0], 70 * xd + 39.5, atol=1e-3)
    assert Straightener(read_lens("none", []), SIZE).color(x) is x


def read_lens(model, coefficients):
    from neuspring.data.camera import Lens

    return Lens(matrix=K, distortion=np.array(coefficients), model=model, size=SIZE)


def test_the_world_is_moved_to_the_table_where_that_is_stated(desk, tmp_path):
    motion = np.eye(4)
    motion[:3, :3] = [[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]
    motion[:3, 3] = (0.3, 0.2, -0.5)
    capture, report = made(desk, tmp_path, 2, motion=motion, up="table")
    assert any("up +z" in line for line in report)
    poses = [capture.cameras[name].camera_to_world for name in "01"]
    for index, pose in enumerate(poses):
        assert pose[2, 3] == pytest.approx(camera(index).camera_to_world[2, 3], abs=0.005)
    between = np.linalg.inv(poses[0]) @ poses[1]
    np.testing.assert_allclose(between, np.linalg.inv(camera(0).camera_to_world) @ camera(1).camera_to_world, atol=1e-6)
    assert isinstance(capture, Capture)
