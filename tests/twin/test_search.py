"""The zero-order stage: coding of variables, budget, failure handling, and exact continuation."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cma
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from neuspring import config
from neuspring.config.search import LENGTHS
from neuspring.physics import stability
from neuspring.physics.lanes import LANE_WIDTH
from neuspring.physics.topology import uniform_topology
from neuspring.twin import candidates
from neuspring.twin import search as module
from neuspring.twin.candidates import PENALTY, SearchProblem, candidate, groups, made, still_cost
from neuspring.twin.losses import FrameLoss
from neuspring.twin.search import FREED_SIGMA, search
from neuspring.twin.trials import Outcome
from tests.support import scenarios, small
from tests.support.searches import assert_same_trace, budget

RELEASED = {
    "stiffness": (0.0, 1e5, 0.3),
    "object_radius": (0.01, 0.05, 0.25),
    "object_neighbors": (10, 50, 0.5),
    "controller_radius": (0.01, 0.08, 3 / 7),
    "controller_neighbors": (10, 80, 4 / 7),
    "ground_elasticity": (0.0, 1.0, 0.5),
    "ground_friction": (0.0, 2.0, 0.15),
    "contact_elasticity": (0.0, 1.0, 0.7),
    "contact_friction": (0.0, 2.0, 0.15),
    "contact_distance": (0.01, 0.05, 0.25),
    "drag": (0.0, 20.0, 0.15),
    "dashpot": (0.0, 200.0, 0.5),
}
"""The released variables in the released order: their ranges, and the released start on the normalized scale."""
ROUND_TRIP = 1e-9
"""Absolute, of normalized variables: rounding of float64, over ranges of a part of their bounds."""
START_ROUNDING = 1e-12
"""Absolute: the start's decimal fractions are rounded once more than its encoded values."""
CODING = 1e-12
"""Relative: to the normalized scale and back, rounding of float64 only."""
FLOAT32_LENGTHS = 1e-6
"""Relative: the rest shape is kept in float32; lengths of 0.02 m between points at 0.2 m round to parts in 1e6."""


def plain(**changes: object) -> SearchProblem:
    """A search with the released settings, for its coding."""
    clusters = {"clusters": changes.pop("clusters")} if "clusters" in changes else {}
    return small.search_problem(search=small.released(**changes), **clusters)


# Variables ------------------------------------------------------------------------------------------------------------


def test_one_region_has_the_twelve_variables_of_the_released_search_and_its_start():
    problem = plain()
    assert problem.variables == tuple(RELEASED)
    np.testing.assert_allclose(problem.encode(), [start for *_, start in RELEASED.values()], rtol=CODING)
    assert not problem.labels.any()


@given(st.lists(st.floats(0, 1), min_size=16, max_size=16), st.sampled_from(["linear", "log"]))
def test_decoded_values_lie_in_their_ranges_and_counts_are_whole(normalized, scale):
    for clusters in (1, 3):
        problem = plain(clusters=clusters, ranges={"stiffness": [1.0, 1e5]}, scales={"stiffness": scale})
        for name, value in problem.decode(np.array(normalized[: 2 * clusters + 10])).items():
            base = name.partition(".")[0]
            variable = getattr(problem.search.variables, base)
            assert variable.low * (1 - CODING) <= value <= variable.high * (1 + CODING)
            assert base not in candidates.INTEGERS or value == int(value)


