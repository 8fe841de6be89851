"""One twin on several recordings of an object: the search's costs, the fit's epochs, what is left out."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from neuspring import config
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.errors import InputError
from neuspring.twin.batch import run_batch
from neuspring.twin.candidates import PENALTY, SearchProblem, evaluate, made, mean_outcome
from neuspring.twin.fit import FitProblem, FitResult, PooledFit, fit
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
    costs = [np.array([row["cost"] for row in evaluate(each, population, False, 0, 0)]) for each in problems]
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


def test_a_candidate_whose_hands_reach_one_recording_alone_costs_the_penalty():
    problem, other = small.search_problem(seen(LIFTED)), other_nodes(SHAKEN)
    away = replace(other, controller_points=other.controller_points + np.float32(0.3))
    rows = evaluate(replace(problem, pool=(away,)), [problem.encode()], False, 0, 0)
    assert (rows[0]["cost"], "a hand must be within" in rows[0]["reason"]) == (PENALTY, True)
    giant = replace(other, surface_points=3 * other.surface_points)
    with pytest.raises(InputError, match="must be of the same object"):
        replace(problem, pool=(giant,))


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
    moved = ("at_bound", "at_stiffness_range", "roughness", "factors", "gradient_over_epsilon")
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
    run = PooledFit(replace(problem, pool=[larger]))
    with torch.no_grad():
        run.parameters.offsets.normal_(0.0, 0.2, generator=torch.Generator().manual_seed(0))
    here, there = (member.parameters.physical() for member in run._members)
    torch.testing.assert_close(there["rest_lengths"], 2 * here["rest_lengths"])
    assert torch.equal(there["stiffness"], here["stiffness"])
    assert {member.loss_scale for member in run._members} == {run.loss_scale}
    before = run.parameters.copy()
    run.set_rate(1.0)
    run.epoch()
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


def other_nodes(path: str) -> Observations:
    """The rope in another sampling: points in another order, and one fewer."""
    other = seen(path)
    order = np.random.default_rng(0).permutation(other.object_points.shape[1])
    changes = {name: getattr(other, name)[:, order] for name in ("object_points", "object_visibility", "object_motion_valid")}
    return replace(other, surface_points=other.surface_points[:0:-1], **changes)


def test_a_field_is_read_at_the_places_of_other_nodes():
    """The same springs in another order of nodes have the same stiffness, whatever the field says of each place."""
    problem = replace(problem_of(LIFTED, epochs=1), kind="field")
    whole = seen(LIFTED)
    order = np.random.default_rng(0).permutation(len(whole.surface_points))
    run = PooledFit(replace(problem, pool=[replace(whole, surface_points=whole.surface_points[order])]))
    with torch.no_grad():
        for tensor in run.parameters.field.layers[-1].parameters():
            tensor.normal_(0.0, 0.3, generator=torch.Generator().manual_seed(0))
    here, there = (member.parameters.as_twin(member.twin) for member in run._members)
    points, count = whole.object_points.shape[1], whole.surface_count
    place = np.arange(len(whole.nodes) + whole.controller_points.shape[1])
    place[points:count] = points + order

    def known(twin: Twin, names: np.ndarray) -> dict[frozenset, float]:
        springs = names[twin.topology.springs].tolist()
        return {frozenset(pair): value for pair, value in zip(springs, twin.material.stiffness, strict=True)}

    one, other = known(here, np.arange(len(place))), known(there, place)
    common = sorted(one.keys() & other.keys(), key=sorted)
    assert len(common) > 0.5 * len(one)
    ratio = np.log([other[pair] / one[pair] for pair in common])
    assert np.std(np.log([one[pair] for pair in common])) > 0.1
    np.testing.assert_allclose(ratio, np.median(ratio), atol=1e-3)


def test_a_material_of_other_nodes_comes_nearer_to_what_was_seen():
    problem = replace(problem_of(LIFTED, epochs=6, horizon=0, learning_rate=3e-3), kind="field")
    result = pooled(problem, other_nodes(SHAKEN))
    assert result.facts["rollbacks"] == []
    assert result.history["loss"].iloc[-1] < 0.8 * result.history["loss"].iloc[0]


def test_fits_on_a_pool_that_share_launches_have_the_numbers_of_each_alone():
    problem = replace(problem_of(LIFTED, epochs=2, horizon=2, learning_rate=3e-3), kind="field", pool=[other_nodes(SHAKEN)])
    problems = [problem, replace(problem, seed=1)]
    works = [lambda lane, each=each: fit(each, lane=lane) for each in problems]
    together = run_batch([each.twin for each in problems], "cpu", works)
    for got, each in zip(together, problems, strict=True):
        assert not isinstance(got, Exception), got
        require_equal(got, fit(each))


def test_free_springs_and_cables_need_the_same_nodes():
    problem = problem_of(LIFTED)
    with pytest.raises(InputError, match=r"must have the same nodes where each spring has a number of its own.*Choose a field"):
        PooledFit(replace(problem, pool=[other_nodes(SHAKEN)]))
    cable = replace(other_nodes(SHAKEN), line=np.arange(5))
    with pytest.raises(InputError, match=r"as many nodes and controllers: \(124, 3\); received \(123, 3\) in small.*Sample all"):
        replace(problem, pool=[cable])


def test_of_a_recording_that_is_left_out_frame_0_alone_is_read():
    """Search and fit on the other recording are the same whatever the own one does later; its own nodes carry the twin."""
    own = seen(LIFTED)
    late = {name: getattr(own, name).copy() for name in ("object_points", "controller_points")}
    for values in late.values():
        values[1:] += 1.0
    other = replace(own, **late, tracks=own.tracks + 1.0)
    traces = [traced(on_pool(small.search_problem(each), SHAKEN, leave_out=True)) for each in (own, other)]
    pd.testing.assert_frame_equal(*traces)
    assert not np.array_equal(traces[0]["cost"], searched(LIFTED, SHAKEN)["cost"])
    problem = replace(problem_of(LIFTED, epochs=2), pool=[seen(SHAKEN)], leave_out=True)
    one, another = (fit(replace(problem, observations=each)) for each in (own, other))
    require_equal(one, another)
    np.testing.assert_array_equal(one.twin.topology.nodes, own.nodes)
    assert one.facts["spring_updates"] * 2 == pooled(problem_of(LIFTED, epochs=2), seen(SHAKEN)).facts["spring_updates"]
