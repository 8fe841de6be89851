"""Twins simulated together: results equal those of each twin alone, bit for bit, for any batch and kernel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuspring.core.errors import InputError
from neuspring.physics.controllers import waypoints
from neuspring.physics.solver import FrameSolver
from tests.support.scenes import VARIANTS, WAYS, Scene, random_scene, solver_for

SINGLE, DOUBLE = torch.float32, torch.float64
ROUNDING = 1e-5
"""Float32 sums of the same terms in another order, relative to the largest entry: each term is rounded to 6e-8,
then carried through tens of substeps."""
SUBSTEPS = (10, 13, 11, 15, 10, 12, 7)
"""Substeps of the first twins; further twins repeat them."""
SIZES = [(SINGLE, 7), (SINGLE, 17), (DOUBLE, 6)]
"""Less than, and more than the eight lanes."""


class Member(NamedTuple):
    """A twin of a population: its scene, start and hands."""

    body: Scene
    x: np.ndarray
    v: np.ndarray
    hands: np.ndarray
    """As the solver takes them (controllers.py)."""


def member(number: int, variant: str) -> Member:
    """Twins on the same graph, near each other, and different in everything else."""
    body, x, v, hands = random_scene(53, nodes=6, substeps=10, frame_time=0.02, **VARIANTS[variant])
    rng, springs = np.random.default_rng(number), len(body.springs)
    body = replace(
        body,
        stiffness=body.stiffness * rng.uniform(0.5, 2.0, springs),
        rest_lengths=body.rest_lengths * rng.uniform(0.9, 1.1, springs),
        dashpot=body.dashpot * rng.uniform(0.5, 2.0, springs),
        drag=body.drag * rng.uniform(0.5, 2.0),
        ground=tuple(rng.uniform(0.1, 0.9, 2)),
        contact=tuple(rng.uniform(0.1, 0.9, 2)),
        contact_distance=rng.uniform(0.02, 0.045),
        simulation=replace(body.simulation, substeps=SUBSTEPS[number % len(SUBSTEPS)], frame_time=rng.uniform(0.018, 0.022)),
    )
    shift = [amount * rng.uniform(-1.0, 1.0, values.shape) for amount, values in ((5e-3, x), (0.3, v), (0.01, hands))]
    if np.ndim(body.mass):
        body = replace(body, mass=body.mass * rng.uniform(0.5, 2.0, body.nodes))
    return Member(body, x + shift[0], v + shift[1], waypoints(torch.tensor(hands + shift[2])).numpy())


Results = dict[str, np.ndarray]


def results(solver: FrameSolver, x: Any, v: Any, hands: Any) -> Results:
    """Two frames, and the adjoints of the second for a fixed loss. Arrays as the solver takes them, hands [.., F, C, 3]."""
    x, v, hands = (torch.tensor(np.asarray(values), dtype=solver.dtype, device=solver.device) for values in (x, v, hands))
    first = solver.forward(x, v, hands[..., 0, :, :], hands[..., 1, :, :])
    second = solver.forward(*first, hands[..., 1, :, :], hands[..., 2, :, :])
    weight = torch.tensor(np.random.default_rng(7).standard_normal((2, *x.shape[-2:]))).to(x)
    adjoints = solver.backward(*(values.expand_as(x) for values in weight))
    states = {"first x": first[0], "first v": first[1], "second x": second[0], "second v": second[1]}
    every = {"x": adjoints[0], "v": adjoints[1]} | adjoints[2]
    named = states | {f"adjoint {name}": values for name, values in every.items()}
    return {name: values.cpu().numpy() for name, values in named.items()}


def together(members: Sequence[Member], dtype: torch.dtype, **options: Any) -> Results:
    """Results [B, ...] of twins in one solver."""
    solver = solver_for([one.body for one in members], members[0].hands.shape[1], dtype=dtype, **options)
    return results(solver, *(np.stack(values) for values in list(zip(*members, strict=True))[1:]))


def alone(one: Member, dtype: torch.dtype, **options: Any) -> Results:
    return results(solver_for(one.body, one.hands.shape[1], dtype=dtype, **options), *one[1:])


@cache
def member_alone(number: int, variant: str, dtype: torch.dtype) -> Results:
    return alone(member(number, variant), dtype)


def assert_same(got: Results, wanted: Results, label: Any = ""):
    assert got.keys() == wanted.keys()
    for name, values in wanted.items():
        np.testing.assert_array_equal(got[name], values, err_msg=f"{label} {name}")


def of(population: Results, number: int) -> Results:
    return {name: values[number] for name, values in population.items()}


# Alone and in company -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(("dtype", "count"), SIZES)
def test_a_twin_gets_what_it_gets_alone(dtype, count, variant):
    got = together([member(number, variant) for number in range(count)], dtype)
    for number in range(count):
        assert_same(of(got, number), member_alone(number, variant, dtype), number)


@pytest.mark.parametrize("variant", VARIANTS)
def test_twins_differ_and_are_lively(variant):
    """Otherwise equality would say little: each reaches its contacts, and none is another's copy."""
    members = [member(number, variant) for number in range(17)]
    simulation = members[0].body.simulation
    for name, on in (("ground", simulation.ground), ("contact", simulation.self_collision)):
        each = [member_alone(number, variant, SINGLE) for number in range(17)]
        touched = [bool(one[f"adjoint {name}_e"].any() or one[f"adjoint {name}_mu"].any()) for one in each]
        assert sum(touched) >= 12 if on else not any(touched), name
    ends = np.stack([member_alone(number, variant, SINGLE)["second x"] for number in range(17)])
    gaps = np.abs(ends[:, None] - ends[None]).max(axis=(2, 3))
    assert (gaps[np.triu_indices(17, 1)] > 1e-3).all()


