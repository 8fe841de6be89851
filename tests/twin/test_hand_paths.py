"""Depth of hands without depth: planes, sizes, knots."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring.core.artifacts import ImageObservations, Twin
from neuspring.twin import hand_paths
from neuspring.twin.candidates import candidate
from tests.support import colored, small
from tests.support.colored import camera

PIXEL32 = 1e-4
"""Pixels are stored in single precision: 1e-5 px at 1 m are far less than this, m."""


def seen_on(path: np.ndarray) -> ImageObservations:
    """What a camera sees of one hand of four points that goes along `path` [T, 3], m, without turning."""
    view = camera(path[0])
    centers, depth = view.project(path[:, None])
    return replace(
        colored.observed().image,
        intrinsics=view.intrinsics,
        camera_to_world=view.camera_to_world,
        hand_centers=centers,
        hand_angles=np.zeros((len(path), 1)),
        hand_sizes=depth[:1] / depth,
        pixels=np.zeros((len(path), 1, 2)),
        visible=np.zeros((len(path), 1), bool),
        marked=np.zeros((len(path), 0, 2)),
        hand_of=np.zeros(4, int),
    )


def way(direction: tuple[float, float, float]) -> np.ndarray:
    """A wavy way of 20 cm in a direction."""
    share = np.linspace(0, 1, 12)[:, None]
    return np.array([0.05, 0.1, 0.02]) + 0.2 * share * direction + 0.02 * np.sin(3 * share) * [1.0, 0.0, 0.0]


@pytest.mark.parametrize(("direction", "tilt"), [((0, 0, 1), 0.0), ((0, 1, 0), 90.0), ((0, np.sqrt(0.5), np.sqrt(0.5)), 45.0)])
def test_a_hand_in_a_plane_is_where_it_is(direction, tilt):
    """Upright, level, and leaning away from the camera as it rises: the normal turns from forward towards down."""
    path = way(direction)
    image = seen_on(path)
    depths = hand_paths.plane_depths(image, tilt, 1.0)
    grip = path[0] + 0.01 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    placed = hand_paths.place(image, grip, depths)
    np.testing.assert_allclose(placed.mean(axis=1), path, atol=PIXEL32)


def test_apparent_size_alone_gives_the_depth():
    path = way((0.0, 0.4, 0.9))
    image = seen_on(path)
    depths = hand_paths.depths_of(image, {"hand_tilt": 0.0, "hand_size": 1.0}, 8, 1.0)
    np.testing.assert_allclose(hand_paths.place(image, np.repeat(path[:1], 4, axis=0), depths).mean(axis=1), path, atol=PIXEL32)


def test_knots_are_factors_of_the_depth_and_stay_after_the_last():
    curve = hand_paths.knot_curve(np.array([[1.1, 0.9]]), train_end=9, frames=14)[:, 0]
    np.testing.assert_allclose(curve[[0, 4, 8]], [1.0, 1.1, 0.9])
    np.testing.assert_allclose(curve[8:], 0.9)
    assert curve.min() >= 0.9
    assert curve.max() <= 1.1 + 1e-12


def test_a_patch_is_rigid_and_turns_about_the_ray():
    path = np.repeat(way((0, 0, 1))[:1], 12, axis=0)
    image = replace(seen_on(path), hand_angles=np.linspace(0, 1.0, 12)[:, None])
    grip = path[0] + 0.02 * np.random.default_rng(0).normal(size=(4, 3))
    placed = hand_paths.place(image, grip - grip.mean(axis=0) + path[0], np.ones((12, 1)))
    apart = np.linalg.norm(placed[:, :, None] - placed[:, None], axis=-1)
    np.testing.assert_allclose(apart, np.broadcast_to(apart[0], apart.shape), atol=1e-12)
    view = camera(path[0])
    start, end = (view.project(placed[frame])[0] - image.hand_centers[0, 0] for frame in (0, -1))
    turned = np.arctan2(end[:, 1], end[:, 0]) - np.arctan2(start[:, 1], start[:, 0])
    # Perspective bends angles by less than a tenth of a radian over 2 cm.
    np.testing.assert_allclose(np.angle(np.exp(1j * (turned - 1.0))), 0.0, atol=0.1)


def test_frame_0_is_where_perception_put_the_grip():
    seen = colored.observed()
    values = {"hand_tilt": 30.0, "hand_size": 0.0, "hand_depth.0": 1.1, "hand_depth.1": 1.0, "hand_depth.2": 1.0}
    moved = hand_paths.hand_points(seen, values)
    np.testing.assert_allclose(moved[0], seen.controller_points[0], atol=1e-6)
    assert np.abs(moved[-1] - seen.controller_points[-1]).max() > 0.01


def test_with_hands_replaces_controllers_of_color_alone(tmp_path):
    seen = colored.observed()
    problem = small.search_problem(seen)
    twin = candidate(problem, problem.decode(problem.encode()))
    assert set(twin.hands) == {"hand_tilt", "hand_size", "hand_depth.0", "hand_depth.1", "hand_depth.2"}
    twin.save(tmp_path / "twin.npz")
    kept = Twin.load(tmp_path / "twin.npz")
    assert kept.hands == twin.hands
    np.testing.assert_array_equal(
        hand_paths.with_hands(seen, kept).controller_points, hand_paths.hand_points(seen, twin.hands).astype(np.float32)
    )
    measured = small.observations()
    assert hand_paths.with_hands(measured, twin) is measured


def test_observations_of_color_alone_are_kept(tmp_path):
    seen = colored.observed()
    seen.save(tmp_path / "seen.npz")
    kept = type(seen).load(tmp_path / "seen.npz")
    np.testing.assert_array_equal(kept.image.pixels, seen.image.pixels)
    assert kept.image.cell == seen.image.cell
    small.observations().save(tmp_path / "measured.npz")
    assert type(seen).load(tmp_path / "measured.npz").image is None
