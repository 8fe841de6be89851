"""One twin on several recordings of an object: the search's costs, the fit's epochs, what is left out."""

import functools
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from neuspring import config
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.errors import InputError
from neuspring.twin.fit import FitProblem, FitResult, fit
from neuspring.twin.pooled import PooledFit
from neuspring.twin.recordings import Recording, mean_outcome
from neuspring.twin.search import SearchProblem, search
from neuspring.twin.trials import Outcome
from tests.support import small

MEAN = 1e-6
"""Relative: a mean of two losses in float32."""
TIMES = ["seconds"]
LIFTED, SHAKEN = "rope/lift/smooth", "rope/shake/smooth"


def seen(path: str) -> Observations:
    """The same rope, moved in one of two ways."""
    return small.scene(path).observations


def searched(here: str, *others: str, leave_out: bool = False, **changes) -> pd.DataFrame:
    """The trace of a short search, without times."""
    alone = small.search_problem(seen(here))
    pool = tuple(Recording.of(seen(path), alone.simulation, alone.losses, alone.quirks) for path in others)
    problem: SearchProblem = replace(alone, pool=pool, leave_out=leave_out, **changes)
    return search(problem, 0).trace.drop(columns=TIMES)


def spoiled(observations: Observations) -> Observations:
    """Everything after frame 0 is another motion, and hidden."""
    later = (np.arange(small.FRAMES) > 0)[:, None]
    return replace(
        observations,
        object_points=observations.object_points + later[..., None].astype(np.float32),
        controller_points=observations.controller_points - 0.5 * later[..., None].astype(np.float32),
        object_visibility=observations.object_visibility & ~later,
    )


# Search ---------------------------------------------------------------------------------------------------------------


def test_a_candidate_costs_the_mean_of_its_costs_on_each_recording():
    both = searched(LIFTED, SHAKEN)
    first = both["generation"] == 0
    # Later generations propose other candidates.
    alone, moved = searched(LIFTED)[first], searched(LIFTED, SHAKEN, leave_out=True)[first]
    np.testing.assert_allclose(both[first]["cost"], (alone["cost"] + moved["cost"]) / 2, rtol=MEAN)
    assert (np.abs(alone["cost"] / moved["cost"] - 1) > 0.1).any(), "two recordings say something else"


def test_a_recording_beside_itself_changes_nothing():
    pd.testing.assert_frame_equal(searched(LIFTED, LIFTED), searched(LIFTED))
    pd.testing.assert_frame_equal(searched(LIFTED, LIFTED, leave_out=True), searched(LIFTED))


def test_threads_and_launches_change_nothing_in_a_pool():
    pd.testing.assert_frame_equal(searched(LIFTED, SHAKEN, threads=2, together=3), searched(LIFTED, SHAKEN))


def test_a_twin_that_leaves_one_recording_has_left():
    one, other = Outcome(0.25, 0, 1), Outcome(float("inf"), 7, 2)
    assert mean_outcome([one]) is one
    assert mean_outcome([one, Outcome(0.75, 0, 2)]) == Outcome(0.5, 0, 3)
    assert mean_outcome([one, other, Outcome(float("inf"), 3, 0)]).left == 7


# Fit ------------------------------------------------------------------------------------------------------------------


def problem_of(path: str, **settings) -> FitProblem:
    """A fit of the rope's true twin whose stiffness is homogeneous and half as large."""
    truth = small.scene(path).truth
    low = np.full_like(truth.material.stiffness, 0.5 * float(np.median(truth.material.stiffness)))
    start = replace(truth, material=replace(truth.material, stiffness=low))
    changes = {"epochs": 4, "learning_rate": 5e-2, "checkpoint_every": 1} | settings
    return small.fit_problem(seen(path), twin=start, fit=config.Fit(**changes))


def pooled(problem: FitProblem, *pool: Observations, leave_out: bool = False, **options) -> FitResult:
    """A fit on a pool."""
    return fit(problem, run_of=functools.partial(PooledFit, pool=pool, leave_out=leave_out), **options)


def require_equal(one: FitResult, other: FitResult) -> None:
    """Raise AssertionError unless two fits are the same, bit for bit."""
    require_equal_twins(one.twin, other.twin)
    pd.testing.assert_frame_equal(one.history, other.history)
    assert (one.best_epoch, one.best_loss) == (other.best_epoch, other.best_loss)


