"""The solver of rods against energies and closed forms."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest
import torch

from neuspring.extensions.rods.rod import Rod
from neuspring.extensions.rods.solver import RodSolver
from tests.extensions.rods import make

# Sums of some hundred numbers in float64, through a few hundred substeps.
ROUNDING = 1e-9
LIVELY = {"curvature": np.random.default_rng(1).normal(0, 0.3, (7, 2)), "roll": 0.5, "drag_quadratic": 1.0, "stretching": 20.0}


def solver_of(rods: list[Rod], v: Any = 0.0, drag: float = 0.0, **changes: Any) -> RodSolver:
    """A solver at frame 0: `v` is one velocity, or that of each vertex."""
    solver = RodSolver(rods, [drag] * len(rods), make.simulation(**changes), "cpu")
    x = make.real([body.vertices for body in rods])
    solver.start(x, torch.zeros_like(x) + v)
    return solver


def roll_out(rods: list[Rod], hands: Any, v: Any = 0.0, drag: float = 0.0, **changes: Any) -> torch.Tensor:
    """Positions [T, B, V, 3]; held vertices of all rods move by `hands` [T, V, 3]."""
    solver = solver_of(rods, v, drag, **changes)
    path = make.real(hands)[:, None] + solver.x
    rows = [solver.x.clone()]
    for begin, end in pairwise(path):
        solver.frame(begin, end)
        rows.append(solver.x.clone())
    return torch.stack(rows)


def still(rods: list[Rod], frames: int, v: Any = 0.0, drag: float = 0.0, **changes: Any) -> torch.Tensor:
    """Positions [T, B, V, 3] while hands stay."""
    return roll_out(rods, np.zeros((frames + 1, len(rods[0].vertices), 3)), v, drag, **changes)


def shaken(frames: int, vertices: int, seed: int = 0) -> np.ndarray:
    """Hands [T, V, 3] that go 2 mm per frame to all sides, each vertex by itself."""
    steps = np.random.default_rng(seed).normal(0, 0.002, (frames, vertices, 3))
    return np.concatenate([np.zeros((1, vertices, 3)), steps.cumsum(0)])


@pytest.mark.parametrize(
    ("held", "damping"), [((0, 1, 5, 6), 0.0), ((0, 1, 5, 6), 0.01), ((0, 1), 0.01), ((0, 6), 0.01), ((), 0.01)]
)
def test_steps_converge_with_second_order(held, damping):
    body = make.rod(make.crooked(7), held, damping=damping, **LIVELY)
    hands, v, options = shaken(2, 7), make.real([0.2, -0.1, 0.3]), {"frame_time": 0.005, "gravity": 9.8}
    coarse, middle, fine = (roll_out([body], hands, v, 0.5, substeps=n, **options)[-1, 0] for n in (10, 20, 40))
    assert np.log2(float((middle - coarse).norm() / (fine - middle).norm())) == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("by_angle", [0.0, 1.0])
def test_at_rest_the_energy_is_least(by_angle):
    """Derivatives of the energy that is written down here, by finite differences, balance the weight."""
    stiff = {"bending": 0.1, "twisting": 0.05, "stretching": 1e3, "damping": 0.02, "by_angle": by_angle}
    body = make.rod(make.crooked(7), (0, 1, 5, 6), **LIVELY | stiff)
    x = still([body], 60, drag=20.0, gravity=9.8)[-1, 0].numpy()
    for vertex, axis in product((2, 3, 4), range(3)):
        step = np.zeros((7, 3))
        step[vertex, axis] = 1e-6
        above, below = (make.stored(solver_of([replace(body, vertices=moved)])) for moved in (x + step, x - step))
        weight = 9.8 * body.mass[vertex]
        assert (above - below) / 2e-6 == pytest.approx(-weight * (axis == 2), abs=1e-4 * weight)


def test_lanes_are_the_same_alone_and_in_company():
    rods = [
        make.rod(make.crooked(7, seed=seed), (0, 1, 5, 6), bending=10.0**-seed, damping=0.01 * seed, **LIVELY) for seed in range(3)
    ]
    hands = shaken(5, 7)
    together = roll_out(rods, hands, gravity=9.8)
    for lane, body in enumerate(rods):
        assert torch.equal(together[:, lane], roll_out([body], hands, gravity=9.8)[:, 0])


def test_clamps_keep_their_directors_to_the_axis():
    body = make.rod(make.crooked(7), (0, 1, 5, 6), **LIVELY)
    solver = solver_of([body], gravity=9.8)
    path = make.real(body.vertices) + 5 * make.real(shaken(5, 7))
    for begin, end in pairwise(path):
        solver.frame(begin[None], end[None])
    along = np.diff(path[-1].numpy(), axis=0)[[0, -1]]
    t, directors = along / np.linalg.norm(along, axis=1, keepdims=True), solver.directors()[0, [0, -1]].numpy()
    first, last = (axis / np.linalg.norm(axis) for axis in body.axis - (t @ body.axis)[:, None] * t)
    np.testing.assert_allclose(directors[0], first, atol=ROUNDING)
    assert np.arctan2(np.cross(last, directors[1]) @ t[1], last @ directors[1]) == pytest.approx(body.roll)


def test_a_free_rod_keeps_its_momentum():
    """Linear momentum exactly, angular momentum with the order of the scheme."""
    body = make.rod(make.crooked(7), (), damping=0.01, stretching=20.0, curvature=LIVELY["curvature"])
    v = make.real(np.random.default_rng(3).normal(0, 0.3, (7, 3)))
    mass = make.real(body.mass)[:, None]
    gains = []
    for substeps in (10, 20):
        solver = solver_of([body], v, substeps=substeps)
        for _ in range(5):
            solver.frame(solver.x, solver.x)
        x, pushes = solver.x[0], mass * solver.v[0]
        assert torch.allclose(pushes.sum(0), (mass * v).sum(0), atol=ROUNDING, rtol=0)
        gains.append(float((torch.linalg.cross(x, pushes) - torch.linalg.cross(make.real(body.vertices), mass * v)).sum(0).norm()))
    assert np.log2(gains[0] / gains[1]) == pytest.approx(2, abs=0.2)


def test_a_stiff_rod_on_a_hinge_is_a_pendulum():
    body = make.rod(make.straight(5, 0.5, (0, 0, -1)), (0,), bending=1e4, twisting=1e4, stretching=1e6)
    away, mass = -body.vertices[:, 2], body.mass
    frequency = np.sqrt(9.8 * (mass @ away) / (mass @ away**2))
    period, speed, frames, substeps = 2 * np.pi / frequency, 0.01, 40, 10
    v = make.real(np.outer(away, [speed, 0, 0]))
    x = still([body], frames, v, frame_time=period / frames, substeps=substeps, gravity=9.8)[:, 0, -1, 0]
    amplitude = speed * 0.5 / frequency
    # BDF2 has frequencies that are too small by (w h)^2 / 3 of themselves.
    late = (2 * np.pi / frames / substeps) ** 2 / 3
    assert float(x[10]) == pytest.approx(amplitude, rel=2 * late + 1e-3)
    for half in (1, 2):
        delay = np.pi * half * late
        assert float(x[20 * half]) / amplitude == pytest.approx((-1) ** half * -delay, rel=0.1)


def test_a_column_swings_below_its_buckling_load_and_grows_above():
    """Exact for small w = w0(t) sin(pi x): w0'' = -w^2 (1 - load / buckling load) w0, of segments too."""
    segments, shares, speed = 6, (0.5, 1.5), 1e-4
    rods = [make.column(segments, share * make.buckling_load(segments), stretching=1e5) for share in shares]
    sine = np.sin(np.pi * rods[0].vertices[:, 0])
    x = still(rods, 40, make.real(np.outer(sine, [0, 0, speed])), substeps=10)[..., segments // 2, 2]
    frequency = 4 * np.sin(np.pi / 2 / segments) ** 2 * segments**2
    time = 0.01 * torch.arange(41, dtype=torch.float64)
    rate = frequency * 0.5**0.5
    # The column is strained by 1e-4, and (w h)^2 is 5e-5.
    swing, growth = speed / rate * torch.sin(rate * time), speed / rate * torch.sinh(rate * time)
    np.testing.assert_allclose(x[:, 0], swing, atol=1e-3 * speed / rate)
    np.testing.assert_allclose(x[:, 1], growth, atol=1e-3 * float(growth[-1]))


def test_twist_makes_a_straight_rod_unstable():
    """The critical moment is Greenhill's, times 1.035 with eight segments."""
    rods = [make.twisted(8, share * 1.035 * make.GREENHILL) for share in (0.9, 1.1)]
    nudge = 1e-3 * np.sin(np.pi * rods[0].vertices[:, 0])
    x = still(rods, 25, make.real(np.outer(nudge, [0, 0, 1])), frame_time=0.02)
    away = x[..., 1:].abs().amax((2, 3))
    assert float(away[:, 0].max()) < 2e-4
    assert float(away[:, 1].max()) > 5e-3


