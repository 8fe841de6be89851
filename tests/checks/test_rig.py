"""Cameras of one scene: every hypothesis that makes them right is found and named, and a right rig is left alone."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring.checks import examine
from neuspring.checks.rig import MEANINGS, OPENGL, ROS_BODY, Y_UP, Judged, Rig, along_axis, explain, levelling, resized
from neuspring.core.geometry import rigid_inverse
from tests.support.filmed import film


@pytest.fixture(scope="module")
def right(tmp_path_factory):
    """Three cameras around a body on a table."""
    capture = film(tmp_path_factory.mktemp("rig") / "film", sizes=((212, 120),) * 3)
    first = {name: capture.depth(name, 0) for name in capture.cameras}
    around = {name: [np.where(capture.mask(name, 0) == 0, depth, 0.0)] for name, depth in first.items()}
    # Not all at one height: else poses that are exchanged put the table at z = 0 too.
    return Rig(dict(capture.cameras), around, first)


def alone(rig, name="0", posed=True):
    return Rig({name: rig.cameras[name]}, {name: rig.depths[name]}, {name: rig.first[name]}, posed=posed)


def with_poses(rig, change):
    return rig.with_poses({name: change(one.camera_to_world) for name, one in rig.cameras.items()})


def with_lenses(rig, change):
    """Other intrinsics, of the same images."""
    cameras = {name: replace(one, intrinsics=change(one.intrinsics)) for name, one in rig.cameras.items()}
    return Rig(cameras, rig.depths, rig.first, rig.up, rig.posed)


def with_depth(rig, change):
    depths = {name: [change(depth, rig.cameras[name]) for depth in listed] for name, listed in rig.depths.items()}
    first = {name: change(depth, rig.cameras[name]) for name, depth in rig.first.items()}
    return Rig(rig.cameras, depths, first, rig.up, rig.posed)


def test_a_right_rig_needs_no_explanation(right):
    assert explain(right) is None and explain(alone(right, posed=False)) is None
    assert {one.name for one in examine("rig", "x", Judged(right, {}))} == {"table"}


def distances(depth, camera):
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
    return depth * np.linalg.norm(rays, axis=-1)


def larger(factor):
    return lambda matrix: np.diag([factor, factor, 1.0]) @ matrix


FAULTS = {
    "inverse": lambda rig: with_poses(rig, rigid_inverse),
    "opengl": lambda rig: with_poses(rig, lambda pose: pose @ OPENGL),
    "inverse+opengl": lambda rig: with_poses(rig, lambda pose: OPENGL @ rigid_inverse(pose)),
    "y_up": lambda rig: with_poses(rig, lambda pose: Y_UP.T @ pose),
    "y_up+opengl": lambda rig: with_poses(rig, lambda pose: Y_UP.T @ pose @ OPENGL),
    "ros_body": lambda rig: with_poses(rig, lambda pose: pose @ ROS_BODY.T),
    "distance": lambda rig: with_depth(rig, distances),
    "lens_resized": lambda rig: with_lenses(rig, larger(1.5)),
    "lens_turned": lambda rig: with_lenses(rig, lambda matrix: matrix[[1, 0, 2]][:, [1, 0, 2]]),
}


@pytest.mark.parametrize("name", FAULTS)
@pytest.mark.parametrize("cameras", [1, 3])
def test_a_fault_is_named_with_the_option_that_mends_it(right, name, cameras):
    rig = FAULTS[name](right if cameras == 3 else alone(right))
    found = explain(rig)
    assert found.option == f"--take {name}" and found.names == tuple(rig.cameras)
    mended = rig.taken(MEANINGS[name])
    assert mended.right and explain(mended) is None


@pytest.mark.parametrize("name", ["inverse", "opengl"])
def test_a_fault_of_one_camera_names_that_camera(right, name):
    wrong = FAULTS[name](right).cameras["1"]
    rig = right.with_poses({key: (wrong if key == "1" else one).camera_to_world for key, one in right.cameras.items()})
    assert explain(rig).option == f"--take {name}:1"


@pytest.mark.parametrize(("factor", "plausible"), [(10.0, 0.0001), (0.1, 0.01), (0.25, 0.004), (5.0, 0.0002)])
def test_a_wrong_unit_is_told_with_the_right_one(right, factor, plausible):
    rig = with_depth(right, lambda depth, _: factor * depth)
    judged = Judged(rig, dict.fromkeys(rig.cameras, 0.001))
    (found,) = (one for one in examine("rig", "x", judged) if one.level == "error")
    assert found.name == "explained" and found.value == "unit" and f"Plausible would be {plausible:g}" in found.text


@pytest.mark.parametrize("order", [("2", "1", "0"), ("1", "2", "0")])
def test_cameras_in_another_order_are_found(right, order):
    poses = [right.cameras[name].camera_to_world for name in order]
    found = explain(right.with_poses(dict(zip(right.cameras, poses, strict=True))))
    assert found.what == "order"
    back = found.option.removeprefix("--take order=").split(",")
    assert [order[list(right.cameras).index(name)] for name in back] == list(right.cameras)


def test_a_world_that_is_elsewhere_is_leveled_and_no_other_fault_is(right):
    tilt = levelling(np.array([0.1, 0.2, 0.97]), np.array([0, 0, 0.07]), 1.0)
    moved = with_poses(right, lambda pose: tilt @ pose)
    assert explain(moved).option == "--level"
    one = moved.cameras["1"].camera_to_world.copy()
    one[:3, 3] += (0.08, 0, 0.05)
    broken = moved.with_poses({name: one if name == "1" else camera.camera_to_world for name, camera in moved.cameras.items()})
    assert explain(broken) is None
    told = [found for found in examine("rig", "x", Judged(broken, {})) if found.name == "table elsewhere"]
    assert told and all("--level" not in one.text and "Calibrate" not in one.text for one in told)


def test_without_poses_only_lens_and_depth_can_be_told(right):
    two = with_lenses(alone(right, posed=False), larger(1.5))
    found = explain(two)
    assert (found.option, found.rivals) == ("--take lens_resized", ("--take lens_cropped",))
    (warned,) = (one for one in examine("rig", "x", Judged(two, {})) if one.name == "explained")
    assert warned.level == "warning"


def test_intrinsics_of_a_part_of_an_image_are_right_where_cameras_agree(right):
    cameras = {
        name: replace(one, width=one.width - 60, intrinsics=one.intrinsics - [[0, 0, 60], [0, 0, 0], [0, 0, 0]])
        for name, one in right.cameras.items()
    }
    depths = {name: [depth[:, 60:] for depth in listed] for name, listed in right.depths.items()}
    part = Rig(cameras, depths, {name: depth[:, 60:] for name, depth in right.first.items()})
    assert explain(part) is None
    assert {one.name for one in examine("rig", "x", Judged(part, {}))} == {"table"}
    found = examine("rig", "x", Judged(alone(part), {}))
    assert {(one.name, one.level) for one in found} == {("table", "note"), ("principal point", "warning")}


def test_a_resized_lens_keeps_its_view():
    matrix, size = np.array([[600.0, 0, 319.5], [0, 610.0, 179.5], [0, 0, 1]]), (320, 180)
    np.testing.assert_allclose(resized(matrix, size), np.diag([0.5, 0.5, 1]) @ matrix)
    assert resized(matrix, (320, 320)) is None


def test_depth_along_the_axis_is_that_of_a_plane():
    matrix = np.array([[100.0, 0, 40], [0, 110.0, 30], [0, 0, 1]])
    y, x = np.mgrid[:60, :80]
    distance = 2.0 * np.sqrt(1 + ((x - 40) / 100) ** 2 + ((y - 30) / 110) ** 2)
    np.testing.assert_allclose(along_axis(distance, matrix), 2.0)