def require_equal_twins(one: Twin, other: Twin) -> None:
    """Raise AssertionError unless material, rest lengths and simulation are the same."""
    for name in ("stiffness", "dashpot"):
        np.testing.assert_array_equal(getattr(one.material, name), getattr(other.material, name))
    np.testing.assert_array_equal(one.topology.rest_lengths, other.topology.rest_lengths)
    assert one.simulation == other.simulation
    assert one.material.ground_friction == other.material.ground_friction


SETTINGS = {
    "one frame": {},
    "all frames": {"horizon": 0},
    "tail": {"selection": "tail", "horizon": 2},
    "one step and tail": {"selection": "tail", "horizon": 0},
    "lengths and damping": {"rest_length_bound": 0.1, "damping": "springs", "schedule": "cosine", "homogeneous_epochs": 2},
}


@pytest.mark.parametrize("name", SETTINGS)
def test_a_pool_of_one_is_the_plain_fit(name):
    problem = problem_of(LIFTED, **SETTINGS[name])
    require_equal(pooled(problem), fit(problem))


def test_a_field_in_a_pool_of_one_is_the_plain_fit():
    field = config.SpringField(channels=4, hidden=16, bands=2)
    problem = replace(problem_of(LIFTED, field=field, learning_rate=1e-2), kind="field")
    require_equal(pooled(problem), fit(problem))


def test_left_out_recordings_lend_their_nodes_alone():
    problem, other = problem_of(LIFTED, selection="tail"), seen(SHAKEN)
    found = pooled(problem, other, leave_out=True)
    require_equal(pooled(replace(problem, observations=spoiled(problem.observations)), other, leave_out=True), found)
    # What is fitted is the other recording: on the same nodes, its own fit.
    own = fit(replace(problem, observations=other))
    np.testing.assert_array_equal(found.twin.material.stiffness, own.twin.material.stiffness)
    assert not np.array_equal(found.twin.material.stiffness, fit(problem).twin.material.stiffness)


def test_the_search_reads_nothing_of_what_is_left_out():
    here = seen(LIFTED)
    alone = small.search_problem(here)
    pool = (Recording.of(seen(SHAKEN), alone.simulation, alone.losses, alone.quirks),)
    first, second = (search(replace(alone, observations=o, pool=pool, leave_out=True), 0) for o in (here, spoiled(here)))
    pd.testing.assert_frame_equal(first.trace.drop(columns=TIMES), second.trace.drop(columns=TIMES))


def test_one_material_comes_nearer_to_two_recordings():
    problem = problem_of(LIFTED, epochs=10, horizon=0, learning_rate=5e-2)
    result = pooled(problem, seen(SHAKEN))
    truth = np.log(small.scene(LIFTED).truth.material.stiffness)

    def error(twin: Twin) -> float:
        return float(np.sqrt(np.square(np.log(twin.material.stiffness) - truth).mean()))

    assert error(result.twin) < error(fit(problem).twin) < error(problem.twin)
    assert result.history["loss"].iloc[-1] < 0.5 * result.history["loss"].iloc[0]
    assert result.rollbacks == []


def test_a_killed_fit_continues_exactly(tmp_path):
    problem = problem_of(LIFTED, rest_length_bound=0.1)
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


def test_recordings_with_other_nodes_are_refused():
    problem = problem_of(LIFTED)
    other = seen(SHAKEN)
    fewer = replace(other, surface_points=other.surface_points[1:])
    with pytest.raises(InputError, match=r"as many nodes and controllers: 124 and 3; received 123 and 3 in small.*mocap\.rings"):
        PooledFit(problem, pool=[fewer])

    order = np.random.default_rng(0).permutation(other.object_points.shape[1])
    shuffled = replace(other, surface_points=other.surface_points[::-1], object_points=other.object_points[:, order])
    with pytest.raises(InputError, match=r"must have the same nodes"):
        PooledFit(problem, pool=[shuffled])
    with pytest.raises(InputError, match=r"at least one other recording is required where this one is left out"):
        PooledFit(problem, leave_out=True)
