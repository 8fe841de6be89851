"""Grasps that begin later, in searches, fits and corrected states; the future is not read."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuspring import config
from neuspring.core.artifacts import Observations
from neuspring.twin.fit import TwinFit
from neuspring.twin.losses import FrameLoss
from neuspring.twin.rollout import roll_out
from neuspring.twin.search import search
from tests.support import small

SINGLE = 1e-5
"""Relative: losses in float32, summed in another order."""


def regripped(seen: Observations, begin: int = 2) -> Observations:
    """The hands hold from frame `begin` on; one of them has held from the start."""
    valid = np.ones(seen.controller_points.shape[:2], bool)
    valid[:begin, 1:] = False
    return replace(seen, controller_valid=valid)


def outcome(twin, seen):
    return roll_out(twin, seen.controller_points, valid=seen.controller_valid).positions


def test_a_fit_simulates_what_a_rollout_does():
    seen = regripped(small.observations())
    problem = small.fit_problem(seen)
    trained = TwinFit(problem)
    positions = torch.tensor(outcome(problem.twin, seen))
    loss = FrameLoss.of(seen, config.Losses(), "cpu")
    for horizon in (1, 2, 4):
        (own,) = trained.recordings
        state, start = own.rest, 1
        while start < seen.scenario.train_end:
            window = range(start, min(start + horizon, seen.scenario.train_end))
            state, mean = small.done(own.simulate(state, window, own.stable(trained.parameters)))
            wanted = torch.stack([loss(frame, positions[frame]) for frame in window]).mean()
            assert float(mean.detach()) == pytest.approx(float(wanted), rel=SINGLE)
            state, start = (state[0].detach(), state[1].detach(), None if state[2] is None else state[2].detach()), window.stop
    assert np.abs(outcome(problem.twin, seen) - roll_out(problem.twin, seen.controller_points).positions).max() > 1e-4


def test_a_search_knows_grips_and_does_not_read_the_future():
    first, second, plain = (
        search(small.search_problem(seen), 0)
        for seen in (regripped(small.observations()), regripped(small.spoiled_future()), small.observations())
    )
    np.testing.assert_array_equal(first.trace["cost"], second.trace["cost"])
    assert first.cost != plain.cost
