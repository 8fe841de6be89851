"""Searches and fits of several scenes that share launches: the numbers of each are those that it has alone, bit for bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from neuspring import config
from neuspring.config.simulation import SimulationSettings
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.physics.parameters import packed
from neuspring.physics.solver import solver_of
from neuspring.physics.union import Union
from neuspring.twin import batch
from neuspring.twin.batch import run_batch, run_searches
from neuspring.twin.candidates import SearchProblem, candidate
from neuspring.twin.fit import FitProblem, fit
from neuspring.twin.search import search
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


@pytest.mark.parametrize("collide", [False, True])
def test_searches_of_several_scenes_end_as_each_alone(collide: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    given, sizes = problems(collide), []
    assert len({len(one.observations.nodes) for one in given}) == 2
    alone = [search(problem, seed=k).trace for k, problem in enumerate(given)]
    original = batch.rolled

    def counted(each, device):
        sizes.append(len(each))
        return original(each, device)

    monkeypatch.setattr(batch, "rolled", counted)
    works = [lambda lane, k=k, problem=problem: search(problem, seed=k, lane=lane) for k, problem in enumerate(given)]
    together = run_searches("cpu", works)
    for got, wanted in zip(together, alone, strict=True):
        pd.testing.assert_frame_equal(got.trace.drop(columns="seconds"), wanted.drop(columns="seconds"), check_exact=True)
    assert max(sizes) == 3


def test_a_search_that_fails_holds_nobody_up() -> None:
    good, other, _ = problems()
    bad = replace(other, simulation=SimulationSettings(substeps=1))
    together = run_searches("cpu", [lambda lane, one=one: search(one, seed=0, lane=lane) for one in (good, bad)])
    pd.testing.assert_series_equal(together[0].trace["cost"], search(good, seed=0).trace["cost"], check_exact=True)
    assert isinstance(together[1], InputError | NumericalFailure)


def fits(device: str = "cpu") -> list[FitProblem]:
    """The rope, the sheet, and the rope, in step and out of step."""
    settings = config.Fit(epochs=2, learning_rate=5e-3)
    started = [(problem, candidate(problem, small.start_values())) for problem in problems()]
    base = small.fit_problem(fit=settings, device=device)
    return [replace(base, observations=problem.observations, twin=twin) for problem, twin in started]


def test_fits_of_several_scenes_end_as_each_alone() -> None:
    given = fits()
    together = run_batch([one.twin for one in given], "cpu", [lambda lane, one=one: fit(one, lane=lane) for one in given])
    for got, problem in zip(together, given, strict=True):
        small.assert_same_fit(got, fit(problem))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("collide", [False, True])
def test_a_frame_and_its_gradients_by_a_thread_per_node(device: str, collide: bool) -> None:
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
def test_searches_and_fits_share_launches_on_a_gpu(device: str) -> None:
    """The first generation of each search judges what it does alone."""
    given = problems(device=device)
    together = run_searches(device, [lambda lane, one=one: search(one, seed=0, lane=lane) for one in given])
    for got, problem in zip(together, given, strict=True):
        first = got.trace["generation"] == 0
        wanted = search(problem, seed=0).trace
        errors = (got.trace["cost"][first] / wanted["cost"][first] - 1).abs()
        assert (errors.median() <= COST_MEDIAN) and (errors.max() <= COST_LARGEST)
    trained = fits(device)
    ended = run_batch([one.twin for one in trained], device, [lambda lane, one=one: fit(one, lane=lane) for one in trained])
    for got, problem in zip(ended, trained, strict=True):
        np.testing.assert_allclose(got.history["loss"], fit(problem).history["loss"], rtol=LOSS)