@given(st.lists(st.floats(0, 1), min_size=12, max_size=12), st.sampled_from(["spacing", "meter"]))
def test_what_is_decoded_comes_from_where_it_is_decoded_to(normalized, lengths):
    """Linear and logarithmic scales, both units: the start that has the decoded values is encoded to the same variables."""
    problem = ours() if lengths == "spacing" else plain(scales={"drag": "log"}, ranges={"drag": [0.1, 20.0]})
    values = problem.decode(np.array(normalized))
    if lengths == "spacing":
        values["controller_radius"] -= problem.reach
        values |= {name: values[name] / problem.spacing for name in LENGTHS}
    settings = {name: getattr(problem.search.variables, name) for name in values}
    inside = {name: replace(one, start=float(np.clip(values[name], one.low, one.high))) for name, one in settings.items()}
    back = replace(problem, search=replace(problem.search, variables=replace(problem.search.variables, **inside))).encode()
    for name, u, again in zip(problem.variables, normalized, back, strict=True):
        slack = 1 / (settings[name].high - settings[name].low) if name in candidates.INTEGERS else ROUND_TRIP
        assert again == pytest.approx(u, abs=slack)


def ours(**changes: object) -> SearchProblem:
    """A search with the program's defaults."""
    return small.search_problem(changes.pop("seen", None), search=config.parse(config.Search, changes, "test"))


def test_lengths_are_multiples_of_the_spacing_of_the_nodes():
    problem = ours()
    values, start = problem.decode(problem.encode()), problem.search.variables
    assert problem.spacing == pytest.approx(0.02, rel=0.1), "that of the toy rope"
    for name in ("object_radius", "contact_distance"):
        assert values[name] == pytest.approx(getattr(start, name).start * problem.spacing)
    # A controller's radius begins where there is a node.
    assert values["controller_radius"] == pytest.approx(start.controller_radius.start * problem.spacing + problem.reach)
    lowest = candidate(problem, problem.decode(np.zeros(12)))
    assert len(lowest.topology.springs) > lowest.topology.object_spring_count


def test_small_and_large_units_have_the_same_variables_and_springs():
    """Values in spacings scale with the object: by 1024, a power of two, so that no distance is rounded."""
    seen = small.observations()
    lengths = ("object_points", "controller_points", "surface_points", "interior_points", "tracks")
    large = replace(seen, **{name: 1024 * getattr(seen, name) for name in lengths})
    meters, units = ours(), ours(seen=large)
    np.testing.assert_array_equal(units.encode(), meters.encode())
    rng = np.random.default_rng(0)
    for normalized in rng.random((5, 12)):
        first, second = (problem.decode(normalized) for problem in (meters, units))
        for name, value in first.items():
            assert second[name] == pytest.approx(value * (1024 if name in LENGTHS else 1), rel=FLOAT32_LENGTHS)
        springs = [candidate(p, v).topology.springs for p, v in ((meters, first), (units, second))]
        np.testing.assert_array_equal(*springs)


@pytest.mark.parametrize("clusters", [1, 3])
def test_the_released_row_is_the_search_as_it_was(clusters):
    """Bit for bit: the linear formula on the released ranges, and CMA-ES from the released start, told the same costs."""
    trace = search(small.search_problem(search=small.released(rollouts=24), clusters=clusters), seed=3).trace
    names = [n for n in trace if n.removeprefix("normalized.") != n]
    start = [RELEASED[n.removeprefix("normalized.").partition(".")[0]][2] for n in names]
    for name in (n.removeprefix("normalized.") for n in names):
        low, high, _ = RELEASED[name.partition(".")[0]]
        value = low + trace[f"normalized.{name}"] * (high - low)
        whole = name.partition(".")[0] in candidates.INTEGERS
        np.testing.assert_array_equal(trace[name], value.astype(int) if whole else value)
    options = {"bounds": [0, 1], "seed": 4, "verbose": -9, "tolfun": 0, "tolx": 0}
    strategy = cma.CMAEvolutionStrategy(start, 1 / 6, options)
    while len(trace) >= strategy.popsize:
        asked, trace_now = strategy.ask(), trace[: strategy.popsize]
        np.testing.assert_allclose(trace_now[names], asked, atol=START_ROUNDING)
        strategy.tell(asked, trace_now["cost"].tolist())
        trace = trace[strategy.popsize :]


# Candidates -----------------------------------------------------------------------------------------------------------


