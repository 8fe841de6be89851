"""make-capture against what the pictures show: moments by what moves, and other meanings of lens, depth and poses by --take."""

import cv2
import numpy as np
import pytest

from neuspring.checks.rig import OPENGL
from neuspring.core.errors import InputError
from neuspring.core.geometry import rigid_inverse
from neuspring.data.camera import Camera
from neuspring.extensions.make_capture.make import Intake, make_capture
from tests.support.desk import TARGET, K, counts, looking, seen, write_json

FRAMES, STEP = 20, 3
SIZE = (160, 120)
LENS = np.diag([2.0, 2.0, 1.0]) @ K
EYES = ((0.05, -0.5, 0.35), (0.3, -0.4, 0.45), (-0.3, -0.3, 0.5))


def camera(index):
    return Camera(str(index), *SIZE, LENS, looking(np.array(EYES[index]), TARGET))


def write(root, cameras=1, late=0, begin=(0, 0), still=False, depth_of=lambda depth: depth):
    """Folders of a desk whose ball moves; depth is `late` pictures late, and names of color and depth begin at `begin`."""
    for index in range(cameras):
        for k in range(FRAMES):
            moment = 0 if still else STEP * (k + 3)
            color, depth = seen(camera(index), moment)[0], seen(camera(index), 0 if still else STEP * (k + 3 - late))[1]
            for kind, image, first in (("color", color[..., ::-1], begin[0]), ("depth", counts(depth_of(depth)), begin[1])):
                (root / f"{kind}{index}").mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(root / f"{kind}{index}" / f"{k + first:05d}.png"), image)
    write_json(root / "lens.json", {"K": LENS.tolist()})
    return root


def intake(root, cameras=1, poses=None, lens=None, **changes):
    films = {kind: tuple(root / f"{kind}{k}" for k in range(cameras)) for kind in ("color", "depth")}
    if poses is not None:
        changes["poses"] = write_json(root / "poses.json", {"camera_to_world": [pose.tolist() for pose in poses]})
    if lens is not None:
        write_json(root / "lens.json", {"K": lens.tolist()})
    said = {"output": root / "capture", "name": "desk", "category": "ball", "rate": 30.0, "intrinsics": root / "lens.json"}
    return Intake(**(said | films | changes))


def in_time(report):
    return next(line for line in report if line.startswith("time: "))


def test_color_counted_from_0_and_depth_from_1_are_paired_by_order(tmp_path):
    capture, report = make_capture(intake(write(tmp_path, begin=(0, 1))))
    assert capture.frame_count == FRAMES
    assert "pairs: camera 0, color and depth: by order, from 0 and 1" in report
    assert abs(float(in_time(report).split("depth 0 ")[1])) < 0.3


@pytest.mark.parametrize("late", [1, -2])
def test_depth_of_other_moments_is_refused_and_a_shift_mends_it(tmp_path, late):
    root = write(tmp_path, late=late)
    side = "later" if late > 0 else "earlier"
    with pytest.raises(InputError, match=rf"depth 0 is .* frames {side} than color 0.*--shift 0.depth={late}\b"):
        make_capture(intake(root))
    assert not (tmp_path / "capture").exists()
    capture, report = make_capture(intake(root, shift=(f"0.depth={late}",)))
    assert capture.frame_count == FRAMES - abs(late)
    first = STEP * (3 + max(-late, 0))
    np.testing.assert_array_equal(capture.color("0", 0), seen(camera(0), first)[0])
    np.testing.assert_allclose(capture.depth("0", 0), counts(seen(camera(0), first)[1]) / 1000)
    assert any("moved by" in line for line in report)


def test_where_nothing_moves_two_readings_of_the_names_are_told(tmp_path):
    root = write(tmp_path, begin=(0, 1), still=True)
    with pytest.raises(InputError, match=r"--shift 0.depth=0 for the order, or --shift 0.depth=-1 for equal numbers"):
        make_capture(intake(root))
    _, report = make_capture(intake(root, shift=("0.depth=0",)))
    assert "too little of one motion to check depth 0 against color 0" in in_time(report)


def test_a_camera_of_a_rig_that_starts_at_1_is_judged_in_space(tmp_path):
    poses = [camera(0).camera_to_world, camera(1).camera_to_world]
    root = write(tmp_path, 2)
    for kind in ("color1", "depth1"):
        for path in sorted((root / kind).iterdir(), reverse=True):
            path.rename(path.with_name(f"{int(path.stem) + 1:05d}.png"))
    capture, report = make_capture(intake(root, 2, poses))
    assert capture.frame_count == FRAMES
    assert "pairs: cameras 0 and 1: by order, from 0 and 1" in report
    with pytest.raises(InputError, match=r"camera 1 is .* earlier than camera 0, by what moves.*--shift 1=0"):
        make_capture(intake(root, 2, poses, shift=("1=1",), output=tmp_path / "other"))


