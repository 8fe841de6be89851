"""Bending springs: which there are, what they resist, and that they are absent where nobody asks for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuspring.core.artifacts import Topology, Twin
from neuspring.physics import stability
from neuspring.twin.losses import FrameLoss
from neuspring.twin.rollout import roll_out
from neuspring.twin.search import SearchProblem, candidate, judge, search
from neuspring.twin.topology import bending_springs, distances, piecewise_topology
from neuspring.twin.transfer import rebase
from tests.support import small
from tests.support.scenes import scene, twin_of
from tests.support.searches import assert_same_trace

SPACING = 0.02
REACH = (1.6 * SPACING, 2.6 * SPACING)
NEAREST = 1.2 * SPACING
"""Joins the four neighbors of a node of a square lattice."""
FLOAT32_LENGTHS = 1e-5
"""Relative, of energies that go with squares of strains of 0.03 and more: rest lengths are rounded to float32 (6e-8)."""


def bent_strip(turn: float, rows: int = 8, columns: int = 3) -> np.ndarray:
    """A strip of cloth [rows x columns, 3] whose rows keep their distance, with the same turn [rad] at every inner row."""
    directions = turn * np.arange(rows - 1)
    along = np.concatenate([[[0, 0]], np.cumsum(np.stack([np.cos(directions), np.sin(directions)], axis=1), axis=0)])
    rest = [[x, y, z] for x, z in along * SPACING for y in SPACING * np.arange(columns)]
    return np.array(rest)


def strip_topology(bending: tuple[float, float] | None, hands: np.ndarray | None = None) -> Topology:
    """The flat strip, each node joined to its four neighbors."""
    flat = bent_strip(0.0)
    hands = np.array([[0.0, 0.0, 1.0]]) if hands is None else hands
    labels = np.zeros(len(flat), np.int32)
    return piecewise_topology(flat, hands, labels, [NEAREST], [9], NEAREST, 9, bending=bending)


def energy(topology: Topology, points: np.ndarray, stiffness: np.ndarray | float = 1.0) -> float:
    """Sum of Y l0 (l / l0 - 1)^2 / 2 over springs: what the force Y (l / l0 - 1) is the slope of, J."""
    rest = topology.rest_lengths.astype(np.float64)
    strain = distances(points, topology.springs) / rest - 1
    return float((stiffness * rest * strain**2 / 2).sum())


# Which springs there are ----------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 30), low=st.floats(0.05, 0.5), width=st.floats(0.01, 0.5))
def test_they_are_the_pairs_within_reach_that_nothing_joins(seed: int, count: int, low: float, width: float) -> None:
    nodes = np.random.default_rng(seed).uniform(0, 1, (count, 3))
    hands, labels = nodes[:1] + 0.3, np.zeros(count, np.int32)
    with_bending = piecewise_topology(nodes, hands, labels, [0.3], [5], 0.6, 4, bending=(low, low + width))
    without = piecewise_topology(nodes, hands, labels, [0.3], [5], 0.6, 4)
    pairs = [tuple(sorted(pair)) for pair in with_bending.springs.tolist()]
    assert len(set(pairs)) == len(pairs), "no spring twice"
    ordinary = {tuple(sorted(pair)) for pair in without.springs.tolist()}
    wanted = set()
    for i in range(count):
        for j in range(i + 1, count):
            if low <= np.linalg.norm(nodes[i] - nodes[j]) <= low + width and (i, j) not in ordinary:
                wanted.add((i, j))
    marks = with_bending.is_bending
    assert {pair for pair, mark in zip(pairs, marks, strict=True) if mark} == wanted
    # The others are what they are without, in their order, bit for bit.
    np.testing.assert_array_equal(with_bending.springs[~marks], without.springs)
    np.testing.assert_array_equal(with_bending.rest_lengths[~marks], without.rest_lengths)
    assert without.bending.shape == (0,)


def test_along_a_line_they_lie_across_one_node() -> None:
    line = SPACING * np.arange(6)[:, None] * np.array([1.0, 0, 0])
    assert bending_springs(line, np.zeros((0, 2), int), REACH).tolist() == [[0, 2], [1, 3], [2, 4], [3, 5]]
    assert bending_springs(line, np.array([[3, 1]]), REACH).tolist() == [[0, 2], [2, 4], [3, 5]]


def test_a_moved_twin_keeps_them() -> None:
    problem = bendable()
    twin = candidate(problem, small.start_values() | {"bending": 0.5})
    moved = rebase(twin, problem.observations)
    assert moved.topology.is_bending.any()
    np.testing.assert_array_equal(moved.topology.is_bending, twin.topology.is_bending)


# What they resist -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turn", [0.3, 0.6, 1.2])
def test_a_bent_strip_has_the_energy_of_its_bending_springs(turn: float) -> None:
    """Rows that turn by a at equal distances strain nothing else; the closed form is a sum over springs across one row."""
    bare, bending = strip_topology(None), strip_topology(REACH)
    bent = np.concatenate([bent_strip(turn), bending.controllers])
    half = np.cos(turn / 2)
    # Two rows away, in the same column and one aside: six pairs of rows, with three and four springs each.
    straight = SPACING * (half - 1) ** 2
    aside = SPACING * np.sqrt(5) / 2 * (np.sqrt(4 * half**2 + 1) / np.sqrt(5) - 1) ** 2
    # Two columns away, in the same row (8) and in the next (2 x 7): the bend does not change their lengths.
    assert bending.is_bending.sum() == 6 * (3 + 4) + 8 + 2 * 7
    assert energy(bending, bent) == pytest.approx(6 * (3 * straight + 4 * aside), rel=FLOAT32_LENGTHS)
    assert energy(bare, bent) < FLOAT32_LENGTHS * energy(bending, bent)


def test_at_equal_stretch_stiffness_more_of_it_resists_bending_more() -> None:
    bending = strip_topology(REACH)
    flat, bent = bent_strip(0.0), np.concatenate([bent_strip(0.5), bending.controllers])
    stretched = np.concatenate([flat * [1.01, 1, 1], bending.controllers])
    ratios = []
    for factor in (0.0, 0.01, 0.1, 1.0, 10.0):
        stiffness = np.where(bending.is_bending, factor, 1.0)
        ratios.append(energy(bending, bent, stiffness) / energy(bending, stretched, stiffness))
    assert (np.diff(ratios) > 0).all()
    assert ratios[0] < 1e-6 * ratios[1]


def fall(factor: float | None) -> Twin:
    """The strip, held at its first two rows, about to fall; factor None: without bending springs."""
    flat = bent_strip(0.0)
    hands = flat[:6] + np.array([0, 0, 1e-3])
    topology = strip_topology(REACH if factor is not None else None, hands)
    stiffness = np.where(topology.is_bending, factor or 0.0, 1.0)
    settings = {"frame_time": 0.02, "substeps": 40, "gravity": 9.8}
    body = scene(
        len(flat), topology.springs, topology.rest_lengths, stiffness=4e3 * stiffness, dashpot=20 * stiffness, drag=10.0, **settings
    )
    twin = twin_of(body, topology.nodes, hands)
    stability.check(twin)
    return twin


def test_a_strip_held_at_one_end_sags_less_with_them() -> None:
    heights = []
    for factor in (None, 0.1, 1.0):
        twin = fall(factor)
        hands = np.repeat(twin.topology.controllers[None], 61, axis=0)
        heights.append(float(roll_out(twin, hands).positions[-1, -3:, 2].mean()))
    assert heights[0] < heights[1] < heights[2] < 0


def test_without_stiffness_they_change_nothing() -> None:
    twins = [fall(None), fall(0.0), fall(1e-6)]
    hands = np.repeat(twins[0].topology.controllers[None], 11, axis=0)
    without, zero, little = (roll_out(twin, hands).positions for twin in twins)
    np.testing.assert_array_equal(zero, without)
    sagged = np.abs(without[-1] - without[0]).max()
    assert 0 < np.abs(little - without).max() < 1e-3 * sagged


# The search -----------------------------------------------------------------------------------------------------------


def bendable(**changes: object) -> SearchProblem:
    """The small search with a factor of bending; second neighbors are not joined by its ordinary springs."""
    free = small.search_problem()
    return small.search_problem(search=replace(free.search, extra=("bending",), **changes))


def test_bending_is_a_variable_where_it_is_asked_for() -> None:
    free, values = small.search_problem(), small.start_values()
    wanted = bendable()
    assert wanted.variables == (*free.variables, "bending")
    assert wanted.decode(np.full(13, 0.4))["bending"] == pytest.approx(0.1)
    assert wanted.decode(wanted.encode())["bending"] == pytest.approx(0.1)
    plain, bending = candidate(free, values), candidate(wanted, values | {"bending": 0.25})
    marks = bending.topology.is_bending
    assert not len(plain.topology.bending)
    assert 0 < marks.sum() < bending.topology.object_spring_count
    lengths = bending.topology.rest_lengths[marks] / free.spacing
    assert lengths.min() >= 1.6 - 1e-6
    assert lengths.max() <= 2.6 + 1e-6
    np.testing.assert_array_equal(bending.topology.springs[~marks], plain.topology.springs)
    for name in ("stiffness", "dashpot"):
        made = getattr(bending.material, name)
        np.testing.assert_allclose(made[marks], 0.25 * values[name], rtol=1e-6)
        np.testing.assert_array_equal(made[~marks], getattr(plain.material, name))


def test_stiff_ones_need_more_substeps() -> None:
    problem, values = bendable(), small.start_values()
    substeps = [candidate(problem, values | {"bending": factor}).simulation.substeps for factor in (0.001, 1.0, 100.0)]
    assert substeps[0] < substeps[1] < substeps[2]


def test_the_cost_of_a_candidate_goes_to_that_without_them() -> None:
    free, wanted, values = small.search_problem(), bendable(), small.start_values()
    loss = FrameLoss.of(free.observations, free.losses, "cpu", frozen_counts=False)
    without = candidate(free, values)
    count = without.simulation

    def cost(factor: float) -> float:
        return judge(wanted, [replace(candidate(wanted, values | {"bending": factor}), simulation=count)], loss)[0].cost

    reference = judge(free, [without], loss)[0].cost
    assert cost(0.0) == reference
    changes = [abs(cost(factor) / reference - 1) for factor in (1e-5, 1e-3, 0.1)]
    assert changes[0] < 1e-3
    assert changes[0] < changes[1] < changes[2]


def test_nodes_that_only_bending_springs_hold_are_isolated() -> None:
    """They may have next to no stiffness."""
    problem = bendable(isolated_nodes="repair")
    values = small.start_values() | {
        "object_radius": 0.5 * problem.spacing,
        "controller_radius": problem.reach * 0.5,
        "bending": 0.1,
    }
    topology = candidate(problem, values).topology
    degree = np.bincount(topology.springs[~topology.is_bending].ravel(), minlength=len(topology.nodes))
    assert degree.min() > 0


def test_a_search_with_them_is_polished_and_repeats() -> None:
    problem = bendable(rollouts=40)
    polish = replace(problem.search.polish, rounds=1, variables=("stiffness", "bending"))
    problem = replace(problem, search=replace(problem.search, polish=polish))
    first, second = search(problem, seed=0), search(problem, seed=0)
    assert_same_trace(first.trace, second.trace)
    assert {"slopes", "polish"} <= set(first.trace["stage"])
    assert first.values["bending"] == first.trace.loc[first.trace[first.trace["stage"] != "slopes"]["cost"].idxmin(), "bending"]
