"""Levenberg-Marquardt after CMA-ES: residuals, steps, and what it makes of a toy twin."""

from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest
import torch

from neuspring import config
from neuspring.config.search import TRIALS
from neuspring.core.errors import NumericalFailure
from neuspring.core.levenberg import damped_step
from neuspring.twin import search as module
from neuspring.twin.candidates import CMAES, SearchProblem, candidate, evaluate
from neuspring.twin.losses import FrameLoss
from neuspring.twin.polish import LONGEST_STEP, POLISH, SLOPES, Polish, products, residuals, slope_rows
from neuspring.twin.search import search
from neuspring.twin.trials import motions
from tests.support import small
from tests.support.searches import LOGARITHMIC, assert_same_trace

ROUND = 1 + 3 + TRIALS
FLOAT32 = 1e-5
"""Relative, of costs whose terms are computed in float32."""


@pytest.fixture(autouse=True)
def any_share(monkeypatch):
    """The polish may take nearly the whole budget, which is small here."""
    monkeypatch.setattr("neuspring.config.search.POLISH_SHARE", 0.9)


def polished(rollouts: int = 50, *, start: dict | None = None, rounds: int = 6, seen=None, **changes) -> SearchProblem:
    """A search on logarithmic scales with a polish."""
    settings = LOGARITHMIC | {"polish": rounds}
    own = {"object_radius": 0.045, "stiffness": 6e3} | (start or {})
    return small.search_problem(seen, search=small.released(rollouts=rollouts, start=own, **settings), **changes)


def rollouts_of(problem: SearchProblem, twins: list) -> tuple[torch.Tensor, torch.Tensor, FrameLoss, torch.Tensor]:
    loss = FrameLoss.of(problem.observations, problem.losses, "cpu", frozen_counts=problem.quirks.frozen_loss_denominators)
    own = problem.recordings[0]
    return *motions(twins, own.hands, own.velocity, "cpu"), loss, own.velocity


def squares(loss: FrameLoss, start: torch.Tensor, x: torch.Tensor, v: torch.Tensor) -> float:
    """|r|^2 of a rollout."""
    loss, x = loss.to("cpu", torch.float64), x.double()
    near = [loss.assigned(frame, nodes) for frame, nodes in enumerate(x, start=1)]
    r = residuals(loss, start.double(), x, v.double(), near)
    return float(r @ r)


# Residuals ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("quirks", [config.ReleasedQuirks(), config.ReleasedQuirks(frozen_loss_denominators=True)])
@pytest.mark.parametrize("weights", [config.Losses(), config.Losses(chamfer=0.3, track=2.0, acceleration=0.5)])
def test_the_sum_of_squares_is_the_cost(quirks, weights):
    seen = small.scene(noise=0.004, occlusion=0.3).observations
    problem = small.search_problem(seen, quirks=quirks, losses=weights)
    twins = [candidate(problem, small.start_values() | {"stiffness": s}) for s in (8e2, 6e3)]
    x, v, loss, start = rollouts_of(problem, twins)
    for k, outcome in enumerate(small.judge(problem, twins, loss)):
        assert squares(loss, start, x[:, k], v[:, k]) == pytest.approx(outcome.cost, rel=FLOAT32)


def test_slopes_are_those_of_the_cost():
    """2 J'r against central differences of the cost, without the acceleration term, which bends most."""
    problem = polished(losses=config.Losses(acceleration=0.0))
    base = problem.encode()
    columns = [problem.variables.index(name) for name in problem.search.polished]

    def twins(step: float) -> list:
        moved = [base + step * np.eye(len(base))[column] for column in columns]
        made = [candidate(problem, problem.decode(u)) for u in (base, *moved)]
        return [replace(twin, simulation=replace(twin.simulation, substeps=60)) for twin in made]

    step = 0.01
    x, v, loss, start = rollouts_of(problem, twins(step))
    _, matrix, gradient = products(loss, start, x, v, [True] * 4, np.full(3, step))
    up, down = ([o.cost for o in small.judge(problem, twins(s), loss)[1:]] for s in (step, -step))
    central = (np.array(up) - np.array(down)) / (2 * step)
    # One-sided differences of residuals: off by half a step times the second derivative.
    np.testing.assert_allclose(2 * gradient, central, rtol=0.1, atol=0.02 * np.abs(central).max())
    np.testing.assert_allclose(matrix, matrix.T)
    assert (np.linalg.eigvalsh(matrix) > -1e-12 * np.trace(matrix)).all()


