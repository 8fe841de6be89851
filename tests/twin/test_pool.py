"""One twin on several recordings of an object: the search's costs, the fit's epochs, what is left out."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from neuspring import config
from neuspring.core.artifacts import Observations, Twin
from neuspring.twin.body import FitTask
from neuspring.twin.candidates import SearchProblem, made, mean_outcome
from neuspring.twin.fit import FitProblem, FitResult, TwinFit, fit, fit_many
from neuspring.twin.trials import Outcome, Rollouts, rolled
from tests.support import small
from tests.support.searches import LOGARITHMIC

SINGLE_POSITIONS = 3e-6
"""Relative: lengths of 0.02 m between positions at 0.2 m in float32, whose rounding is 1.2e-8 m, at both ends of both lengths."""
PLACES = ("object_points", "surface_points", "controller_points")
LIFTED, SHAKEN = "rope/lift/smooth", "rope/shake/smooth"


def seen(path: str) -> Observations:
    """The same rope, moved in one of two ways."""
    return small.scene(path).observations


def short(own: Observations, **changes) -> SearchProblem:
    """A search of one generation."""
    settings = {"rollouts": 11, "start": {"object_radius": 0.045, "stiffness": 6e3}}
    return small.search_problem(own, search=small.released(**settings, **LOGARITHMIC), **changes)


def on_pool(alone: SearchProblem, *others: str, **changes) -> SearchProblem:
    """The search on other recordings too."""
    return replace(alone, pool=tuple(map(seen, others)), **changes)


# Search ---------------------------------------------------------------------------------------------------------------


def test_costs_are_means_over_the_recordings():
    """The same candidates, judged on one recording, on two, and with the second one twice."""
    alone = short(seen(LIFTED))
    both = on_pool(alone, SHAKEN)
    problems = (alone, both, on_pool(alone, SHAKEN, SHAKEN))
    population = [both.encode(), 0.9 * both.encode()]
    costs = [np.array([row["cost"] for row in small.evaluated(each, population)]) for each in problems]
    families = [made(both, normalized)[1] for normalized in population]
    there = both.recordings[1]
    (judged,) = rolled([Rollouts([pair[1] for pair in families], there.hands, there.velocity, there.loss)], "cpu")
    moved = [one.cost for one in judged]
    np.testing.assert_allclose(costs[1], (costs[0] + moved) / 2, rtol=1e-12)
    np.testing.assert_allclose(costs[2], (costs[0] + moved + moved) / 3, rtol=1e-12)


def test_springs_and_radii_are_the_same_on_all_recordings():
    """Lengths in spacings of the scenario's own body, whatever the poses of the others."""
    search_settings = replace(short(seen(LIFTED)).search, lengths="spacing")
    alone = replace(short(seen(LIFTED)), search=search_settings)
    stretched = replace(seen(SHAKEN), **{name: 1.1 * getattr(seen(SHAKEN), name) for name in PLACES})
    _, (here, there) = made(replace(alone, pool=(stretched,)), alone.encode())
    np.testing.assert_array_equal(here.topology.springs, there.topology.springs)
    np.testing.assert_allclose(there.topology.rest_lengths, 1.1 * here.topology.rest_lengths, rtol=SINGLE_POSITIONS)


def test_a_twin_that_leaves_one_recording_has_left():
    one, other = Outcome(0.25, 0, 1), Outcome(float("inf"), 7, 2)
    assert mean_outcome([one]) is one
    assert mean_outcome([one, Outcome(0.75, 0, 2)]) == Outcome(0.5, 0, 3)
    assert mean_outcome([one, other, Outcome(float("inf"), 3, 0)]).diverged_frame == 7


# Fit ------------------------------------------------------------------------------------------------------------------


def problem_of(path: str, *, oracle: bool = False, **settings) -> FitProblem:
    """A fit of the rope's true twin whose stiffness is homogeneous and half as large."""
    truth = small.scene(path).truth
    low = np.full_like(truth.material.stiffness, 0.5 * float(np.median(truth.material.stiffness)))
    start = replace(truth, material=replace(truth.material, stiffness=low))
    changes = {"epochs": 4, "learning_rate": 5e-2} | settings
    return small.fit_problem(seen(path), twin=start, fit=config.Fit(**changes), oracle=oracle)


def pooled(problem: FitProblem, *pool: Observations, **options) -> FitResult:
    """A fit on a pool."""
    return fit(replace(problem, pool=pool), **options)


def require_equal(one: FitResult, other: FitResult):
    """Raise AssertionError unless two fits are the same, bit for bit."""
    require_equal_twins(one.twin, other.twin)
    pd.testing.assert_frame_equal(one.history, other.history)
    assert (one.facts["best_epoch"], one.facts["rollout_loss"]) == (other.facts["best_epoch"], other.facts["rollout_loss"])
    moved = ("at_bound", "at_stiffness_range", "factors")
    assert [one.facts.get(name) for name in moved] == [other.facts.get(name) for name in moved]


def require_equal_twins(one: Twin, other: Twin):
    """Raise AssertionError unless material, rest lengths and simulation are the same."""
    for name in ("stiffness", "dashpot"):
        np.testing.assert_array_equal(getattr(one.material, name), getattr(other.material, name))
    np.testing.assert_array_equal(one.topology.rest_lengths, other.topology.rest_lengths)
    np.testing.assert_array_equal(one.topology.rest_shape, other.topology.rest_shape)
    assert one.simulation == other.simulation
    assert one.material.ground_friction == other.material.ground_friction


def test_recordings_share_one_material_and_one_unit():
    problem = problem_of(LIFTED, epochs=1)
    larger = replace(seen(SHAKEN), **{name: 2 * getattr(seen(SHAKEN), name) for name in PLACES})
    run = TwinFit(replace(problem, pool=[larger]))
    with torch.no_grad():
        run.parameters.offsets.normal_(0.0, 0.2, generator=torch.Generator().manual_seed(0))
    here, there = (run.parameters.physical(one.start) for one in run.recordings)
    torch.testing.assert_close(there["rest_lengths"], 2 * here["rest_lengths"])
    assert torch.equal(there["stiffness"], here["stiffness"])
    before = run.parameters.copy()
    run.set_rate(1.0)
    small.done(run.epoch())
    assert not np.array_equal(before["offsets"], run.parameters.copy()["offsets"])


def test_one_material_comes_nearer_to_two_recordings():
    problem = problem_of(LIFTED, epochs=10, horizon=0, learning_rate=5e-2)
    result = pooled(problem, seen(SHAKEN))
    truth = np.log(small.scene(LIFTED).truth.material.stiffness)

    def error(twin: Twin) -> float:
        return float(np.sqrt(np.square(np.log(twin.material.stiffness) - truth).mean()))

    assert error(result.twin) < error(fit(problem).twin) < error(problem.twin)
    assert result.history["loss"].iloc[-1] < 0.5 * result.history["loss"].iloc[0]
    assert result.facts["rollbacks"] == []


@pytest.mark.slow
def test_fits_on_a_pool_that_share_launches_have_the_numbers_of_each_alone():
    problem = replace(problem_of(LIFTED, epochs=2, horizon=2, learning_rate=3e-3), kind="field", pool=[seen(SHAKEN)])
    problems = [problem, replace(problem, seed=1)]
    for got, each in zip(fit_many([FitTask(one) for one in problems]), problems, strict=True):
        assert not isinstance(got, Exception), got
        require_equal(got, fit(each))
