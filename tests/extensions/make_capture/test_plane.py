"""The table in depth: its plane against the truth, and every plane that is none."""

import numpy as np
import pytest

from neuspring.checks.rig import common_plane, levelling
from neuspring.core.errors import InputError
from neuspring.data.planes import cloud, planes
from neuspring.extensions.make_capture.table import find_table, pose_on
from tests.support.desk import RADIUS, SIZE, TARGET, K, camera, looking, seen

NOISE = 0.001
"""m."""


def points_of(*squares, eye=(0.0, -0.6, 0.4), target=(0, 0, 0), upright=(0, 0, 1), seed=0):
    """Points [n, 3] in the coordinates of a camera of squares (corner, side, side, count), with noise along the rays."""
    rng = np.random.default_rng(seed)
    pose = looking(np.array(eye), np.array(target), upright)
    parts = [np.array(corner) + rng.random((count, 2)) @ np.array([one, two]) for corner, one, two, count in squares]
    local = (np.concatenate(parts) - pose[:3, 3]) @ pose[:3, :3]
    return local * (1 + NOISE * rng.normal(size=(len(local), 1)) / local[:, 2:]), pose


TABLE = ((-0.4, -0.3, 0), (0.8, 0, 0), (0, 0.6, 0), 2000)
BACK = ((-0.5, 0.4, 0), (1.0, 0, 0), (0, 0, 0.5), 4000)
SIDE = ((0.5, -0.4, -0.2), (0, 1.0, 0), (0, 0, 0.9), 4000)
SHELF = ((-0.3, 0.05, 0.1), (0.5, 0, 0), (0, 0.2, 0), 900)


def test_the_plane_of_a_desk_is_the_truth():
    view = camera()
    plane = planes(cloud([seen(view, noise=NOISE)[1]], K))[0]
    pose = view.camera_to_world
    # A thousandth of a meter of noise in 4000 points leaves a mean of 0.02 mm and a normal of a fraction of a milliradian.
    assert plane.height == pytest.approx(pose[2, 3], abs=3e-4)
    np.testing.assert_allclose(plane.normal, pose[2, :3], atol=1e-3)
    assert 0.7 < plane.share < 1.0
    assert 0.2e-3 < plane.rms < NOISE
    assert plane.elevation == pytest.approx(np.degrees(np.arcsin(-pose[2, 2])), abs=0.1)


def test_a_lone_camera_gets_its_pose_but_for_a_turn_and_a_shift_on_the_table():
    view = camera()
    points = cloud([seen(view)[1]], K)
    pose = pose_on(find_table("depth", points)[0], points, SIZE, K)
    # The camera's x is level, as in the truth, so both agree up to a turn about z that makes it the world's x.
    truth = view.camera_to_world
    assert pose[2, 3] == pytest.approx(truth[2, 3], abs=3e-4)
    np.testing.assert_allclose(pose[:3, :3].T @ [0, 0, 1], truth[2, :3], atol=1e-3)
    np.testing.assert_allclose(pose[:3, 0], [1, 0, 0], atol=2e-3)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    # The center of view shows the near side of the ball; the origin is below it.
    center = pose[:3, :3].T @ -pose[:3, 3]
    np.testing.assert_allclose(truth[:3, :3] @ center + truth[:3, 3], TARGET, atol=RADIUS)


def test_a_wall_that_is_larger_than_the_table_is_not_taken():
    points, pose = points_of(TABLE, SIDE)
    table, remarks = find_table("depth", points)
    np.testing.assert_allclose(table.normal, pose[2, :3], atol=3e-3)
    assert "the largest plane is not taken for the table: it is a wall or a ceiling" in remarks[0]


@pytest.mark.parametrize(
    ("squares", "options", "message"),
    [
        ([SIDE], {}, "it is a wall or a ceiling: its normal leans"),
        ([BACK], {"eye": (0, -0.6, 0.2), "target": (0, 0.4, 0.2)}, "it faces the camera: a wall, or a table seen from straight"),
        ([TABLE], {"eye": (0, -0.4, -0.5)}, "it is a wall or a ceiling: its normal leans 180 degrees"),
        ([((-4, -3, 0), (8, 0, 0), (0, 6, 0), 4000)], {"eye": (0, -6, 5)}, "more than 4 m above it: is the unit of depth right?"),
    ],
)  # fmt: skip
def test_planes_that_are_no_table(squares, options, message):
    points, _ = points_of(*squares, **options)
    with pytest.raises(InputError, match="no plane can be the table") as caught:
        find_table("depth", points)
    assert message in str(caught.value)


def test_too_small_a_part_and_no_plane_at_all():
    rng = np.random.default_rng(0)
    small, _ = points_of((TABLE[0], (0.2, 0, 0), (0, 0.2, 0), 150))
    clutter = rng.uniform([-0.6, -0.6, 0.5], [0.6, 0.6, 1.9], (3000, 3))
    with pytest.raises(InputError, match=r"the table must be seen|less than 10%"):
        find_table("depth", np.concatenate([small, clutter]))


def test_a_table_from_straight_above_needs_to_be_said():
    points, _ = points_of(TABLE, eye=(0, 0, 0.8), upright=(0, 1, 0))
    with pytest.raises(InputError, match="--top-down"):
        find_table("depth", points)
    assert find_table("depth", points, top_down=True)[0].height == pytest.approx(0.8, abs=1e-3)


def test_another_level_surface_is_named_and_a_pixel_chooses_it():
    points, pose = points_of(TABLE, SHELF)
    table, remarks = find_table("depth", points)
    assert table.height == pytest.approx(0.4, abs=2e-3)
    assert "another level surface, 10 cm above it" in remarks[0] and "--table-at" in remarks[0]
    local = (np.array([0.0, 0.1, 0.1]) - pose[:3, 3]) @ pose[:3, :3]
    assert find_table("depth", points, at=local)[0].height == pytest.approx(0.3, abs=2e-3)


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_levelling_puts_the_common_plane_at_zero(up):
    motion = looking(np.array([0.3, 0.2, 1.0]), np.array([0.1, 0.4, 0.7]))
    poses, tables = {}, {}
    for index in range(2):
        view = camera(index)
        tables[view.name] = find_table("depth", cloud([seen(view)[1]], K))[0]
        poses[view.name] = motion @ view.camera_to_world
    normal, point, rms = common_plane(tables, poses)
    moved = levelling(normal, point, up)
    assert rms < 1e-3
    for index in range(2):
        pose = moved @ poses[str(index)]
        np.testing.assert_allclose(up * pose[2, :3], camera(index).camera_to_world[2, :3], atol=2e-3)
        assert up * pose[2, 3] == pytest.approx(camera(index).camera_to_world[2, 3], abs=1e-3)
