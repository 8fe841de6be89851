"""The state of the last training frame, corrected by what was observed there, and the guard."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuspring.config import LastFrame
from neuspring.core.artifacts import Observations, Trajectory, Twin
from neuspring.physics.autograd import solver_for
from neuspring.twin import carry
from neuspring.twin.carry import carry_over
from neuspring.twin.rollout import frames, roll_out
from tests.support import small

FRAMES = 30
KICK = np.array([0.0, 0.4, 0.0])
"""Of all nodes in frame 0, m/s, where truly nothing moves: an error that dies out slowly."""


def kicked(noise: float = 0.0, wrong: bool = True) -> tuple[Trajectory, Twin, Observations, np.ndarray]:
    """The true twin of the small scene, rolled out from a wrong velocity or the right one."""
    scene = small.scene(frames=FRAMES, noise=noise)
    velocity = np.tile(KICK * wrong, (len(scene.observations.nodes), 1))
    trajectory = roll_out(scene.truth, scene.observations.controller_points, velocity=velocity)
    return trajectory, scene.truth, scene.observations, velocity


def future_error(trajectory: Trajectory, seen: Observations) -> float:
    """Mean distance of tracked points after the split, m."""
    end, points = seen.scenario.train_end, seen.object_points
    return float(np.linalg.norm(trajectory.positions[end:, : points.shape[1]] - points[end:], axis=2).mean())


def test_the_future_goes_on_from_what_was_seen_last():
    trajectory, twin, seen, velocity = kicked()
    corrected, facts = carry_over(trajectory, twin, seen, velocity)
    end = seen.scenario.train_end
    assert facts["carried"] == 1 and 0.02 < facts["gain"] < 1
    np.testing.assert_array_equal(corrected.positions[:end], trajectory.positions[:end])
    assert corrected.positions.shape == trajectory.positions.shape
    assert future_error(corrected, seen) < 0.5 * future_error(trajectory, seen)


def test_noise_is_not_carried_into_a_right_prediction():
    trajectory, twin, seen, velocity = kicked(noise=0.01, wrong=False)
    corrected, facts = carry_over(trajectory, twin, seen, velocity)
    assert facts["carried"] == 0 and facts["gain"] < 0
    assert corrected is trajectory


@pytest.mark.parametrize("how", ["residuals", "state"])
def test_the_future_is_not_read(how, monkeypatch):
    monkeypatch.setattr(carry, "ORIGINS", 3)
    trajectory, twin, seen, velocity = kicked()
    end = seen.scenario.train_end
    points, visible, valid = (np.array(a) for a in (seen.object_points, seen.object_visibility, seen.object_motion_valid))
    points[end:] += 1.0
    visible[end:] ^= True
    valid[end - 1 :] ^= True
    blind = replace(seen, object_points=points, object_visibility=visible, object_motion_valid=valid, tracks=seen.tracks + 1.0)
    settings = LastFrame(window=2, modes=4, iterations=1, weights=(1e-2, 1.0))
    result, facts = carry_over(trajectory, twin, blind, velocity, "cpu", how, settings)
    expected, expected_facts = carry_over(trajectory, twin, seen, velocity, "cpu", how, settings)
    assert facts["carried"] == 1
    np.testing.assert_array_equal(result.positions, expected.positions)
    assert facts == expected_facts


def test_a_rollout_goes_on_from_a_state_as_if_it_had_not_stopped():
    trajectory, twin, seen, velocity = kicked()
    solver, hands = solver_for(twin, differentiable=False), torch.tensor(seen.controller_points)
    states = {frame: (x, v) for frame, x, v in frames(twin, solver, hands, velocity)}
    x, v = (values.numpy() for values in states[9])
    later = [x.numpy() for _, x, _ in frames(twin, solver, hands[9:], v, positions=x)]
    np.testing.assert_array_equal(later, trajectory.positions[10:])


def test_hidden_points_do_not_speak():
    trajectory, twin, seen, velocity = kicked()
    last = seen.scenario.train_end - 1
    visible, points = np.array(seen.object_visibility), np.array(seen.object_points)
    visible[last, ::2] = False
    lost = points.copy()
    lost[last, ::2] += 1.0
    results = [
        carry_over(trajectory, twin, replace(seen, object_visibility=visible, object_points=p), velocity)[0] for p in (points, lost)
    ]
    np.testing.assert_array_equal(results[0].positions, results[1].positions)


def test_a_continuation_that_diverges_is_not_used(monkeypatch):
    trajectory, twin, seen, velocity = kicked()
    monkeypatch.setattr(carry.Residuals, "corrected", lambda *_: [None])
    corrected, facts = carry_over(trajectory, twin, seen, velocity)
    assert corrected is trajectory
    assert facts == {"gain": -1.0, "carried": 0.0}


@pytest.mark.parametrize("train_end", [2, 3])
def test_too_few_training_frames_carry_nothing(train_end):
    trajectory, twin, seen, velocity = kicked()
    corrected, facts = carry_over(trajectory, twin, replace(seen, scenario=replace(seen.scenario, train_end=train_end)), velocity)
    assert corrected is trajectory
    assert facts["carried"] == 0


def test_a_rollout_that_diverged_is_left_alone():
    trajectory, twin, seen, velocity = kicked()
    short = Trajectory(positions=trajectory.positions[:5], frame_count=FRAMES, diverged_frame=5, reason="far")
    assert carry_over(short, twin, seen, velocity)[0] is short
