"""Candidates that are simulated together: results as alone, with costs equal to the torch losses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from neuspring import config
from neuspring.core.artifacts import Observations, Topology, Twin
from neuspring.physics.controllers import waypoints
from neuspring.physics.solver import FrameSolver, narrowing_solver, solver_for
from neuspring.physics.union import Union
from neuspring.twin.candidates import SearchProblem, candidate
from neuspring.twin.losses import FrameLoss
from neuspring.twin.rollout import FAR_AWAY, frames
from neuspring.twin.trials import LossSums, Outcome, Rollouts, rolled
from tests.support import small

FLOAT32_SUMS = 1e-5
"""Relative: float32 sums of up to 372 terms, in another order."""
CANDIDATES = (
    {"object_radius": 0.03, "stiffness": 2e3, "ground_friction": 0.1},
    {"object_radius": 0.045, "stiffness": 1.2e4, "drag": 6.0, "contact_distance": 0.03},
    {
        "object_radius": 0.04,
        "object_neighbors": 16.0,
        "stiffness": 3e4,
        "dashpot": 60.0,
        "ground_elasticity": 0.9,
        "contact_elasticity": 0.2,
    },
    {"object_neighbors": 10.0, "controller_neighbors": 12.0, "controller_radius": 0.03, "contact_distance": 0.012},
    {"object_radius": 0.02, "stiffness": 9e4, "contact_distance": 0.0135, "contact_elasticity": 0.1},
    {"stiffness": 6e2, "drag": 15.0, "object_neighbors": 14.0},
)


def colliding(seen: Observations, **simulation: object) -> SearchProblem:
    """The problem with self-collision."""
    crowded = replace(seen, scenario=replace(seen.scenario, self_collision=True))
    return small.search_problem(crowded, simulation=config.SimulationSettings(**simulation))  # type: ignore[arg-type]


def candidates(problem: SearchProblem, count: int = len(CANDIDATES)) -> list[Twin]:
    """Twins that differ in their springs, substeps and materials."""
    return [candidate(problem, small.start_values() | CANDIDATES[k % len(CANDIDATES)]) for k in range(count)]


def unsteady(twin: Twin, part: float = 0.25) -> Twin:
    """The twin with too few substeps."""
    return replace(twin, simulation=replace(twin.simulation, substeps=max(int(twin.simulation.substeps * part), 1)))


def loss_of(problem: SearchProblem, **changes: object) -> FrameLoss:
    return replace(FrameLoss.of(problem.observations, problem.losses, "cpu"), **changes)  # type: ignore[arg-type]


def hands_of(problem: SearchProblem) -> torch.Tensor:
    return torch.tensor(problem.observations.controller_points)[: problem.observations.scenario.train_end]


def alone(problem: SearchProblem, twins: Sequence[Twin], loss: FrameLoss) -> list[Outcome]:
    """Result of each candidate in its own launch."""
    return [small.judge(problem, [twin], loss)[0] for twin in twins]


def by_torch(problem: SearchProblem, twin: Twin, loss: FrameLoss) -> float:
    """The cost by the losses of the fit, over the rollout of a solver of the twin's own."""
    states = frames(twin, solver_for(twin, differentiable=False), hands_of(problem), problem.recordings[0].velocity.numpy())
    return small.rollout_loss(loss, states, problem.recordings[0].velocity)


# Batches --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("crowded", [False, True], ids=["free", "self-collision"])
@pytest.mark.parametrize("count", [6, 11])
def test_candidates_fare_together_as_alone(count, crowded):
    """In one group of lanes and in two, with lanes to spare."""
    problem = colliding(small.observations()) if crowded else small.search_problem()
    twins, loss = candidates(problem, count), loss_of(problem)
    assert len({t.topology.springs.tobytes() for t in twins}) == len({t.simulation.substeps for t in twins}) == min(count, 6)
    together = small.judge(problem, twins, loss)
    assert together == alone(problem, twins, loss)
    assert len({outcome.cost for outcome in together}) == min(count, 6)


@pytest.mark.parametrize("crowded", [False, True], ids=["free", "self-collision"])
def test_slow_candidates_end_their_frames_in_fewer_lanes_as_alone(crowded):
    """In lanes, then two without, then one; a hand lets go and takes hold again."""
    problem = colliding(small.observations()) if crowded else small.search_problem()
    hands, loss = hands_of(problem), loss_of(problem)
    holds = np.ones(hands.shape[:2], dtype=bool)
    holds[1:3, 0] = False
    twins = sorted(candidates(problem), key=lambda twin: -twin.simulation.substeps)
    parts = [(part.buffers.twins, part.buffers.width) for part in parts_of(narrowing_solver(twins, "cpu"))]
    assert parts == [(6, 8), (2, 1), (1, 1)]
    given = waypoints(hands, holds), problem.recordings[0].velocity, loss
    assert rolled([Rollouts(twins, *given)], "cpu")[0] == [rolled([Rollouts([twin], *given)], "cpu")[0][0] for twin in twins]