@pytest.mark.parametrize("damping", [0.0, 0.02, 0.3])
@pytest.mark.parametrize(("twisting", "substeps"), [(0.1, 5), (1.0, 5), (1.0, 1)])
def test_the_stiffest_cable_is_stable(damping, twisting, substeps):
    """EI = 1 N m^2 at 5 cm, in substeps of 2 and 10 ms: its highest frequency is 1,600 rad/s. It begins far from its rest shape."""
    curvature = np.random.default_rng(1).normal(0, 0.3, (9, 2))
    options: dict[str, Any] = {"bending": 1.0, "twisting": twisting, "stretching": 2e4, "damping": damping, "roll": 0.5}
    body = make.rod(make.crooked(9, bend=0.1), (0, 1, 7, 8), curvature=curvature, **options)
    hands = 0.05 * np.sin(0.1 * np.minimum(np.arange(200), 94))[:, None, None] * np.array([0.3, 1, 0.5])
    x = roll_out([body], np.broadcast_to(hands, (200, 9, 3)), drag=0.3, gravity=9.8, substeps=substeps)[:, 0]
    speeds = x.diff(dim=0).norm(dim=2).amax(1) / 0.01
    # Hands go at up to 0.6 m/s.
    assert float(speeds.max()) < 4
    if damping:
        assert float(speeds[-1]) < 1e-3
