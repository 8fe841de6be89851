"""One twin on several recordings of an object: the search's costs, the fit's epochs, what is left out."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from neuspring import config
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.errors import InputError
from neuspring.twin.body import FitTask
from neuspring.twin.candidates import SearchProblem, made, mean_outcome
from neuspring.twin.fit import FitProblem, FitResult, TwinFit, fit, fit_many
from neuspring.twin.search import search
from neuspring.twin.trials import Outcome, outcomes
from tests.support import small
from tests.support.searches import LOGARITHMIC

MEAN = 1e-6
"""Relative: a mean of two losses in float32."""
SINGLE_POSITIONS = 3e-6
"""Relative: lengths of 0.02 m between positions at 0.2 m in float32, whose rounding is 1.2e-8 m, at both ends of both lengths."""
TIMES = ["seconds"]
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


def traced(problem: SearchProblem) -> pd.DataFrame:
    """The trace of a search, without times."""
    return search(problem, 0).trace.drop(columns=TIMES)


def searched(here: str, *others: str, **options) -> pd.DataFrame:
    """The trace of a short search."""
    return traced(on_pool(small.search_problem(seen(here)), *others, **options))


# Search ---------------------------------------------------------------------------------------------------------------


def test_a_recording_beside_itself_changes_nothing():
    alone = short(seen(LIFTED))
    pd.testing.assert_frame_equal(traced(on_pool(alone, LIFTED)), traced(alone), check_exact=True)


def test_costs_are_means_over_the_recordings():
    """The same candidates, judged on one recording, on two, and with the second one twice."""
    alone = short(seen(LIFTED))
    both = on_pool(alone, SHAKEN)
    problems = (alone, both, on_pool(alone, SHAKEN, SHAKEN))
    population = [both.encode(), 0.9 * both.encode()]
    costs = [np.array([row["cost"] for row in small.evaluated(each, population)]) for each in problems]
    families = [made(both, normalized)[1] for normalized in population]
    there = both.recordings[1]
    moved = [judged.cost for judged in outcomes([pair[1] for pair in families], there.hands, there.velocity, there.loss, "cpu")]
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


def test_threads_and_launches_change_nothing_in_a_pool():
    pd.testing.assert_frame_equal(searched(LIFTED, SHAKEN, threads=2, together=3), searched(LIFTED, SHAKEN))


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


def require_equal(one: FitResult, other: FitResult) -> None:
    """Raise AssertionError unless two fits are the same, bit for bit."""
    require_equal_twins(one.twin, other.twin)
    pd.testing.assert_frame_equal(one.history, other.history)
    assert (one.facts["best_epoch"], one.facts["best_loss"]) == (other.facts["best_epoch"], other.facts["best_loss"])
    moved = ("at_bound", "at_stiffness_range", "factors", "gradient_over_epsilon")
    assert [one.facts.get(name) for name in moved] == [other.facts.get(name) for name in moved]


def require_equal_twins(one: Twin, other: Twin) -> None:
    """Raise AssertionError unless material, rest lengths and simulation are the same."""
    for name in ("stiffness", "dashpot"):
        np.testing.assert_array_equal(getattr(one.material, name), getattr(other.material, name))
    np.testing.assert_array_equal(one.topology.rest_lengths, other.topology.rest_lengths)
    np.testing.assert_array_equal(one.topology.rest_shape, other.topology.rest_shape)
    assert one.simulation == other.simulation
    assert one.material.ground_friction == other.material.ground_friction


def test_an_oracle_on_a_pool_reads_the_future_of_what_counts():
    problem, late = problem_of(LIFTED, oracle=True, epochs=1), small.spoiled_future()
    one, other = (pooled(problem, seen).twin.material.stiffness for seen in (late, problem.observations))
    assert not np.array_equal(one, other)
    plain = problem_of(LIFTED, epochs=1)
    require_equal(pooled(plain, late), pooled(plain, plain.observations))


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


def test_a_killed_fit_continues_exactly(tmp_path, monkeypatch):
    monkeypatch.setattr("neuspring.core.checkpoint.CHECKPOINT_EVERY", 1)
    problem = problem_of(LIFTED, epochs=3)
    whole = pooled(problem, seen(SHAKEN))

    class Killed(Exception):
        pass

    def kill(history) -> None:
        if len(history) == 2:
            raise Killed

    path = tmp_path / "partial.npz"
    with pytest.raises(Killed):
        pooled(problem, seen(SHAKEN), partial=path, key="k", on_epoch=kill)
    continued = pooled(problem, seen(SHAKEN), partial=path, key="k")
    assert continued.attempts == 2
    require_equal(continued, whole)


def test_fits_on_a_pool_that_share_launches_have_the_numbers_of_each_alone():
    problem = replace(problem_of(LIFTED, epochs=2, horizon=2, learning_rate=3e-3), kind="field", pool=[seen(SHAKEN)])
    problems = [problem, replace(problem, seed=1)]
    for got, each in zip(fit_many([FitTask(one) for one in problems]), problems, strict=True):
        assert not isinstance(got, Exception), got
        require_equal(got, fit(each))


def test_recordings_need_the_same_nodes():
    other = replace(seen(SHAKEN), surface_points=seen(SHAKEN).surface_points[1:])
    with pytest.raises(InputError, match=r"as many nodes and controllers: \(124, 3\); received \(123, 3\) in small"):
        replace(problem_of(LIFTED), pool=[other])
