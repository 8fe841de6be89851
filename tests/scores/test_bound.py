"""Points bound to nodes: exact under rigid motions for any nodes; stable where nodes do not determine a rotation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neuspring.scores.carried import bound_positions, rotations
from neuspring.scores.metrics import bound_track_errors, errors_per_frame, floors, track_errors
from tests.support.scenarios import observations

ROUND_OFF = 1e-12
"""m: float64 at coordinates of about 1 m, a hundred operations."""
X = np.array([1.0, 0, 0])


def moved(nodes: np.ndarray, turns: Rotation, shifts: np.ndarray) -> np.ndarray:
    """Frames [F, N, 3] of a rigid motion."""
    return np.stack([turn.apply(nodes) + shift for turn, shift in zip(turns, shifts, strict=True)])


def random_motion(rng: np.random.Generator, frames: int = 6) -> tuple[Rotation, np.ndarray]:
    """Unrelated turns of any angle and shifts; frame 0 is at rest."""
    turns = Rotation.concatenate([Rotation.identity(), Rotation.random(frames - 1, rng=rng)])
    shifts = rng.normal(size=(frames, 3))
    shifts[0] = 0
    return turns, shifts


def solid(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-0.1, 0.1, (60, 3))


def sheet(rng: np.random.Generator) -> np.ndarray:
    return np.column_stack([rng.uniform(-0.1, 0.1, (60, 2)), np.zeros(60)])


def grid(rng: np.random.Generator) -> np.ndarray:
    """Regular, so that nodes are at equal distances; one point is on a node."""
    return 0.018 * np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3)


def cable(rng: np.random.Generator) -> np.ndarray:
    """Rings of three, 25 mm apart, 3 mm from the axis."""
    angles = 2 * np.pi * np.arange(3) / 3
    return np.array([[0.025 * ring, 0.003 * np.cos(a), 0.003 * np.sin(a)] for ring in range(12) for a in angles])


@pytest.mark.parametrize("neighbors", [3, 8, 500])
@pytest.mark.parametrize("body", [solid, sheet, grid, cable])
def test_any_rigid_motion_scores_zero(body, neighbors):
    rng = np.random.default_rng(neighbors)
    nodes = body(rng)
    # Anywhere around the body, on a node, and so close to one that this has nearly all weight.
    points = np.concatenate([nodes[:1], nodes[1:2] + 1e-9, nodes[rng.integers(len(nodes), size=20)] + rng.normal(0, 0.01, (20, 3))])
    turns, shifts = random_motion(rng)
    if neighbors == 3 and body is grid:
        # Three nodes of a row are on a line, where a turn about it cannot be seen.
        turns = Rotation.identity(len(shifts))
    tracks = moved(points, turns, shifts)
    assert bound_track_errors(moved(nodes, turns, shifts), tracks, neighbors).max() < ROUND_OFF
    # The published error has a floor here.
    assert track_errors(moved(nodes, turns, shifts), tracks).min() > 1e-3


def test_frame_zero_scores_zero_with_noisy_tracks_and_single_precision():
    rng = np.random.default_rng(0)
    nodes = solid(rng).astype(np.float32)
    tracks = rng.normal(0, 0.1, (3, 5, 3)).astype(np.float32)
    errors = bound_track_errors(np.stack([nodes, nodes, nodes + np.float32(0.01)]), tracks)
    assert errors[0] < ROUND_OFF
    assert errors[1] == pytest.approx(np.linalg.norm(tracks[1].astype(float) - tracks[0], axis=1).mean())


def test_a_point_on_a_node_moves_with_it():
    rng = np.random.default_rng(3)
    nodes = solid(rng)
    frames = np.stack([nodes, nodes + rng.normal(0, 0.01, nodes.shape)])
    found = bound_positions(frames, nodes[:4])
    # The other seven nodes share 7e-6 of the weight.
    np.testing.assert_allclose(found[1], frames[1, :4], atol=1e-6)


def line(count: int = 30) -> np.ndarray:
    return 0.01 * np.arange(count)[:, None] * X


def test_points_on_a_straight_line_of_nodes_are_exact_under_any_rigid_motion():
    turns, shifts = random_motion(np.random.default_rng(4))
    points = np.array([[0.123, 0, 0], [0.05, 0, 0], [0.31, 0, 0]])
    assert bound_track_errors(moved(line(), turns, shifts), moved(points, turns, shifts)).max() < ROUND_OFF


def test_points_beside_a_straight_line_are_exact_if_it_does_not_roll():
    """Each step turns about a normal of the line of that moment, by up to 170 degrees."""
    rng = np.random.default_rng(5)
    turns = [Rotation.identity()]
    for _ in range(8):
        normal = np.cross(turns[-1].apply(X), rng.normal(size=3))
        turns.append(Rotation.from_rotvec(normal / np.linalg.norm(normal) * rng.uniform(0, np.radians(170))) * turns[-1])
    turns, shifts = Rotation.concatenate(turns), rng.normal(size=(9, 3))
    shifts[0] = 0
    points = np.array([[0.1, 0.003, 0], [0.2, 0, -0.004]])
    assert bound_track_errors(moved(line(), turns, shifts), moved(points, turns, shifts)).max() < 1e-11


def test_roll_of_a_line_is_not_seen_and_noise_does_not_roll_it():
    """A line that rolls looks at rest. Noise of 10 micrometers across it must not be taken for a roll."""
    rng = np.random.default_rng(6)
    point = np.array([[0.15, 0.003, 0]])
    noisy = np.stack([line() + (frame > 0) * rng.normal(0, 1e-5, (30, 3)) for frame in range(40)])
    found = bound_positions(noisy, point)
    assert np.linalg.norm(found - found[0], axis=2).max() < 1e-4


def test_a_line_that_turns_around_at_once_is_finite_and_proper():
    turn = rotations(np.stack([line(), line() * [-1, 1, 1], line()])[:, None])
    np.testing.assert_allclose(turn @ turn.transpose(0, 1, 3, 2), np.tile(np.eye(3), (3, 1, 1, 1)), atol=ROUND_OFF)
    np.testing.assert_allclose(np.linalg.det(turn), 1)
    np.testing.assert_allclose(turn[1, 0] @ X, -X, atol=ROUND_OFF)


def test_a_body_that_collapses_to_a_line_keeps_its_last_rotation():
    nodes = solid(np.random.default_rng(7))
    turn = Rotation.from_rotvec([0, 0, 0.5])
    flat = turn.apply(nodes) @ np.outer(X, X)
    found = rotations(np.stack([nodes, turn.apply(nodes), flat, flat])[:, None])
    np.testing.assert_allclose(found[1, 0], turn.as_matrix(), atol=ROUND_OFF)
    np.testing.assert_allclose(found[3, 0], found[2, 0], atol=ROUND_OFF)
    np.testing.assert_allclose(np.linalg.det(found), 1)


def test_reflected_nodes_are_turned_and_not_mirrored():
    nodes = solid(np.random.default_rng(8))
    assert np.linalg.det(rotations(np.stack([nodes, nodes * [1, 1, -1]])[:, None])) == pytest.approx(np.ones((2, 1)))


def test_unannotated_tracks_are_treated_as_in_the_published_error():
    tracks = np.full((5, 3, 3), np.nan)
    tracks[[0, 1, 3], 0] = [0.0, 0, 6.5]
    tracks[1:, 1] = [1.0, 0, 0]
    positions = np.tile(np.array([[0.0, 0, 0], [0, 5, 0], [0, 0, 7], [2, 1, 0]]), (5, 1, 1))
    positions[1:] += [0.3, 0.4, 0]
    np.testing.assert_allclose(bound_track_errors(positions, tracks), [0, 0.5, 0, 0.5, 0], atol=ROUND_OFF)
    tracks[0] = np.nan
    assert np.isnan(bound_track_errors(positions, tracks)).all()


def test_floors_are_the_errors_of_frame_zero():
    given = observations(tracks=np.tile([[0.0, 0, 6.5], [0, 5, 0.3]], (5, 1, 1)))
    found = floors(given)
    assert found["track_error"] == pytest.approx((0.5 + 0.3) / 2)
    assert found["track_error_bound"] < ROUND_OFF
    first = errors_per_frame(np.tile(given.nodes, (5, 1, 1)), given)
    assert found == pytest.approx({name: values[0] for name, values in first.items()})
    without = floors(observations())
    assert "chamfer" in without and not {"track_error", "track_error_bound"} & without.keys(), "there are no tracks"