@pytest.mark.parametrize("text", ["0.depth", "9=1", "0.depth=a", "0=1"])
def test_a_shift_of_no_stream_is_refused(tmp_path, text):
    with pytest.raises(InputError, match="--shift: STREAM=PICTURES is required, with a stream of 0"):
        make_capture(intake(write(tmp_path), shift=(text,)))


def distance(depth):
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(LENS).T
    return depth * np.linalg.norm(rays, axis=-1)


def test_a_distance_in_place_of_depth_is_named_and_taken(tmp_path):
    root = write(tmp_path, depth_of=distance)
    with pytest.raises(InputError, match=r"the distance to the camera instead of depth .*--take distance"):
        make_capture(intake(root))
    capture, _ = make_capture(intake(root, take=("distance",)))
    np.testing.assert_allclose(capture.depth("0", 4), seen(camera(0), 7 * STEP)[1], atol=0.0011)
    assert capture.description.provenance["taken as"] == "distance"


@pytest.mark.parametrize(
    ("take", "lens"), [("lens_resized", np.diag([1.5, 1.5, 1.0]) @ LENS), ("lens_turned", LENS[[1, 0, 2]][:, [1, 0, 2]])]
)
def test_intrinsics_of_another_image_are_named_and_taken(tmp_path, take, lens):
    root = write(tmp_path)
    _, report = make_capture(intake(root, lens=lens, output=tmp_path / "warned"))
    assert any(line.startswith("warning: intrinsics of camera 0: the principal point") and take in line for line in report)
    poses = [camera(0).camera_to_world]
    with pytest.raises(InputError, match=f"intrinsics of camera 0: the principal point .*--take {take}"):
        make_capture(intake(root, 1, poses, lens=lens))
    capture, report = make_capture(intake(root, 1, poses, lens=lens, take=(take,)))
    np.testing.assert_allclose(capture.cameras["0"].intrinsics, LENS, rtol=0.02)


@pytest.mark.parametrize(
    ("take", "change"),
    [
        ("inverse", lambda poses: [rigid_inverse(pose) for pose in poses]),
        ("opengl:1", lambda poses: [poses[0], poses[1] @ OPENGL, poses[2]]),
        ("order=2,1,0", lambda poses: poses[::-1]),
    ],
)
def test_poses_that_mean_something_else_are_named_and_taken(tmp_path, take, change):
    poses = [camera(index).camera_to_world for index in range(3)]
    root = write(tmp_path, 3)
    with pytest.raises(InputError, match=f"--take {take} takes it so"):
        make_capture(intake(root, 3, change(poses)))
    capture, _ = make_capture(intake(root, 3, change(poses), take=(take,)))
    for index, view in enumerate(capture.cameras.values()):
        np.testing.assert_allclose(view.camera_to_world, poses[index], atol=1e-9)


def test_an_order_is_told_after_what_is_taken_already(tmp_path):
    poses = [camera(index).camera_to_world for index in range(3)]
    root = write(tmp_path, 3)
    given = [rigid_inverse(poses[index]) for index in (2, 0, 1)]
    with pytest.raises(InputError, match="--take inverse order=1,2,0 takes it so"):
        make_capture(intake(root, 3, given, take=("inverse",)))
    with pytest.raises(InputError, match="--take inverse order=1,2,0 takes it so"):
        make_capture(intake(root, 3, given))
    with pytest.raises(InputError, match="--take inverse order=1,2,0 takes it so"):
        make_capture(intake(root, 3, given, take=("order=1,0,2", "inverse")))
    capture, _ = make_capture(intake(root, 3, given, take=("inverse", "order=1,2,0")))
    for index, view in enumerate(capture.cameras.values()):
        np.testing.assert_allclose(view.camera_to_world, poses[index], atol=1e-9)


@pytest.mark.parametrize("text", ["backwards", "inverse:7", "order=0,0"])
def test_what_cannot_be_taken_is_refused(tmp_path, text):
    with pytest.raises(InputError, match="--take"):
        make_capture(intake(write(tmp_path), take=(text,)))


@pytest.mark.parametrize(("model", "wrong"), [("opencv", "distorted_to_ideal"), ("opencv", "opencv")])
def test_a_distortion_by_another_model_is_told_by_the_table(tmp_path, model, wrong):
    coefficients = np.array([-0.35, 0.12, 0.0, 0.0])
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float32)
    ideal = cv2.undistortPoints(np.stack([x, y], axis=-1).reshape(-1, 1, 2), LENS, coefficients, P=LENS).reshape(*x.shape, 2)
    root = write(tmp_path)
    for path in [*root.glob("color0/*"), *root.glob("depth0/*")]:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), cv2.remap(image, ideal[..., 0], ideal[..., 1], cv2.INTER_NEAREST))
    write_json(root / "lens.json", {"K": LENS.tolist(), "dist": coefficients.tolist(), "model": wrong})
    _, report = make_capture(intake(root))
    told = [line for line in report if "--take model=" in line]
    assert [f"--take model={model} " in line for line in told] == [True] * (model != wrong)
    _, report = make_capture(intake(root, take=(f"model={model}",), output=tmp_path / "taken"))
    assert not [line for line in report if "--take model=" in line]
