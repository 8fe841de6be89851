"""The residual of the last training frame in the prediction, and its guard."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring.artifacts import Trajectory
from neuspring.carry import TIME_CONSTANTS, carry_over, choose
from tests import small

RATE = 25.0


def fading(tau: float, frames: int = 60, points: int = 5, seed: int = 0) -> np.ndarray:
    """Residuals [F, P, 3] of an Ornstein-Uhlenbeck process with correlation time tau, s."""
    rng = np.random.default_rng(seed)
    keep = np.exp(-1 / (tau * RATE))
    values = [rng.normal(size=(points, 3))]
    for _ in range(frames - 1):
        values.append(keep * values[-1] + np.sqrt(1 - keep**2) * rng.normal(size=(points, 3)))
    return 0.01 * np.stack(values)


def test_lasting_residuals_are_carried_and_white_noise_is_not():
    assert choose(np.full((40, 5, 3), 0.01), 15, RATE)[0] == max(TIME_CONSTANTS)
    assert choose(fading(1e-3), 15, RATE)[0] == 0.0


def test_the_time_constant_follows_the_residual():
    times = [choose(fading(tau, 400, 40), 15, RATE)[0] for tau in (0.1, 1.0)]
    assert 0 < times[0] < times[1]


def test_too_few_frames_carry_nothing():
    assert choose(np.full((3, 5, 3), 0.01), 15, RATE) == (0.0, 0.0)


def shifted(frames: int | None = None) -> tuple[Trajectory, object]:
    """A prediction that is 1 cm off everywhere, always, and the observations of the small scene."""
    seen = replace(small.scene(frames=20).observations)
    positions = small.scene(frames=20).motion + np.array([0.01, 0, 0])
    kept = positions[:frames]
    return Trajectory(positions=kept, frame_count=len(kept)), seen


def test_a_constant_error_is_taken_off_the_future_alone():
    trajectory, seen = shifted()
    corrected, facts = carry_over(trajectory, seen)
    end = seen.scenario.train_end
    assert facts["time_constant"] > 0 and facts["gain"] > 0
    assert np.array_equal(corrected.positions[:end], trajectory.positions[:end])
    truth = small.scene(frames=20).motion
    before, after = (np.abs(p[end:] - truth[end:]).mean() for p in (trajectory.positions, corrected.positions))
    assert after < 0.5 * before


def test_the_future_is_not_read():
    trajectory, seen = shifted()
    points = np.array(seen.object_points)
    points[seen.scenario.train_end :] += 1.0
    blind = replace(seen, object_points=points)
    assert np.array_equal(carry_over(trajectory, seen)[0].positions, carry_over(trajectory, blind)[0].positions)


def test_a_rollout_that_ended_early_is_left_alone():
    trajectory, seen = shifted()
    short = Trajectory(positions=trajectory.positions[:5], frame_count=20, diverged_frame=5, reason="far")
    corrected, facts = carry_over(short, seen)
    assert corrected is short
    assert facts["time_constant"] == pytest.approx(0.0)
