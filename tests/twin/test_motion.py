"""Motion of all nodes from observed points."""

from dataclasses import replace

import numpy as np
import pytest

from neuspring import config
from neuspring.core.errors import InputError
from neuspring.twin.candidates import candidate
from neuspring.twin.fit import fit
from neuspring.twin.losses import FrameLoss
from neuspring.twin.rollout import initial_velocity, spread
from tests.support import small

# The interpolation is smoothed by 1e-6 m; float32 positions of about 1 m carry 6e-8 m, times 30 frames per second, times 4.
SMOOTHED = 1e-4
ROUNDING = 1e-4


def moving(acceleration, velocity, frames=8):
    """The small scene with the same throw for every point and controller."""
    seen = small.observations()
    time = (np.arange(frames) / seen.scenario.frame_rate)[:, None, None]
    path = np.asarray(velocity) * time + np.asarray(acceleration) * time**2 / 2
    return replace(seen, object_points=seen.object_points[0] + path, controller_points=seen.controller_points[0] + path)


def test_spread_is_exact_at_points_and_linear_between_two():
    points = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    values = np.array([[1.0, 0, 0], [3.0, 2.0, 0]])
    nodes = np.array([[0.0, 0, 0], [0.25, 0, 0], [1.0, 0, 0]])
    np.testing.assert_allclose(spread(points, values, nodes), [[1, 0, 0], [1.5, 0.5, 0], [3, 2, 0]], atol=SMOOTHED)


def test_spread_takes_coinciding_points():
    points = np.zeros((20, 3))
    points[10:] = np.random.default_rng(0).normal(size=(10, 3))
    assert np.isfinite(spread(points, np.ones((20, 3)), points)).all()


def test_velocity_is_exact_under_constant_acceleration():
    seen = moving([0, 0, -9.8], [0.3, -0.2, 1.0])
    np.testing.assert_allclose(initial_velocity(seen, "observed"), np.tile([0.3, -0.2, 1.0], (len(seen.nodes), 1)), atol=ROUNDING)


def test_hidden_points_do_not_speak():
    seen = moving([0, 0, 0], [0.5, 0, 0])
    visible = np.array(seen.object_visibility)
    points = np.array(seen.object_points)
    visible[1, 0] = visible[2, 1] = False
    points[1, 0] = points[2, 1] = 0.0
    hidden = replace(seen, object_visibility=visible, object_points=points)
    np.testing.assert_allclose(initial_velocity(hidden, "observed")[:, 0], 0.5, atol=ROUNDING)


def test_only_training_frames_are_read():
    seen = moving([0, 0, -9.8], [0.3, 0, 0])
    early = replace(seen, scenario=replace(seen.scenario, train_end=2))
    points = np.array(seen.object_points)
    points[2:] += 1.0
    assert np.array_equal(initial_velocity(early, "observed"), initial_velocity(replace(early, object_points=points), "observed"))


def test_the_velocity_before_frame_0_reads_no_later_frame():
    seen = moving([0, 0, -9.8], [0.3, -0.2, 1.0])
    count = seen.object_points.shape[1] + seen.controller_points.shape[1]
    known = replace(seen, velocity_before=np.tile([1.0, 2.0, 3.0], (count, 1)))
    np.testing.assert_allclose(initial_velocity(known, "before"), np.tile([1.0, 2.0, 3.0], (len(seen.nodes), 1)), atol=ROUNDING)
    with pytest.raises(InputError, match=r"simulation\.initial_velocity: before needs.*Choose observed"):
        initial_velocity(seen, "before")


@pytest.mark.parametrize("kind", ["rest", "observed"])
def test_search_and_fit_start_with_the_observed_velocity(kind):
    """Everything flies along at 0.3 m/s without gravity or drag: with the right start, nothing is left to explain."""
    seen = moving([0, 0, 0], [0.3, 0, 0.1])
    seen = replace(seen, scenario=replace(seen.scenario, ground=False))
    simulation = config.SimulationSettings(gravity=0.0, initial_velocity=kind)
    problem = small.search_problem(seen, simulation=simulation)
    twin = candidate(problem, small.start_values() | {"drag": 0.0})
    loss = FrameLoss.of(seen, config.Losses(acceleration=0.0), "cpu")
    (truth,) = small.judge(replace(problem, losses=config.Losses(acceleration=0.0)), [twin], loss)
    fitted = fit(small.fit_problem(seen, twin=twin, simulation=simulation, fit=config.Fit(epochs=1)))
    # Millimeters squared: dashpots of controllers, which the released simulator holds at rest, leave a little.
    assert (truth.cost < 1e-6) == (fitted.facts["rollout_loss"] < 1e-6) == (kind == "observed"), (
        truth.cost,
        fitted.facts["rollout_loss"],
    )
