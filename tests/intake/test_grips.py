"""Clamped ends of cables: rings that keep direction and roll, against closed forms."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neuspring.config import Mocap, ScenarioRow
from neuspring.core.errors import InputError
from neuspring.scenes import mocap
from neuspring.scenes.mocap import clamps, transport

ROW = ScenarioRow(scenario="cable", source="mocap", category="cable", path="x", self_collision=False, ground=False)
RADIUS, COUNT = 0.006, 3
EDGE = 1e-12
"""Rounding of float64 geometry of size 1 over a few hundred steps."""
SINGLE = 1e-6
"""Observations are float32; coordinates are below 1 m."""


def turning(angle: np.ndarray) -> np.ndarray:
    """Unit vectors [T, 3] in the plane x, z at `angle` [T] from x."""
    return np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)


def wild(samples: int = 200) -> np.ndarray:
    """Two markers at either end [T, 4, 3] that move and turn in space."""
    t = np.linspace(0, 4, samples)
    one = np.stack([np.sin(t), np.cos(1.7 * t), 0.3 * t], axis=1)
    other = np.stack([1.5 + 0.1 * np.cos(t), np.sin(0.6 * t), -np.cos(t)], axis=1)
    ends = []
    for place, phase in ((one, 0.0), (other, 1.0)):
        along = np.stack([np.cos(2 * t + phase), np.sin(3 * t), np.sin(t + phase)], axis=1)
        ends += [place, place + 0.02 * along / np.linalg.norm(along, axis=1, keepdims=True)]
    return np.stack(ends, axis=1)


def rings(held: np.ndarray) -> np.ndarray:
    """Clamps [T, 4, count, 3] of held markers."""
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    return clamps(held, normals, RADIUS, COUNT, 1e-4, "cable").reshape(len(held), 4, COUNT, 3)


def test_points_keep_their_distance_to_the_marker_and_lie_normal_to_the_end() -> None:
    held = wild()
    offsets = rings(held) - held[:, :, None]
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=3), RADIUS, rtol=0, atol=EDGE)
    for end in (0, 2):
        along = held[:, end + 1] - held[:, end]
        for marker in (end, end + 1):
            np.testing.assert_allclose(np.einsum("tkc,tc->tk", offsets[:, marker], along), 0, atol=EDGE)
    # The rings of both markers of an end point the same way: one rigid grip.
    np.testing.assert_allclose(offsets[:, 0], offsets[:, 1], atol=EDGE)
    np.testing.assert_allclose(offsets[:, 2], offsets[:, 3], atol=EDGE)


@pytest.mark.parametrize("roll", [0.0, 0.7, np.pi / 2])
def test_a_planar_motion_turns_the_normal_in_the_plane_by_the_same_angle(roll: float) -> None:
    angle = 1.2 * np.sin(np.linspace(0, 7, 300))
    out_of_plane = np.array([0.0, 1.0, 0.0])
    in_plane = turning(angle + np.pi / 2)
    expected = np.cos(roll) * out_of_plane + np.sin(roll) * in_plane
    np.testing.assert_allclose(transport(turning(angle), expected[0]), expected, atol=EDGE)


def test_a_direction_that_goes_around_a_circle_of_latitude_turns_the_normal_by_the_enclosed_solid_angle() -> None:
    # Parallel transport along a closed curve on the sphere: by Gauss-Bonnet it turns by the area 2 pi (1 - cos(polar angle)).
    polar, steps = 0.4, 20_000
    turn = np.linspace(0, 2 * np.pi, steps)
    directions = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.full(steps, np.cos(polar))], axis=1)
    start = np.array([np.cos(polar), 0.0, -np.sin(polar)])
    end = transport(directions, start)[-1]
    angle = np.arctan2(np.cross(start, end) @ directions[0], start @ end)
    # The polygon of the steps has less area than the circle, by a share of (2 pi / steps)^2.
    assert angle % (2 * np.pi) == pytest.approx(2 * np.pi * (1 - np.cos(polar)), abs=1e-6)


def test_a_recording_seen_from_elsewhere_has_its_clamps_there() -> None:
    held, rotation = wild(), Rotation.from_rotvec([0.3, -1.1, 0.6])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    one = clamps(held, normals, RADIUS, COUNT, 1e-4, "cable")
    other = clamps(held @ rotation.as_matrix().T + 1.0, rotation.apply(normals), RADIUS, COUNT, 1e-4, "cable")
    np.testing.assert_allclose(other, one @ rotation.as_matrix().T + 1.0, atol=1e-11)


def test_markers_of_an_end_that_meet_are_refused() -> None:
    held = wild()
    held[7, 3] = held[7, 2]
    with pytest.raises(InputError, match=r"two held markers.*sample 7"):
        rings(held)


def cable(samples: int = 41, count: int = 12) -> np.ndarray:
    """A recording [T, 3, n]: a quarter of a circle whose ends swing."""
    turn = np.linspace(0, np.pi / 2, count)
    arc = 0.4 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    swing = [Rotation.from_euler("xyz", [0.3 * np.sin(t), 0.2 * t, 0.1 * t]).apply(arc) for t in np.linspace(0, 2, samples)]
    return np.stack(swing).transpose(0, 2, 1)


def read(folder: Path, **settings: object) -> mocap.Observations:
    path = folder / "7.pkl"
    path.write_bytes(pickle.dumps(cable(), protocol=4))
    return mocap.read(ROW, path, Mocap(ring=3, roll_axis="z", **settings))  # type: ignore[arg-type]


def test_clamps_follow_the_markers_among_the_controllers(tmp_path: Path) -> None:
    plain, clamped = read(tmp_path), read(tmp_path, grip="clamp")
    assert clamped.controller_points.shape == (21, 4 + 4 * 3, 3)
    np.testing.assert_array_equal(clamped.controller_points[:, :4], plain.controller_points)
    for name in ("object_points", "surface_points", "tracks"):
        np.testing.assert_array_equal(getattr(clamped, name), getattr(plain, name))
    offsets = clamped.controller_points[:, 4:].reshape(21, 4, 3, 3) - clamped.controller_points[:, :4, None]
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=3), 0.006, atol=SINGLE)


def test_a_clamp_turns_as_it_does_at_the_full_rate_and_does_not_know_later_frames(tmp_path: Path) -> None:
    every, second = read(tmp_path, grip="clamp", stride=1), read(tmp_path, grip="clamp", stride=2)
    np.testing.assert_array_equal(every.controller_points[::2], second.controller_points)
    first = read(tmp_path, grip="clamp", stride=2, frames=9)
    np.testing.assert_array_equal(first.controller_points, second.controller_points[:9])


def test_clamps_lie_around_the_straight_cable_at_rest(tmp_path: Path) -> None:
    straight = read(tmp_path, grip="clamp", rest_shape="straight")
    held, around = straight.canonical[-16:-12], straight.canonical[-12:].reshape(4, 3, 3)
    np.testing.assert_allclose(around[..., 0], np.broadcast_to(held[:, None, 0], (4, 3)), atol=SINGLE)
    np.testing.assert_allclose(np.linalg.norm(around - held[:, None], axis=2), 0.006, atol=SINGLE)
    # Half a step from the nodes of the body's first and last ring, in the rest shape and about so in the bent frame 0.
    for shape in (straight.canonical, np.concatenate([straight.nodes, straight.controller_points[0]])):
        body, clamp = shape[:-16], shape[-12:]
        for nodes, points in ((body[8:11], clamp[:3]), (body[-3:], clamp[-3:])):
            nearest = np.linalg.norm(nodes[:, None] - points, axis=2).min(axis=0)
            np.testing.assert_allclose(nearest, 0.006, rtol=0.2)