def test_a_rollout_that_left_has_no_slope():
    problem = polished()
    x, v, loss, start = rollouts_of(problem, [candidate(problem, problem.decode(problem.encode()))] * 3)
    x[:, 2] = float("nan")
    costs, matrix, gradient = products(loss, start, x, v, [True, True, False], np.full(2, 0.01))
    assert np.isinf(costs[2])
    assert np.isfinite(costs[:2]).all()
    assert not matrix[1].any()
    assert gradient[1] == 0
    assert not products(loss, start, x, v, [False, True, True], np.full(2, 0.01))[2].any()
    # Residuals that are no numbers of a rollout that seems fine.
    again = products(loss, start, x, v, [True, True, True], np.full(2, 0.01))
    assert all(np.array_equal(one, other) for one, other in zip(again, (costs, matrix, gradient), strict=True))
    assert np.isinf(products(loss, start, x[:, [2, 0, 1]], v, [True, True, True], np.full(2, 0.01))[0]).all()


# Steps ----------------------------------------------------------------------------------------------------------------


def test_without_damping_and_bounds_a_step_solves_a_linear_problem():
    rng = np.random.default_rng(0)
    jacobian, residual = rng.normal(size=(9, 3)), rng.normal(size=9)
    far = np.full(3, 1e9)
    step = damped_step(jacobian.T @ jacobian, jacobian.T @ residual, 0.0, -far, far)
    np.testing.assert_allclose(step, np.linalg.lstsq(jacobian, -residual)[0], rtol=1e-9)
    damped = damped_step(jacobian.T @ jacobian, jacobian.T @ residual, 10.0, -far, far)
    assert np.linalg.norm(damped) < np.linalg.norm(step)


def test_steps_stay_in_their_box_and_the_rest_is_solved_again():
    products, gradient = np.array([[2.0, 1.0], [1.0, 3.0]]), np.array([-10.0, -1.0])
    step = damped_step(products, gradient, 0.0, np.full(2, -0.5), np.full(2, 0.5))
    assert step[0] == 0.5
    assert step[1] == pytest.approx((1 - 1.0 * 0.5) / 3)


def test_a_variable_without_effect_stays():
    step = damped_step(np.diag([4.0, 0.0]), np.array([-1.0, 0.0]), 0.1, -np.ones(2), np.ones(2))
    assert step[1] == 0
    assert step[0] > 0


def test_the_polish_of_a_quadratic_ends_at_its_least_within_the_box():
    """Without a simulation: residuals A (u - best)."""
    settings = polished().search
    matrix, best = np.array([[3.0, 1, 0], [0, 2, 1], [1, 0, 1]]), np.array([0.9, 0.4, 1.2])

    def cost(u: np.ndarray) -> float:
        return float(np.sum((matrix @ (u[1:] - best)) ** 2))

    start = np.array([0.3, 0.2, 0.1, 0.9])
    polish, costs = Polish(settings, [1, 2, 3], start, cost(start)), []
    while not polish.done:
        asked, here = polish.ask(), polish.base
        assert all((u >= 0).all() and (u <= 1).all() and u[0] == 0.3 for u in asked)
        if polish.stage == SLOPES:
            rows = [{"product.residual": 0.0, "product.a": 0.0, "product.b": 0.0, "product.c": 0.0}]
            products = matrix.T @ matrix
            gradient = products @ (here[1:] - best)
            rows += [{"product.residual": g, **dict(zip("abc", p, strict=True))} for g, p in zip(gradient, products, strict=True)]
            rows = [{k if k.startswith("product") else f"product.{k}": x for k, x in row.items()} for row in rows]
        else:
            rows = [{"cost": cost(u)} for u in asked]
            assert all(np.abs(u - here).max() <= LONGEST_STEP + 1e-12 for u in asked)
        polish.tell(rows)
        costs.append(polish.cost)
    assert costs == sorted(costs, reverse=True)
    # The third is held at its bound; the others are the least there.
    expected = best[:2] + np.linalg.lstsq(matrix[:, :2], -matrix[:, 2] * (1.0 - best[2]))[0]
    np.testing.assert_allclose(polish.base[1:], [*expected, 1.0], atol=2e-2)


# The search with its polish -------------------------------------------------------------------------------------------


