"""The state at a frame, by least squares through the simulator."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring.config import LastFrame
from neuspring.core.artifacts import Observations, Twin
from neuspring.twin import carry
from neuspring.twin.carry import carry_over, training_states
from neuspring.twin.last_frame import STEP, State, StateEstimator, soft_modes
from neuspring.twin.rollout import roll_out
from tests.support import small

FRAMES = 30
SETTINGS = LastFrame(window=5, modes=16, iterations=3, weights=(1e-3, 1e2))
QUICK = LastFrame(window=3, modes=8, iterations=1, weights=(1e-3,))


def disturbed(noise: float = 0.0) -> tuple[Twin, Observations, np.ndarray, list[State], list[State]]:
    """The true twin, what was observed, a wrong velocity of frame 0, the states that follow from it, and the true ones.

    The wrong velocity is smooth over the body; when the window begins it has become a smooth error of positions and velocities.
    """
    scene = small.scene(frames=FRAMES, noise=noise)
    nodes = scene.observations.nodes
    along = (nodes[:, :1] - nodes[:, :1].min()) / np.ptp(nodes[:, 0])
    velocity = 0.4 * np.concatenate([0 * along, np.cos(2 * along), np.sin(3 * along)], axis=1)
    states = [training_states(scene.truth, scene.observations, start) for start in (velocity, np.zeros_like(velocity))]
    return scene.truth, scene.observations, velocity, *states  # type: ignore[return-value]


def away(state: State, true: State) -> tuple[float, float]:
    """Mean distances from the true state, m and m/s."""
    position, speed = (float(np.linalg.norm(one - other, axis=1).mean()) for one, other in zip(state, true, strict=True))
    return position, speed


def test_a_smoothly_disturbed_state_is_recovered():
    twin, seen, _, states, true = disturbed()
    last = seen.scenario.train_end - 1
    estimated, held = StateEstimator(twin, seen, SETTINGS).estimates(last, states)
    (before, _), (after, _) = (away(state, true[last]) for state in (states[last], estimated))
    assert before > 3e-3
    assert after < 0.1 * before
    # A strong prior keeps the state where it was.
    assert away(held, states[last])[0] < 0.05 * before


def test_prediction_goes_on_from_the_recovered_state(monkeypatch):
    monkeypatch.setattr(carry, "ORIGINS", 2)
    twin, seen, velocity, _, _ = disturbed()
    trajectory = roll_out(twin, seen.controller_points, velocity=velocity)
    corrected, facts = carry_over(trajectory, twin, seen, velocity, "cpu", "state", QUICK)
    end, points = seen.scenario.train_end, seen.object_points.shape[1]
    errors = [
        np.linalg.norm(one.positions[end:, :points] - seen.object_points[end:], axis=2).mean() for one in (trajectory, corrected)
    ]
    assert facts["carried"] == 1 and facts["gain"] > 0.5 and facts["weight"] == 1e-3
    assert errors[1] < 0.3 * errors[0]
    np.testing.assert_array_equal(corrected.positions[:end], trajectory.positions[:end])


def test_the_guard_refuses_where_it_does_not_help(monkeypatch):
    monkeypatch.setattr(carry, "ORIGINS", 4)
    scene = small.scene(frames=FRAMES, noise=0.01)
    rest = np.zeros_like(scene.observations.nodes)
    trajectory = roll_out(scene.truth, scene.observations.controller_points)
    corrected, facts = carry_over(trajectory, scene.truth, scene.observations, rest, "cpu", "state", QUICK)
    assert corrected is trajectory
    assert facts["carried"] == 0 and facts["gain"] < 0.02


def test_controllers_are_where_they_were_observed():
    """An estimate is a rollout: from the same start, under the observed hands, it ends in the same state."""
    twin, seen, velocity, states, _ = disturbed()
    estimator = StateEstimator(twin, seen, SETTINGS)
    x, v = states[9]
    run = estimator.simulate(np.array([x, x]), np.array([v, v]), 9, FRAMES - 1)
    expected = roll_out(twin, seen.controller_points, velocity=velocity).positions[9:]
    for positions in run.positions:
        np.testing.assert_array_equal(positions, expected)
    before = seen.controller_points.copy()
    estimator.estimates(seen.scenario.train_end - 1, states)
    np.testing.assert_array_equal(seen.controller_points, before)


@pytest.mark.parametrize("hidden", ["visibility", "motion"])
def test_points_that_are_not_seen_or_moved_badly_do_not_speak(hidden):
    twin, seen, _, states, _ = disturbed()
    last = seen.scenario.train_end - 1
    visible, valid, points = (np.array(a) for a in (seen.object_visibility, seen.object_motion_valid, seen.object_points))
    if hidden == "visibility":
        visible[last, ::2] = False
    else:
        valid[last - 1, ::2] = False
    lost = points.copy()
    lost[last, ::2] += 1.0
    results = []
    for places in (points, lost):
        changed = replace(seen, object_visibility=visible, object_motion_valid=valid, object_points=places)
        results.append(StateEstimator(twin, changed, SETTINGS).estimates(last, states)[0][0])
    np.testing.assert_array_equal(*results)


def test_without_observations_the_state_stays():
    twin, seen, _, states, _ = disturbed()
    last = seen.scenario.train_end - 1
    visible = np.zeros_like(seen.object_visibility)
    visible[0] = True
    blind = replace(seen, object_visibility=visible)
    for state in StateEstimator(twin, blind, SETTINGS).estimates(last, states):
        np.testing.assert_allclose(state[0], states[last][0], atol=1e-6)


def test_a_simulation_that_diverges_is_marked_and_leaves_the_others_alone():
    twin, seen, _, states, _ = disturbed()
    estimator = StateEstimator(twin, seen, SETTINGS)
    x, v = (np.array([values] * 2) for values in states[9])
    alone = estimator.simulate(x, v, 9, 14)
    wild = v.copy()
    wild[1] = 1e9
    run = estimator.simulate(x, wild, 9, 14)
    assert np.isnan(run.positions[1, 1:]).all()
    np.testing.assert_array_equal(run.positions[0], alone.positions[0])


@pytest.mark.parametrize("path", ["rope/lift/smooth", "cloth/lift/smooth"])
def test_modes_are_orthogonal_of_unit_size_and_softer_than_any_others(path):
    scene = small.scene(path)
    twin, seen = scene.truth, scene.observations
    modes = soft_modes(twin, seen.nodes, seen.controller_points[0], 12)
    nodes = len(seen.nodes)
    np.testing.assert_allclose(np.tensordot(modes, modes, ((1, 2), (1, 2))) / nodes, np.eye(12), atol=1e-6)

    def energy(u: np.ndarray) -> float:
        """Of a small displacement, by finite lengths of the springs."""
        ends = np.concatenate([seen.nodes, seen.controller_points[0]]).astype(np.float64)
        moved = ends.copy()
        moved[:nodes] += STEP * u
        pairs, rest = twin.topology.springs, twin.topology.rest_lengths
        length = [np.linalg.norm(np.diff(places[pairs], axis=1)[:, 0], axis=1) for places in (ends, moved)]
        return float((twin.material.stiffness / rest * (length[1] - length[0]) ** 2).sum())

    rough = np.random.default_rng(0).standard_normal(modes[0].shape)
    assert energy(modes[0]) < 0.01 * energy(rough / np.sqrt((rough**2).sum() / nodes))


def test_a_large_body_has_the_same_softest_modes_by_the_sparse_way(monkeypatch):
    scene = small.scene()
    at = (scene.truth, scene.observations.nodes, scene.observations.controller_points[0], 5)
    dense = soft_modes(*at)
    monkeypatch.setattr("neuspring.twin.last_frame.DENSE", 0)
    sparse = soft_modes(*at)
    overlap = np.abs(np.linalg.svd(np.tensordot(dense, sparse, ((1, 2), (1, 2))) / len(at[1]))[1])
    np.testing.assert_allclose(overlap, 1, atol=1e-3)
