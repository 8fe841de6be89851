"""Searches and fits of several scenes that share launches: results equal those of each scene alone, bit for bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from neuspring import config
from neuspring.config.simulation import SimulationSettings
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.physics.parameters import packed
from neuspring.physics.solver import FrameSolver, solver_of
from neuspring.physics.union import Union
from neuspring.twin import fit as fit_module
from neuspring.twin import search as module
from neuspring.twin.batch import SharedFrames, lockstep
from neuspring.twin.body import FitTask
from neuspring.twin.candidates import SearchProblem, candidate
from neuspring.twin.fit import FitProblem, fit, fit_many
from neuspring.twin.search import SearchRun, search, search_many
from tests.support import small
from tests.support.devices import COST_LARGEST, COST_MEDIAN, CUDA, DEVICES, LOSS

SCENES = ("rope/lift/smooth", "cloth/lift/smooth")


def seen(path: str, *, frames: int = small.FRAMES, collide: bool = False) -> Observations:
    found = small.scene(path, frames=frames).observations
    return replace(found, scenario=replace(found.scenario, self_collision=collide))


def problems(collide: bool = False, **changes: object) -> list[SearchProblem]:
    """A rope, a sheet with more nodes whose recording is longer, and the rope once more: two of one scene among three."""
    each = [(SCENES[0], small.FRAMES), (SCENES[1], small.FRAMES + 2), (SCENES[0], small.FRAMES)]
    settings = small.released(rollouts=33, start={"object_radius": 0.045, "stiffness": 1e4})
    return [small.search_problem(seen(path, frames=count, collide=collide), search=settings, **changes) for path, count in each]


@pytest.mark.parametrize("share", [False, True])
def test_searches_of_several_scenes_end_as_each_alone(share, monkeypatch):
    """In turns, as on a CPU, or with shared launches, as on a GPU."""
    given, sizes = problems(collide=share), []
    assert len({len(one.observations.nodes) for one in given}) == 2
    alone = [search(problem, seed=k).trace for k, problem in enumerate(given)]
    original = module.rolled
    monkeypatch.setattr(module, "rolled", lambda each, device: sizes.append(len(each)) or original(each, device))
    courses = [module._course(SearchRun(problem, k), map) for k, problem in enumerate(given)]
    together = lockstep(courses, partial(module._roll_out, "cpu", map, share=share))
    for got, wanted in zip(together, alone, strict=True):
        pd.testing.assert_frame_equal(got.trace.drop(columns="seconds"), wanted.drop(columns="seconds"), check_exact=True)
    assert max(sizes) >= 3 if share else set(sizes) == {1}


def test_a_search_that_fails_does_not_stop_the_others():
    good, other, _ = problems()
    bad = replace(other, simulation=SimulationSettings(substeps=1))
    together = search_many([SearchRun(good, 0), SearchRun(bad, 0)])
    pd.testing.assert_series_equal(together[0].trace["cost"], search(good, seed=0).trace["cost"], check_exact=True)
    assert isinstance(together[1], InputError | NumericalFailure)


def fits(device: str = "cpu") -> list[FitProblem]:
    """The rope, the sheet, and the rope, in step and out of step."""
    settings = config.Fit(epochs=2, learning_rate=5e-3)
    started = [(problem, candidate(problem, small.start_values())) for problem in problems()]
    base = small.fit_problem(fit=settings, device=device)
    return [replace(base, observations=problem.observations, twin=twin) for problem, twin in started]


def together(given: Sequence[FitProblem], tasks: Sequence[FitTask] = ()) -> list[Any]:
    """Fits in one lockstep, whether they are in step or not."""
    courses = [fit_module._course(task, share=0.5) for task in tasks or [FitTask(problem) for problem in given]]
    return lockstep(courses, SharedFrames().serve)


def test_fits_of_several_scenes_end_as_each_alone():
    given = fits()
    for got, problem in zip(together(given), given, strict=True):
        small.assert_same_fit(got, fit(problem))


def several() -> list[FitProblem]:
    """Springs and fields, topologies, substeps and horizons of their own: out of step, and some end before others."""
    values = small.start_values()
    base = small.fit_problem()
    coarse = small.fit_problem(values=values | {"object_neighbors": 7.0, "stiffness": 2e4})
    return [
        base,
        replace(base, fit=replace(base.fit, learning_rate=0.5)),
        replace(coarse, kind="field", seed=3, fit=replace(base.fit, learning_rate=5e-3)),
        replace(base, fit=replace(base.fit, horizon=3, epochs=4)),
        replace(coarse, fit=replace(base.fit, horizon=0, selection="tail", epochs=2)),
        # Windows of three frames and of one, beside one of four that begins with them.
        replace(coarse, fit=replace(base.fit, horizon=0, epochs=2)),
    ]


@pytest.mark.slow
def test_fits_in_and_out_of_step_equal_those_alone(tmp_path, monkeypatch):
    """Whatever the others do: more substeps, another horizon, an earlier end, an error. Each continues from its checkpoint."""
    problems = several()
    alone = [fit(problem) for problem in problems]
    assert alone[1].twin.simulation.substeps > problems[1].twin.simulation.substeps
    monkeypatch.setattr("neuspring.core.checkpoint.CHECKPOINT_EVERY", 1)
    broken = replace(problems[0], simulation=replace(problems[0].simulation, substeps=1))
    broken = replace(broken, twin=replace(broken.twin, simulation=replace(broken.twin.simulation, substeps=1)))
    tasks = [FitTask(problem, tmp_path / f"{k}.npz", "k") for k, problem in enumerate([*problems, broken])]
    *got, failed = together((), tasks)
    assert isinstance(failed, NumericalFailure)
    for k, wanted in enumerate(alone):
        small.assert_same_fit(got[k], wanted)
        continued = fit(problems[k], partial=tmp_path / f"{k}.npz", key="k")
        small.assert_same_fit(continued, wanted)
        assert continued.attempts == 2


@pytest.mark.parametrize("factor", [1e-9, 2.0])
def test_adjoints_are_limited_for_each_fit_that_shares_launches(factor, monkeypatch):
    monkeypatch.setattr(fit_module, "ADJOINT_LIMIT", factor)
    base = small.fit_problem()
    problems = [replace(base, fit=replace(base.fit, horizon=0, learning_rate=rate)) for rate in (1e-2, 5e-2)]
    for got, problem in zip(together(problems), problems, strict=True):
        wanted = fit(problem)
        small.assert_same_fit(got, wanted)
        assert got.facts["frames_left_out"] == wanted.facts["frames_left_out"] > 0


def test_fits_in_step_share_their_launches(monkeypatch):
    """Three equal scenes simulate as many frames as one; no frame is simulated twice."""
    frames: list[int] = []
    original = FrameSolver.forward
    monkeypatch.setattr(FrameSolver, "forward", lambda self, *a: frames.append(len(a[0])) or original(self, *a))
    problem = small.fit_problem()
    fit(problem)
    alone = len(frames)
    frames.clear()
    results = fit_many([FitTask(replace(problem, fit=replace(problem.fit, learning_rate=rate))) for rate in (1e-2, 2e-2, 5e-2)])
    assert not any(isinstance(result, Exception) for result in results)
    assert (len(frames), frames[0]) == (alone, 3)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("collide", [False, True])
def test_a_frame_and_its_gradients_by_a_thread_per_node(device, collide):
    """The way of a GPU; there an atomic sum of contacts may round in another order."""
    twins = [candidate(problem, small.start_values()) for problem in problems(collide)[:2]]
    union = Union([twin.topology for twin in twins])
    parameters = [packed(twin, device) for twin in twins]
    nodes, hands = ([torch.tensor(getattr(t.topology, name), device=device) for t in twins] for name in ("nodes", "controllers"))
    together = solver_of(union, [twin.simulation for twin in twins], device=device, threads=True)
    start, still = union.of_nodes(nodes, places=True), union.of_nodes([0 * x for x in nodes])
    begin, end = union.of_controllers(hands), union.of_controllers([places + 0.01 for places in hands])
    state = together.run(begin, end, start, still, union.parameters(parameters))
    adjoints = together.backward(state[0] - start, state[1])
    for k, twin in enumerate(twins):
        single = Union([twin.topology])
        alone = solver_of(single, [twin.simulation], device=device, threads=True)
        own = alone.run(
            hands[k][None], hands[k][None] + 0.01, nodes[k][None], 0 * nodes[k][None], single.parameters([parameters[k]])
        )
        *wanted, gradients = alone.backward(own[0] - nodes[k], own[1])
        got = [values[k : k + 1, : len(nodes[k])] for values in (*state, *adjoints[:2])]
        got += union.gradients(adjoints[2], k).values()
        for one, other in zip(got, [*own, *wanted, *single.gradients(gradients, 0).values()], strict=True):
            close = {"rtol": 0, "atol": 0} if device == "cpu" else {"rtol": 1e-4, "atol": 1e-6}
            torch.testing.assert_close(one, other, **close)


@pytest.mark.parametrize("device", [pytest.param("cuda:0", marks=CUDA)])
def test_searches_and_fits_share_launches_on_a_gpu(device):
    """The first generation of each search judges what it does alone."""
    given = problems(device=device)
    together = search_many([SearchRun(one, 0) for one in given])
    for got, problem in zip(together, given, strict=True):
        first = got.trace["generation"] == 0
        wanted = search(problem, seed=0).trace
        errors = (got.trace["cost"][first] / wanted["cost"][first] - 1).abs()
        assert (errors.median() <= COST_MEDIAN) and (errors.max() <= COST_LARGEST)
    trained = fits(device)
    ended = fit_many([FitTask(one) for one in trained])
    for got, problem in zip(ended, trained, strict=True):
        np.testing.assert_allclose(got.history["loss"], fit(problem).history["loss"], rtol=LOSS)