def test_a_region_s_values_reach_its_own_nodes():
    values = small.start_values()
    regional = {"object_radius.0": 0.03, "object_radius.1": 0.045, "object_neighbors.0": 5.0, "object_neighbors.1": 18.0}
    problem = small.search_problem(clusters=2, search=small.released(isolated_nodes="allow"))
    topology = candidate(problem, values | regional).topology
    inner = topology.springs[: topology.object_spring_count]
    longest = [topology.rest_lengths[: len(inner)][(problem.labels[inner] == r).all(axis=1)].max() for r in (0, 1)]
    assert longest[0] < 0.03 < longest[1] < 0.045
    degree = np.bincount(inner.ravel(), minlength=len(problem.labels))
    assert degree[problem.labels == 0].mean() < degree[problem.labels == 1].mean() / 2


def loosely(**changes: object) -> SearchProblem:
    """A search whose radii may be so small that only nodes at the controllers have springs."""
    return small.search_problem(search=small.released(ranges={"object_radius": [0.001, 0.05]}, **changes))


def test_isolated_nodes_are_repaired_or_left():
    values = small.start_values() | {"object_radius": 0.005}
    count = len(small.observations().nodes)
    left = candidate(loosely(isolated_nodes="allow"), values)
    assert 0 < len(np.setdiff1d(np.arange(count), left.topology.springs)) < count
    assert left.topology.object_spring_count == 0
    seen = small.observations()
    released = uniform_topology(seen.nodes, seen.controller_points[0], 0.005, 18, values["controller_radius"], 50)
    np.testing.assert_array_equal(left.topology.springs, released.springs)
    mended = candidate(loosely(isolated_nodes="repair"), values)
    body = mended.topology.springs[: mended.topology.object_spring_count]
    assert connected_components(coo_array((np.ones(len(body)), body.T), shape=(count, count)), directed=False)[0] == 1
    # Nothing is isolated: both are the same.
    whole = [candidate(loosely(isolated_nodes=rule), small.start_values()) for rule in ("repair", "allow")]
    np.testing.assert_array_equal(whole[0].topology.springs, whole[1].topology.springs)


# The search -----------------------------------------------------------------------------------------------------------


def test_the_best_evaluated_candidate_wins_within_the_budget():
    problem = small.search_problem()
    result = search(problem, seed=0)
    assert len(result.trace) == 22
    assert result.cost == result.trace["cost"].min()
    # The returned twin is that candidate: simulating it again gives its cost.
    loss = FrameLoss.of(problem.observations, problem.losses, "cpu")
    assert small.judge(problem, [result.twin], loss) == [Outcome(result.cost, 0, 0)]