def parts_of(solver: FrameSolver | None) -> list[FrameSolver]:
    """A solver and the narrower ones behind it."""
    return [solver, *parts_of(solver.narrower)] if solver else []


@pytest.mark.parametrize("crowded", [False, True], ids=["free", "self-collision"])
def test_candidates_that_diverge_do_not_touch_the_others(crowded):
    problem = colliding(small.observations()) if crowded else small.search_problem()
    steady, loss = candidates(problem), loss_of(problem)
    twins = [unsteady(steady[0]), steady[1], unsteady(steady[2], 0.1), *steady[3:], unsteady(steady[4], 0.05)]
    together = small.judge(problem, twins, loss)
    assert together == alone(problem, twins, loss)
    assert [bool(outcome.diverged_frame) for outcome in together] == [True, False, True, False, False, False, True]
    assert all(np.isfinite(outcome.cost) == (not outcome.diverged_frame) for outcome in together)


def fan(partners: Sequence[int], nodes: int, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Places [N, 3] and velocities: node 0 in the middle, `partners` near it and coming, all others far from each other."""
    places = np.arange(1, nodes + 1)[:, None] * [0.0, 10 * distance, 0.0]
    places[0] = 0.0
    angles = np.linspace(0, 2 * np.pi, len(partners), endpoint=False)
    places[list(partners)] = 0.8 * distance * np.stack([np.cos(angles), 0.3 * np.ones_like(angles), np.sin(angles)], axis=1)
    velocities = np.zeros_like(places)
    velocities[list(partners)] = -places[list(partners)]
    return places, velocities


def test_a_shared_list_has_room_for_the_partners_of_every_twin():
    """Each of three twins has as many partners of node 0 as a twin may have, and keeps them."""
    capacity, distance = 2, 0.02
    problem = colliding(small.observations(), collision_capacity=capacity)
    twin = candidate(problem, small.start_values() | {"contact_distance": distance})
    twin = replace(twin, simulation=replace(twin.simulation, substeps=1, frame_time=1e-6, gravity=0.0))
    nodes = len(twin.topology.nodes)
    each = [fan(partners, nodes, distance) for partners in ([7, 8], [9, 10], [3, 4])]
    places, velocities = (torch.tensor(np.stack(values), dtype=torch.float32) for values in zip(*each, strict=True))
    hands = torch.tensor(twin.topology.controllers)

    def after(members: list[int]) -> tuple[np.ndarray, list[int]]:
        """Velocities of node 0 after a frame, and overflows."""
        twins = [replace(twin, material=replace(twin.material, stiffness=0 * twin.material.stiffness, drag=0.0)) for _ in members]
        twins = [replace(one, material=replace(one.material, dashpot=0 * one.material.dashpot)) for one in twins]
        solver = solver_for(twins, differentiable=False)
        still = hands.expand(len(members), -1, -1)
        _, v = solver.forward(places[members], velocities[members], still, still)
        return v[:, 0].numpy(), solver.overflows

    speeds, overflows = after([0, 1, 2])
    for k, (speed, overflow) in enumerate(zip(speeds, overflows, strict=True)):
        own, own_overflow = after([k])
        assert own_overflow == [overflow] == [0]
        assert own[0].any()
        np.testing.assert_array_equal(speed, own[0])


# Losses ---------------------------------------------------------------------------------------------------------------


def hidden() -> Observations:
    """Points that come and go, and motion that is valid for some of them."""
    seen, rng = small.observations(), np.random.default_rng(3)
    shape = seen.object_visibility.shape
    visible = rng.random(shape) < 0.6
    visible[0] = True
    return replace(seen, object_visibility=visible, object_motion_valid=rng.random(shape) < 0.3)


def dark() -> Observations:
    """Nothing seen in frame 2, and no motion valid from 1 to 2 and from 3 to 4."""
    seen = hidden()
    visible, valid = seen.object_visibility.copy(), seen.object_motion_valid.copy()
    visible[2] = valid[1] = valid[3] = False
    return replace(seen, object_visibility=visible, object_motion_valid=valid)


def astray() -> Observations:
    """Tracks more than a meter off, where the track loss is linear."""
    seen = small.observations()
    points = seen.object_points.copy()
    points[2:, ::3] += np.float32(2.5)
    return replace(seen, object_points=points)


SCENES = {"plain": small.observations, "hidden": hidden, "dark": dark, "astray": astray}


@pytest.mark.parametrize(("scene", "frozen"), [("plain", False), ("hidden", True), ("dark", False), ("astray", True)])
def test_the_cost_is_that_of_the_torch_losses(scene, frozen):
    problem = small.search_problem(SCENES[scene](), losses=config.Losses(chamfer=1.3, track=0.7, acceleration=0.2))
    twins, loss = candidates(problem, 3), loss_of(problem, frozen_counts=frozen)
    costs = [outcome.cost for outcome in small.judge(problem, twins, loss)]
    assert costs == pytest.approx([by_torch(problem, twin, loss) for twin in twins], rel=FLOAT32_SUMS)


def test_the_velocity_at_the_start_counts():
    """It moves the nodes, and the first change of velocity begins with it."""
    rest = small.search_problem()
    thrown = small.search_problem()
    start = torch.tensor(np.random.default_rng(0).normal(0, 2.0, rest.observations.nodes.shape).astype(np.float32))
    object.__setattr__(thrown, "recordings", (replace(thrown.recordings[0], velocity=start),))
    twins, loss = candidates(rest, 3), loss_of(rest)
    costs = [outcome.cost for outcome in small.judge(thrown, twins, loss)]
    assert costs == pytest.approx([by_torch(thrown, twin, loss) for twin in twins], rel=FLOAT32_SUMS)
    assert costs != pytest.approx([by_torch(rest, twin, loss) for twin in twins], rel=0.01)


def test_a_node_that_comes_back_has_left():
    """The first frame stays noted, of each twin its own."""
    problem = small.search_problem()
    twins = candidates(problem, 3)
    solver = solver_for(twins, differentiable=False)
    sums = LossSums(solver, loss_of(problem), problem.recordings[0].velocity)
    near = torch.tensor(twins[0].topology.nodes).expand(len(twins), -1, -1)
    for frame, gone in enumerate([(), (1,), (0, 1), ()], start=1):
        places = near.clone()
        for twin in gone:
            places[twin, 5 + twin, twin] = -2 * FAR_AWAY
        solver.start(places, 0 * places)
        sums.add(frame)
    assert sums.diverged.tolist() == [3, 2, 0]


# Solvers of several twins ---------------------------------------------------------------------------------------------


@st.composite
def graphs(draw: st.DrawFn) -> list[np.ndarray]:
    """Springs of one to four topologies of five nodes and two controllers; each pair once, ends in any order."""
    pairs = [(i, j) for i in range(7) for j in range(i + 1, 7) if i < 5]
    topologies = []
    for _ in range(draw(st.integers(1, 4))):
        own = draw(st.lists(st.sampled_from(pairs), min_size=1, unique=True))
        own.sort(key=lambda pair: pair[1] >= 5)  # springs of the object come first
        turned = draw(st.lists(st.booleans(), min_size=len(own), max_size=len(own)))
        topologies.append(np.array([pair[::-1] if turn else pair for pair, turn in zip(own, turned, strict=True)], np.int32))
    return topologies


def topology(springs: np.ndarray) -> Topology:
    """Five nodes and two controllers on a line."""
    points = np.arange(7)[:, None] * np.float32([0.01, 0, 0])
    rest = np.full(len(springs), 0.01)
    return Topology(nodes=points[:5], controllers=points[5:], springs=springs, rest_lengths=rest, labels=np.zeros(5, np.int32))


@given(graphs(), st.randoms(use_true_random=False))
def test_the_union_has_every_spring_once_and_knows_where(each, random):
    union = Union([topology(springs) for springs in each])
    (pairs,), places = union.tables, union.places
    ends = {frozenset(pair) for pair in pairs.tolist()}
    assert len(ends) == len(pairs)
    assert ends == {frozenset(pair) for springs in each for pair in springs.tolist()}
    for springs, place in zip(each, places, strict=True):
        np.testing.assert_array_equal(np.sort(pairs[place], axis=1), np.sort(springs, axis=1))
    # Neither the order of springs, nor their direction, nor that of the topologies decides the union.
    others = []
    for springs in random.sample(each, len(each)):
        turned = [pair[::-1] if random.random() < 0.5 else pair for pair in random.sample(springs.tolist(), len(springs))]
        others.append(topology(np.array(sorted(turned, key=lambda pair: max(pair) >= 5), np.int32)))
    (again,) = Union(others).tables
    np.testing.assert_array_equal(again, pairs)
