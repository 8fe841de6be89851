"""The zero-order stage: coding of variables, budget, failure handling, and exact continuation."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuspring import config
from neuspring import search as module
from neuspring.errors import InputError, NumericalFailure
from neuspring.losses import FrameLoss
from neuspring.search import PENALTY, VARIABLES, candidate, cost, decode, encode, search
from tests import small

RELEASED_START = (0.3, 0.25, 0.5, 3 / 7, 4 / 7, 0.5, 0.15, 0.7, 0.15, 0.25, 0.15, 0.5)


def test_the_released_start_is_encoded_in_the_released_order():
    np.testing.assert_allclose(encode(config.SearchStart(), config.SearchRanges()), RELEASED_START, rtol=1e-12)


@given(st.lists(st.floats(0, 1), min_size=len(VARIABLES), max_size=len(VARIABLES)))
def test_decoded_values_lie_in_their_ranges_and_counts_are_whole(normalised):
    ranges = config.SearchRanges()
    for name, value in decode(np.array(normalised), ranges).items():
        low, high = getattr(ranges, name)
        assert low <= value <= high * (1 + 1e-12)
        assert name not in module.INTEGERS or value == int(value)


def test_the_truth_costs_less_than_its_neighbours():
    problem = small.search_problem()
    loss = FrameLoss.of(problem.observations, problem.losses, "cpu")
    values = small.start_values() | {"object_radius": 0.05, "controller_radius": 0.03, "controller_neighbours": 12.0}
    values |= {"ground_elasticity": 0.2, "ground_friction": 0.5, "stiffness": 1.2e4}
    by_stiffness = [cost(problem, candidate(problem, values | {"stiffness": s}), loss)[0] for s in (2e3, 1.2e4, 9e4)]
    assert by_stiffness[1] == min(by_stiffness)


def test_the_best_evaluated_candidate_wins_within_the_budget():
    problem = small.search_problem()
    result = search(problem, seed=0)
    assert len(result.trace) == 22
    assert result.cost == result.trace["cost"].min()
    # The returned twin is that candidate: simulating it again gives its cost.
    loss = FrameLoss.of(problem.observations, problem.losses, "cpu")
    assert cost(problem, result.twin, loss) == (result.cost, 0)


def test_seeds_decide_the_candidates():
    columns = [f"normalised.{name}" for name in VARIABLES]
    runs = [search(small.search_problem(), seed).trace[columns].to_numpy() for seed in (0, 0, 1)]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_a_killed_search_continues_exactly(tmp_path, monkeypatch):
    partial = tmp_path / "partial.parquet"
    whole = search(small.search_problem(), seed=5)
    calls = 0
    evaluate = module._evaluate

    def dying(*arguments):
        nonlocal calls
        calls += 1
        if calls == 15:  # in the middle of the second generation
            raise KeyboardInterrupt
        return evaluate(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(module, "_evaluate", dying)
        with pytest.raises(KeyboardInterrupt):
            search(small.search_problem(), seed=5, partial=partial, key="k")
    assert len(pd.read_parquet(partial)) == 11
    continued = search(small.search_problem(), seed=5, partial=partial, key="k")
    assert (whole.attempts, continued.attempts) == (1, 2)
    assert continued.earlier_seconds > 0
    exact = [name for name in whole.trace if name != "seconds"]
    pd.testing.assert_frame_equal(continued.trace[exact], whole.trace[exact], check_exact=True)


def test_a_checkpoint_of_another_problem_or_that_does_not_replay_is_ignored(tmp_path, capsys):
    partial = tmp_path / "partial.parquet"
    first = search(small.search_problem(), seed=0, partial=partial, key="one")
    other = search(small.search_problem(), seed=0, partial=partial, key="two")
    assert "other inputs or settings" in capsys.readouterr().out
    assert (other.attempts, other.cost) == (1, first.cost)
    table = pd.read_parquet(partial)
    table.loc[0, "normalised.drag"] += 0.01
    table.to_parquet(partial)
    forged = search(small.search_problem(), seed=0, partial=partial, key="two")
    assert "does not replay" in capsys.readouterr().out
    assert (forged.attempts, forged.cost) == (1, first.cost)


def test_a_fixed_count_that_no_candidate_can_use_is_an_error_with_the_remedy():
    problem = small.search_problem(simulation=config.Simulation(substeps=1))
    with pytest.raises(
        InputError, match=r"simulation.substeps: at least one of 22 candidates must be stable.*; received 1"
    ) as caught:
        search(problem, seed=0)
    assert re.search(r"unstable: simulation.substeps, node \d+: .*stability bound.* Use at least \d+ substeps", str(caught.value))


def test_a_search_whose_candidates_all_fail_is_a_named_failure():
    problem = small.search_problem(simulation=config.Simulation(max_substeps=1))
    with pytest.raises(
        NumericalFailure, match=r"none of 22 candidates could be simulated; the first: needs \d+ substeps per frame"
    ):
        search(problem, seed=0)


def test_bad_input_is_not_mistaken_for_a_bad_candidate():
    seen = small.observations()
    hands = seen.controller_points.copy()
    hands[:, 0] += seen.object_points[0, 0] - hands[0, 0]
    with pytest.raises(InputError, match="controller may not coincide"):
        search(small.search_problem(replace(seen, controller_points=hands)), seed=0)


def test_the_future_is_never_read():
    first, second = (search(small.search_problem(o), seed=0) for o in (small.observations(), small.spoiled_future()))
    assert first.trace["cost"].tolist() == second.trace["cost"].tolist()


def test_a_search_started_on_a_damaged_checkpoint_starts_afresh(tmp_path, capsys):
    partial = tmp_path / "partial.parquet"
    partial.write_bytes(b"PAR1 not really")
    assert search(small.search_problem(), seed=0, partial=partial, key="k").attempts == 1
    assert "starts afresh" in capsys.readouterr().out


def test_released_quirks_of_the_search():
    quirks = config.ReleasedQuirks(integer_damping=True, frame_time_667=True)
    values = small.start_values() | {"drag": 17.7, "dashpot": 20.9}
    twin = candidate(small.search_problem(quirks=quirks), values)
    assert twin.simulation.substeps == 667
    assert twin.simulation.frame_time == pytest.approx(0.03335)
    # The truncation belongs to what leaves the search; candidates themselves use floats.
    assert twin.material.drag == 17.7
    result = search(small.search_problem(quirks=config.ReleasedQuirks(integer_damping=True)), seed=0)
    assert result.twin.material.drag == int(result.twin.material.drag)
    assert result.twin.material.dashpot[0] == int(result.twin.material.dashpot[0])
    assert result.trace["drag"].mod(1).ne(0).any()


def test_an_unstable_candidate_is_penalised_not_fatal():
    needed = search(small.search_problem(simulation=config.Simulation(safety=1.0)), seed=0).trace["substeps"]
    # Enough substeps for the softer half of the first candidates only.
    problem = small.search_problem(simulation=config.Simulation(substeps=int(needed.median())))
    result = search(problem, seed=0)
    penalised = result.trace[result.trace["cost"] == PENALTY]
    assert 0 < len(penalised) < len(result.trace)
    assert penalised["reason"].str.startswith("unstable").all()
