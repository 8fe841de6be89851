"""Fits in a batch: the same numbers, bit for bit, as each alone, whatever the others do."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest
import torch

from neuspring import config
from neuspring.core.errors import NumericalFailure
from neuspring.physics.parameters import packed
from neuspring.physics.solver import FrameSolver, solver_for
from neuspring.twin.batch import Lane, run_batch
from neuspring.twin.fit import FitProblem, FitResult, fit
from tests.support import small

FIELD = config.SpringFieldSettings(channels=4, hidden=16, bands=2)


def several() -> list[FitProblem]:
    """Springs and fields, topologies and substeps of their own, in step and out of step."""
    values = small.start_values()
    base = small.fit_problem()
    coarse = small.fit_problem(values=values | {"object_neighbors": 7.0, "stiffness": 2e4})
    return [
        base,
        replace(base, fit=replace(base.fit, learning_rate=2e-2)),
        replace(coarse, kind="field", seed=3, fit=replace(base.fit, field=FIELD, learning_rate=5e-3)),
        replace(base, fit=replace(base.fit, horizon=3, epochs=4)),
        replace(coarse, fit=replace(base.fit, horizon=0, selection="tail", epochs=2)),
    ]


def in_a_batch(problems: list[FitProblem], **more) -> list[FitResult | Exception]:
    works = [lambda lane, problem=problem: fit(problem, lane=lane, **more) for problem in problems]
    return run_batch([problem.twin for problem in problems], "cpu", works)


def test_fits_in_a_batch_equal_those_alone() -> None:
    problems = several()
    for got, problem in zip(in_a_batch(problems), problems, strict=True):
        small.assert_same_fit(got, fit(problem))


def test_fits_in_step_share_their_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three alike make as many frames as one, and each keeps what it computed: no frame is simulated again."""
    frames = []
    original = FrameSolver.forward
    monkeypatch.setattr(FrameSolver, "forward", lambda self, *a: frames.append(len(a[0])) or original(self, *a))
    fit(small.fit_problem())
    alone = len(frames)
    frames.clear()
    in_a_batch([small.fit_problem(fit=replace(small.fit_problem().fit, learning_rate=rate)) for rate in (1e-2, 2e-2, 5e-2)])
    assert (len(frames), frames[0]) == (alone, 3)


def test_one_that_fails_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    problems = several()[:3]
    broken = replace(problems[1], twin=replace(problems[1].twin, simulation=replace(problems[1].twin.simulation, substeps=1)))
    broken = replace(broken, simulation=replace(broken.simulation, substeps=1))
    results = in_a_batch([problems[0], broken, problems[2]])
    assert isinstance(results[1], NumericalFailure)
    for k in (0, 2):
        small.assert_same_fit(results[k], fit(problems[k]))


def test_an_error_in_the_shared_launch_reaches_everyone(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no memory")

    monkeypatch.setattr(FrameSolver, "forward", fail)
    results = in_a_batch(several()[:3])
    assert [str(result) for result in results] == ["no memory"] * 3


def test_self_collision_in_a_batch() -> None:
    base = small.fit_problem()
    seen = base.observations
    crowded = replace(seen, scenario=replace(seen.scenario, self_collision=True))
    problems = [small.fit_problem(crowded, fit=replace(base.fit, learning_rate=rate)) for rate in (1e-2, 5e-2)]
    for got, problem in zip(in_a_batch(problems), problems, strict=True):
        small.assert_same_fit(got, fit(problem))
        assert torch.is_grad_enabled()


def test_an_adjoint_that_is_asked_for_survives_a_new_solver() -> None:
    """While one fit waits for the adjoint of its frame, the other takes more substeps, or ends: the frame must still be there."""
    twin = small.fit_problem().twin
    finer = replace(twin, simulation=replace(twin.simulation, substeps=2 * twin.simulation.substeps))
    hands = torch.tensor(small.observations().controller_points[:2])
    x = torch.tensor(twin.topology.nodes)
    inputs = (hands[0], hands[1], x, torch.zeros_like(x), packed(twin))
    alone = solver_for(twin)
    wanted = (alone.run(*inputs), alone.backward(x, x))

    def asks(lane: Lane) -> object:
        state = lane.run(*inputs)
        return state, lane.backward(x, x)

    for ends in (False, True):

        def disturbs(lane: Lane, ends: bool = ends) -> None:
            lane.run(*inputs)
            other = lane.batch.lanes[0]
            while other.waiting is None or other.waiting[0] != "backward":
                time.sleep(0.001)
            if not ends:
                lane.of_twin(finer).run(*inputs[:4], packed(finer))

        (state, adjoints), nothing = run_batch([twin, twin], "cpu", [asks, disturbs])  # type: ignore[list-item, misc]
        assert nothing is None
        for got, expected in zip((*state, *adjoints[:2]), (*wanted[0], *wanted[1][:2]), strict=True):
            assert torch.equal(got, expected)
        assert adjoints[2].keys() == wanted[1][2].keys()
        assert all(torch.equal(got, wanted[1][2][name]) for name, got in adjoints[2].items())


def test_an_interrupt_ends_all_at_once() -> None:
    problem = small.fit_problem(fit=config.Fit(epochs=10_000))
    epochs = []

    def stops(history: object) -> None:
        raise KeyboardInterrupt

    works = [
        lambda lane: fit(problem, lane=lane, on_epoch=stops),
        lambda lane: fit(problem, lane=lane, on_epoch=lambda history: epochs.append(len(history))),
    ]
    with pytest.raises(KeyboardInterrupt):
        run_batch([problem.twin] * 2, "cpu", works)
    assert len(epochs) < 100