def die_after(evaluated: int, problem: SearchProblem, seed: int, record: Path, monkeypatch: pytest.MonkeyPatch):
    """Interrupt a search while it evaluates one more candidate."""
    calls = 0
    evaluate = candidates.made

    def dying(*arguments):
        nonlocal calls
        calls += 1
        if calls > evaluated:
            raise KeyboardInterrupt
        return evaluate(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(candidates, "made", dying)
        with pytest.raises(KeyboardInterrupt):
            search(problem, seed, record=record, key="k")


def test_a_larger_budget_continues_as_if_it_had_been_there_from_the_start(tmp_path):
    """15 rollouts end in the middle of the second generation of 11."""
    record = tmp_path / "trace.parquet"
    first = search(budget(15), seed=2, record=record, key="k")
    evaluated = search(budget(24), seed=2, record=record, key="k")
    whole = search(budget(24), seed=2)
    assert_same_trace(evaluated.trace, whole.trace)
    assert_same_trace(pd.read_parquet(record), whole.trace)
    assert (evaluated.cost, evaluated.values, evaluated.attempts) == (whole.cost, whole.values, 2)
    np.testing.assert_array_equal(evaluated.twin.topology.springs, whole.twin.topology.springs)
    # What was recorded was not computed again, and a smaller budget is a prefix.
    assert evaluated.trace["seconds"].tolist()[:15] == first.trace["seconds"].tolist()
    assert_same_trace(first.trace, whole.trace[:15])


def pushed(hands: str = "auto", rollouts: int = 26) -> SearchProblem:
    """A lump on the table that two points push along and leave where it is, and which then go back."""
    frames, corners = 8, np.array([[x, y, z] for x in (0.0, 0.03) for y in (0.0, 0.03) for z in (0.0, 0.03)])
    way = np.concatenate([np.linspace(0, 0.06, 5), [0.03, 0.0, -0.03]])
    lump = np.tile(corners, (frames, 1, 1))
    lump[:, :, 0] += np.maximum.accumulate(np.maximum(way - 0.01, 0.0))[:, None]
    points = np.array([[-0.03, 0.005, 0.015], [-0.03, 0.025, 0.015]]) + way[:, None, None] * [1.0, 0.0, 0.0]
    settings = config.Search(hands=hands, rollouts=rollouts, lengths="spacing")
    return small.search_problem(scenarios.seen(lump, points), search=settings)


def test_the_first_generation_says_whether_hands_hold_or_push():
    result = search(pushed(), seed=0)
    trace = result.trace
    assert trace["rollout"].tolist() == list(range(26))
    assert trace["stage"].tolist()[:22] == ["hands"] * 11 + ["cmaes"] * 11
    variables = [name for name in trace.columns if name.startswith("normalized.")]
    np.testing.assert_array_equal(trace.loc[:10, variables], trace.loc[11:21, variables])
    assert (trace["stage"] == "hands").to_numpy().tolist() == (~trace["push"]).tolist()
    assert trace["cost"][11:22].min() < trace["cost"][:11].min()
    # From the first touch on, and nothing pulls the lump back.
    topology = result.twin.topology
    led = np.arange(len(topology.springs)) >= topology.object_spring_count
    np.testing.assert_array_equal(topology.pushes, led)
    assert topology.rest_lengths[led].max() <= result.values["contact_distance"] + 1e-9
    assert search(pushed("hold"), seed=0).cost > 1.3 * result.cost


@pytest.mark.parametrize(("part", "pushes"), [(0.5, True), (0.98, False)])
def test_hands_that_push_must_move_the_object(part, pushes, monkeypatch):
    """First candidates that hold may be worse than an object that stays, and hands that push what is held leave it there."""
    problem = replace(pushed(rollouts=22), losses=config.Losses(chamfer=0.0, acceleration=0.0))
    still = still_cost(problem.recordings)
    way = problem.observations.object_points - problem.observations.object_points[0]
    # Half a square, and the mean over three axes.
    assert still == pytest.approx((way[1:] ** 2).sum(axis=2).mean() / 6, rel=1e-5)

    def evaluated(judged: SearchProblem, population: list[np.ndarray], push: bool, *_: Any) -> Any:
        yield from ()
        rows = [made(judged, normalized, push)[0] for normalized in population]
        return [row | {"cost": still * (part if push else 3.0)} for row in rows]

    monkeypatch.setattr("neuspring.twin.search.evaluate", evaluated)
    assert search(problem, seed=0).trace["push"].tolist() == [not pushes] * 11 + [pushes] * 11


def test_hands_that_hold_are_kept(tmp_path, monkeypatch):
    problem = small.search_problem()
    problem = replace(problem, search=replace(problem.search, hands="auto", rollouts=33))
    whole, record = search(problem, seed=1), tmp_path / "trace.parquet"
    assert not whole.twin.topology.pushes.any()
    assert whole.trace["push"].tolist() == [True] * 11 + [False] * 22
    die_after(27, problem, 1, record, monkeypatch)
    continued = search(problem, seed=1, record=record, key="k")
    assert_same_trace(continued.trace, whole.trace)
    assert continued.trace["seconds"].tolist()[:22] == pd.read_parquet(record)["seconds"].tolist()[:22]


def tied(rollouts: int, clusters: int = 3, tied_rollouts: int = 15) -> SearchProblem:
    """A search whose regions share their values in its first rollouts; 15 end in the middle of a generation of 11."""
    problem = small.search_problem(clusters=clusters)
    return replace(problem, search=replace(problem.search, rollouts=rollouts, tied_rollouts=tied_rollouts))


def test_tied_regions_are_the_uniform_search_and_are_then_freed_around_its_best():
    trace = search(tied(30), seed=0).trace
    uniform = search(budget(15), seed=0).trace
    assert len(trace) == 30
    np.testing.assert_array_equal(trace["cost"][:15], uniform["cost"])
    for name in RELEASED:
        regional = name in candidates.REGIONAL
        for column in [f"normalized.{name}.{region}" for region in range(3)] if regional else [f"normalized.{name}"]:
            np.testing.assert_array_equal(trace[column][:15], uniform[f"normalized.{name}"])
    radii = trace[[f"normalized.object_radius.{region}" for region in range(3)]][15:]
    assert (radii.nunique(axis=1) == 3).all()
    # 12 candidates for 16 variables, drawn around the best of the uniform ones: their mean is within four standard errors.
    start = uniform.loc[uniform["cost"].idxmin()]
    sigma = FREED_SIGMA
    names = [column for column in trace if column.startswith("normalized.")]
    inside = [n for n in names if 0.2 < start[re.sub(r"\.\d$", "", n)] < 0.8]  # away from the bounds, where steps are folded back
    assert len(inside) > 8
    for name in inside:
        assert trace[name][15:27].mean() == pytest.approx(start[re.sub(r"\.\d$", "", name)], abs=4 * sigma / np.sqrt(12))


def test_a_checkpoint_of_another_problem_or_that_does_not_replay_is_ignored(tmp_path, capsys):
    record = tmp_path / "trace.parquet"
    first = search(small.search_problem(), seed=0, record=record, key="one")
    other = search(small.search_problem(), seed=0, record=record, key="two")
    assert "other inputs or settings" in capsys.readouterr().out
    assert (other.attempts, other.cost) == (1, first.cost)
    table = pd.read_parquet(record)
    table.loc[0, "normalized.drag"] += 0.01
    table.to_parquet(record)
    forged = search(small.search_problem(), seed=0, record=record, key="two")
    assert "does not replay" in capsys.readouterr().out
    assert (forged.attempts, forged.cost) == (1, first.cost)


def test_the_future_is_never_read():
    changes = {
        "clusters": 3,
        "search": config.Search(rollouts=40),
        "simulation": config.SimulationSettings(initial_velocity="observed"),
    }
    first, second = (search(small.search_problem(o, **changes), seed=0) for o in (small.observations(), small.spoiled_future()))
    assert first.trace["cost"].tolist() == second.trace["cost"].tolist()


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


def test_an_unstable_candidate_is_penalized_not_fatal():
    needed = search(small.search_problem(simulation=config.SimulationSettings(safety=1.0)), seed=0).trace["substeps"]
    # Enough substeps for the softer half of the first candidates only.
    problem = small.search_problem(simulation=config.SimulationSettings(substeps=int(needed.median())))
    result = search(problem, seed=0)
    penalized = result.trace[result.trace["cost"] == PENALTY]
    assert 0 < len(penalized) < len(result.trace)
    assert penalized["reason"].str.startswith("unstable").all()


# Batches --------------------------------------------------------------------------------------------------------------


def crowded(**changes: object) -> SearchProblem:
    """The small search with self-collision."""
    seen = small.observations()
    return small.search_problem(replace(seen, scenario=replace(seen.scenario, self_collision=True)), **changes)


@pytest.mark.parametrize(("make", "clusters"), [(small.search_problem, 3), (crowded, 1)], ids=["regions", "self-collision"])
def test_the_search_is_the_same_bit_for_bit_however_candidates_are_simulated(make, clusters):
    """The slow path, one candidate after the other, is the specification."""
    slow = search(make(clusters=clusters, together=1), seed=3)
    assert slow.trace["substeps"].nunique() > 10
    for how in ({}, {"together": 4}, {"together": 1, "threads": 6}):
        fast = search(make(clusters=clusters, **how), seed=3)
        assert_same_trace(fast.trace, slow.trace)
        assert (fast.values, fast.cost) == (slow.values, slow.cost)
        np.testing.assert_array_equal(fast.twin.topology.springs, slow.twin.topology.springs)


def test_candidates_of_every_fate_in_one_generation(monkeypatch):
    """Some diverge, some are unstable, and the others are judged as if they were alone."""
    # About the spacing of the nodes.
    settings = small.released(rollouts=22, start={"object_radius": 0.0145, "stiffness": 3e4})
    chosen = small.search_problem(search=settings, simulation=config.SimulationSettings(substeps=60))
    check = stability.check

    def lenient(twin):
        # Nothing that passes the check diverges here, so candidates with little drag are let through.
        if twin.material.drag > 3.0:
            check(twin)

    monkeypatch.setattr(stability, "check", lenient)
    slow = search(replace(chosen, together=1), seed=2).trace
    assert_same_trace(search(chosen, seed=2).trace, slow)
    assert_same_trace(search(replace(chosen, threads=2), seed=2).trace, slow)
    kinds = {"left": "left the scene in frame", "unstable": "unstable: ", "fine": "^$"}
    for kind, pattern in kinds.items():
        rows = slow[slow["reason"].str.contains(pattern)]
        assert 0 in set(rows["generation"]), kind
        assert ((rows["cost"] == PENALTY) == (kind != "fine")).all()
        assert ((rows["substeps"] == 60) == (kind in ("left", "fine"))).all()


@pytest.mark.parametrize("first", [0, 3])
def test_a_cost_that_is_no_number_is_penalized_and_never_the_best(monkeypatch, first):
    simulate = module.rolled
    lost = iter(range(1000))

    def spoiled(*arguments):
        (own,) = simulate(*arguments)
        return [[replace(one, cost=float("nan")) if next(lost) % 4 == first else one for one in own]]

    monkeypatch.setattr(module, "rolled", spoiled)
    result = search(small.search_problem(search=small.released(rollouts=12)), seed=0)
    named = result.trace["reason"] == "the cost is not a number"
    assert named.sum() == 3 and (result.trace["cost"][named] == PENALTY).all()
    assert result.cost == result.trace["cost"][~named].min() < PENALTY


def stand_in(substeps: int) -> Any:
    """Attributes of a twin that `groups` reads."""
    return SimpleNamespace(simulation=SimpleNamespace(substeps=substeps))


@given(st.lists(st.integers(1, 2000), min_size=1, max_size=24), st.integers(0, 20), st.integers(1, 5))
def test_groups_are_a_partition_by_substeps_with_one_for_each_thread(substeps, together, threads):
    made = groups([stand_in(count) for count in substeps], "cpu", together, threads)
    order = [k for members in made for k in members]
    assert sorted(order) == list(range(len(substeps)))
    assert all(1 <= len(members) <= min(together or LANE_WIDTH, LANE_WIDTH) for members in made)
    # Those with the most substeps begin, in every group and among groups.
    for slowest in ([substeps[k] for k in members] for members in (*made, [members[0] for members in made])):
        assert slowest == sorted(slowest, reverse=True)
    if len(made) > threads:
        assert [substeps[k] for k in order] == sorted(substeps, reverse=True)
    else:
        assert max(map(len, made)) - min(map(len, made)) <= 1
    assert len(made) >= len(substeps) // -(-len(substeps) // threads)