def test_stiffness_and_drag_of_a_toy_twin_are_recovered():
    """The target is made by a candidate of the search itself, so its variables are the truth."""
    seen = small.scene(frames=16).observations
    problem = polished(2 + 6 * ROUND, start={"stiffness": 3e3, "dashpot": 8.0, "drag": 1.0})
    problem = replace(problem, observations=seen, losses=config.Losses(chamfer=0.0, acceleration=0.0))
    truth = problem.decode(problem.encode()) | {"stiffness": 5e3, "dashpot": 20.0, "drag": 2.0}
    twin = candidate(problem, truth)
    hands, start = torch.tensor(seen.controller_points), torch.zeros((len(twin.topology.nodes), 3))
    x, _ = motions([twin], hands, start, "cpu")
    points = seen.object_points.copy()
    points[1:] = x[:, 0, : points.shape[1]]
    problem = replace(problem, observations=replace(seen, object_points=points))
    # The polish alone, from the start of the search.
    judge, slopes = partial(evaluate, problem), partial(slope_rows, problem)
    rows = judge([problem.encode()], False, 0, 0)
    ends = list(module._polished(problem.search, problem.variables, rows, [], 0, judge, slopes, False))[-1]
    best = min([row for row in ends if row["stage"] == POLISH], key=lambda row: row["cost"])
    assert best["cost"] < 1e-3 * rows[0]["cost"]
    # The dashpots, which move this rope by less than rounding, end 40 % off.
    for name, accuracy in (("stiffness", 0.01), ("drag", 0.03)):
        assert best[name] == pytest.approx(truth[name], rel=accuracy)


def test_a_polish_never_raises_the_cost_and_keeps_the_topology():
    problem = polished(22 + 3 * ROUND, rounds=3)
    result = search(problem, seed=0)
    trace = result.trace
    plain = search(replace(problem, search=replace(problem.search, rollouts=22, polish=0)), seed=0)
    assert_same_trace(trace[:22].drop(columns=[c for c in trace if c.startswith("product.")]), plain.trace)
    assert result.cost < plain.cost
    assert set(trace["stage"][22:]) == {SLOPES, POLISH}
    assert len(trace) <= 22 + 3 * ROUND
    # The result is a candidate that was judged as all are.
    assert result.cost == trace["cost"][trace["stage"] != SLOPES].min()
    loss = FrameLoss.of(problem.observations, problem.losses, "cpu")
    assert small.judge(problem, [result.twin], loss)[0].cost == result.cost
    moved = {name for name in problem.names if result.values[name] != plain.values[name]}
    assert moved <= {"stiffness", "dashpot", "drag"}
    for name in moved:
        one = getattr(problem.search.variables, name)
        assert one.low * (1 - 1e-12) <= result.values[name] <= one.high * (1 + 1e-12)


@pytest.mark.parametrize(("rollouts", "rounds"), [(11, 0), (31, 0), (32, 1), (88, 2), (220, 6), (2000, 6)])
def test_the_polish_is_part_of_the_budget(monkeypatch, rollouts, rounds):
    monkeypatch.undo()
    settings = config.Search(rollouts=rollouts)
    assert settings.polish_rounds == rounds
    assert settings.cma_rollouts == rollouts - rounds * ROUND
    assert config.Search(rollouts=rollouts, polish=0).cma_rollouts == rollouts


def test_the_polish_is_the_same_however_candidates_are_simulated():
    apart, plain = (search(polished(30, rounds=2, **how), seed=1) for how in ({"together": 1, "threads": 2}, {}))
    assert_same_trace(apart.trace, plain.trace)


@pytest.mark.parametrize("generations", [1, 2])
def test_a_killed_polish_is_replayed(tmp_path, monkeypatch, generations):
    """Killed after some of its generations: slopes, or steps."""
    record, problem = tmp_path / "trace.parquet", polished(35, rounds=3)
    whole, count = search(problem, seed=2), 0
    save = module.save_trace

    def dying(*arguments):
        nonlocal count
        save(*arguments)
        count += any(row["stage"] != CMAES for row in arguments[2])
        if count == generations:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module, "save_trace", dying)
        with pytest.raises(KeyboardInterrupt):
            search(problem, seed=2, record=record, key="k")
    kept = len(pd.read_parquet(record))
    assert problem.search.cma_rollouts < kept < len(whole.trace)
    continued = search(problem, seed=2, record=record, key="k")
    assert continued.attempts == 2
    assert_same_trace(continued.trace, whole.trace)
    # Nothing is simulated any more.
    with monkeypatch.context() as patch:
        for name in ("evaluate", "slope_rows"):
            patch.setattr(module, name, lambda *_: pytest.fail("everything is recorded"))
        assert_same_trace(search(problem, seed=2, record=record, key="k").trace, whole.trace)


def test_a_larger_budget_begins_its_polish_anew(tmp_path):
    record = tmp_path / "trace.parquet"
    less, more = (polished(rollouts, rounds=1) for rollouts in (19, 30))
    search(less, seed=0, record=record, key="k")
    assert_same_trace(search(more, seed=0, record=record, key="k").trace, search(more, seed=0).trace)
    assert_same_trace(search(less, seed=0, record=record, key="k").trace, search(less, seed=0).trace)


def test_nothing_is_polished_where_no_candidate_could_be_simulated():
    with pytest.raises(NumericalFailure, match="none of 22 candidates"):
        search(polished(30, rounds=1, simulation=config.SimulationSettings(safety=1e-6)), seed=0)