@pytest.mark.parametrize("variant", VARIANTS)
def test_twins_have_graphs_of_their_own(variant):
    """The solver holds the union of their springs; absent ones have neither stiffness nor dashpot, and change nothing."""
    members, rng = [member(number, variant) for number in range(6)], np.random.default_rng(1)
    present = rng.random((6, len(members[0].body.springs))) < 0.6
    assert len({row.tobytes() for row in present}) == 6
    union = [
        one._replace(body=replace(one.body, stiffness=one.body.stiffness * own, dashpot=one.body.dashpot * own))
        for one, own in zip(members, present, strict=True)
    ]
    got = together(union, SINGLE)
    for number, (one, own) in enumerate(zip(members, present, strict=True)):
        names = ("springs", "stiffness", "rest_lengths", "dashpot", "pushes")
        body = replace(one.body, **{name: getattr(one.body, name)[own] for name in names})
        in_union = of(got, number)
        in_union["adjoint springs"] = in_union["adjoint springs"][own]
        assert_same(in_union, alone(one._replace(body=body), SINGLE), number)


def assert_same_by_threads(got: Results, wanted: Results, variant: str):
    """Bit for bit; but adjoints of impulses add to both nodes of a pair in any order."""
    for name, values in wanted.items():
        if VARIANTS[variant].get("self_collision") and name.startswith("adjoint"):
            np.testing.assert_allclose(got[name], values, atol=ROUNDING * np.abs(values).max(), rtol=0, err_msg=name)
        else:
            np.testing.assert_array_equal(got[name], values, err_msg=name)


@pytest.mark.parametrize(("device", "threads"), WAYS[1:])
@pytest.mark.parametrize("variant", VARIANTS)
def test_a_thread_per_node_gives_what_it_gives_alone_and_what_one_thread_gives(variant, device, threads):
    members, options = [member(number, variant) for number in range(3)], {"device": device, "threads": threads}
    got = together(members, SINGLE, **options)
    for number, one in enumerate(members):
        assert_same_by_threads(of(got, number), alone(one, SINGLE, **options), variant)
    if device == "cpu":
        assert_same_by_threads(got, together(members, SINGLE), variant)


@pytest.mark.parametrize("broken", [0, 3])
@pytest.mark.parametrize("how", ["nan", "infinite speed", "far away", "divergence"])
def test_a_broken_twin_breaks_no_other(how, broken):
    members = [member(number, "all") for number in range(7)]
    one = members[broken]
    members[broken] = {
        "nan": one._replace(x=np.where(np.arange(6)[:, None] == 2, np.nan, one.x)),
        "infinite speed": one._replace(v=one.v * np.inf),
        "far away": one._replace(x=one.x * 1e30),
        "divergence": one._replace(body=replace(one.body, stiffness=one.body.stiffness * 1e30)),
    }[how]
    got = together(members, SINGLE)
    sick = of(got, broken)["second x"]
    assert not np.isfinite(sick).all() or np.abs(sick).max() > 1e6
    for number in set(range(7)) - {broken}:
        assert_same(of(got, number), member_alone(number, "all", SINGLE), number)


@pytest.mark.parametrize(("name", "value"), [("gravity", 1.6), ("self_collision", True), ("collision_capacity", 7)])
def test_twins_share_their_physics(name, value):
    """The solver reads these values from the first twin, so they must be equal."""
    body, *_ = member(0, "ground")
    with pytest.raises(InputError, match=rf"simulation\.{name}.*same for all twins"):
        solver_for([body, replace(body, simulation=replace(body.simulation, **{name: value}))], 2)


# The list of springs --------------------------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None)
@given(st.data())
def test_order_and_direction_of_springs_do_not_matter(data):
    one = member(data.draw(st.integers(0, 5)), data.draw(st.sampled_from(sorted(VARIANTS))))
    count = len(one.body.springs)
    order = np.array(data.draw(st.permutations(range(count))))
    turned = np.array(data.draw(st.lists(st.booleans(), min_size=count, max_size=count)))
    springs = one.body.springs[order]
    springs = np.where(turned[:, None], springs[:, ::-1], springs)
    names = ("stiffness", "rest_lengths", "dashpot", "pushes")
    other = replace(one.body, springs=springs, **{name: getattr(one.body, name)[order] for name in names})
    wanted, got = alone(one, SINGLE), alone(one._replace(body=other), SINGLE)
    wanted["adjoint springs"] = wanted["adjoint springs"][order]
    assert_same(got, wanted)
