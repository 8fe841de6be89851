"""The fast solver of rods against its specification and closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from neuspring.core.artifacts import Rod
from neuspring.physics import rod_reference
from neuspring.physics.rod import RodLanes, RodSolver
from tests.support.rods import (
    GREENHILL,
    SAG,
    buckling_load,
    cantilever,
    coil,
    column,
    crooked,
    real,
    rod,
    simulation,
    straight,
    twisted,
)


def solver_of(rods: list[Rod], v: Any = 0.0, drag: float = 0.0, **changes: Any) -> RodSolver:
    """A solver at frame 0: `v` is one velocity, or of each vertex."""
    solver = RodSolver(RodLanes.of(rods, [drag] * len(rods)), simulation(**changes), "cpu")
    x = real([body.vertices for body in rods])
    solver.start(x, torch.zeros_like(x) + v)
    return solver


def roll_out(rods: list[Rod], hands: Any, v: Any = 0.0, drag: float = 0.0, **changes: Any) -> torch.Tensor:
    """Positions [T, B, V, 3]; held vertices of all rods follow `hands` [T, V, 3] less frame 0, from where they are."""
    solver = solver_of(rods, v, drag, **changes)
    path = (real(hands) - real(hands)[0])[:, None] + solver.x
    rows = [solver.x.clone()]
    for begin, end in zip(path[:-1], path[1:], strict=True):
        solver.frame(begin, end)
        rows.append(solver.x.clone())
    return torch.stack(rows)


def still(rods: list[Rod], frames: int, drag: float = 0.0, **changes: Any) -> torch.Tensor:
    """Positions [B, V, 3] after frames in which hands stay."""
    return roll_out(rods, np.zeros((frames + 1, len(rods[0].vertices), 3)), drag=drag, **changes)[-1]


def shaken(frames: int, vertices: int, seed: int = 0) -> np.ndarray:
    """Hands [T, V, 3] that go 4 mm per frame to all sides, each vertex by itself."""
    steps = np.random.default_rng(seed).normal(0, 0.004, (frames, vertices, 3))
    return np.concatenate([np.zeros((1, vertices, 3)), steps.cumsum(0)])


LIVELY = {"curvature": np.random.default_rng(1).normal(0, 0.3, (7, 2)), "roll": 0.5, "drag_quadratic": 1.0}


@pytest.mark.parametrize("held", [(0, 1, 5, 6), (0, 1), (0, 6), ()])
@pytest.mark.parametrize("damping", [0.0, 0.01])
def test_steps_converge_with_second_order_to_the_specification(held: tuple[int, ...], damping: float) -> None:
    body = rod(crooked(7), held, damping=damping, stretching=20.0, **LIVELY)
    hands, v = shaken(2, 7), real([0.2, -0.1, 0.3])
    coarse, middle, fine = (roll_out([body], hands, v, 0.5, gravity=9.8, substeps=n)[-1, 0] for n in (20, 40, 80))
    path = real(hands) + real(body.vertices)
    slow, slower = (
        rod_reference.roll_out(body, simulation(gravity=9.8), path, v.expand(7, 3), drag=0.5, steps=n)[-1] for n in (8, 16)
    )
    change = float((fine - middle).norm())
    print(
        held,
        damping,
        np.log2(float((middle - coarse).norm()) / change),
        change,
        (slower - slow).norm().item(),
        ((4 * fine - middle) / 3 - (4 * slower - slow) / 3).norm().item(),
    )


def test_lanes_are_the_same_alone_and_in_company() -> None:
    rods = [rod(crooked(7, seed=seed), (0, 1, 5, 6), bending=10.0**-seed, damping=0.01 * seed, **LIVELY) for seed in range(3)]
    hands = shaken(5, 7)
    together = roll_out(rods, hands, gravity=9.8)
    for lane, body in enumerate(rods):
        assert torch.equal(together[:, lane], roll_out([body], hands, gravity=9.8)[:, 0])


def momentum(solver: RodSolver, mass: torch.Tensor) -> torch.Tensor:
    """Linear and angular [6]."""
    pushes = mass[:, None] * solver.v[0]
    return torch.cat([pushes.sum(0), torch.linalg.cross(solver.x[0], pushes).sum(0)])


def test_a_free_rod_keeps_its_momentum() -> None:
    body = rod(crooked(7), (), damping=0.01, stretching=20.0, curvature=LIVELY["curvature"])
    mass = real(body.mass)
    v = real(np.random.default_rng(3).normal(0, 0.3, (7, 3)))
    for substeps in (10, 20, 40, 80):
        solver = solver_of([body], v, substeps=substeps)
        before = momentum(solver, mass)
        for _ in range(5):
            solver.frame(solver.x, solver.x)
        print(substeps, (momentum(solver, mass) - before).numpy(), before.numpy())


def test_a_stiff_rod_on_a_hinge_is_a_pendulum() -> None:
    body = rod(straight(5, 0.5, (0, 0, -1)), (0,), bending=1e4, twisting=1e4, stretching=1e6)
    away = -body.vertices[1:, 2]
    mass = body.mass[1:]
    frequency = np.sqrt(9.8 * (mass @ away) / (mass @ away**2))
    period = 2 * np.pi / frequency
    speed = 0.01
    for n in (5, 10, 20):
        solver = solver_of(
            [body], real(np.outer(-body.vertices[:, 2], [speed, 0, 0])), frame_time=period / 40, substeps=n, gravity=9.8
        )
        rows = []
        for _ in range(40):
            solver.frame(solver.x, solver.x)
            rows.append(float(solver.x[0, -1, 0]))
        print(n, rows[19], rows[39], rows[9] / (speed * 0.5 / frequency), (2 * np.pi / 40 / n) ** 2)


def test_a_cantilever_sags_as_theory_says() -> None:
    errors = [float(-still([cantilever(n)], 20, drag=200.0, gravity=9.8)[0, -1, 2]) / SAG - 1 for n in (6, 11)]
    print(errors)


def test_a_column_buckles_above_its_load_only() -> None:
    rods = [column(6, share * buckling_load(6), stretching=1e5) for share in (0.9, 1.1)]
    solver = solver_of(rods, frame_time=0.02, substeps=4)
    x = solver.x.clone()
    v = torch.zeros_like(x)
    v[..., 2] = 1e-3 * torch.sin(np.pi * x[..., 0])
    solver.start(x, v)
    rows = []
    for _ in range(50):
        solver.frame(x, x)
        rows.append(solver.x[..., 2].abs().amax(1).tolist())
    print(np.array(rows)[::5])


def test_a_rod_curls_up_to_its_helix() -> None:
    body = coil(8, (0, 1))
    first = body.vertices[1] - body.vertices[0]
    line = body.vertices[0] + np.arange(8)[:, None] * first
    from dataclasses import replace

    start = replace(body, vertices=line)
    for frames in (10, 20, 40):
        x = still([start], frames, drag=20.0, substeps=10)
        print(frames, (x[0] - real(body.vertices)).abs().max())


def test_twist_makes_a_straight_rod_unstable() -> None:
    rods = [twisted(8, share * 1.0352 * GREENHILL) for share in (0.9, 1.1)]
    solver = solver_of(rods, frame_time=0.02, substeps=4)
    x = solver.x.clone()
    v = torch.zeros_like(x)
    v[..., 2] = 1e-3 * torch.sin(np.pi * x[..., 0])
    solver.start(x, v)
    rows = []
    for _ in range(50):
        solver.frame(x, x)
        rows.append(solver.x[..., 1:].abs().amax((1, 2)).tolist())
    print(np.array(rows)[::5])


@pytest.mark.parametrize("damping", [0.0, 0.02, 0.3])
@pytest.mark.parametrize("twisting", [0.1, 1.0])
def test_the_stiffest_cable_is_stable(damping: float, twisting: float) -> None:
    count = 9
    body = rod(
        crooked(count, bend=0.1),
        (0, 1, 7, 8),
        bending=1.0,
        twisting=twisting,
        stretching=2e4,
        damping=damping,
        curvature=np.random.default_rng(1).normal(0, 0.3, (9, 2)),
        roll=0.5,
    )
    solver = solver_of([body], drag=0.3, gravity=9.8, substeps=5)
    x = solver.x.clone()
    top = 0
    for f in range(100):
        a, b = (x + 0.05 * min(max(np.sin(0.1 * k), -1), 1) * real([0.3, 1, 0.5]) for k in (f, f + 1))
        solver.frame(a, b)
        top = max(top, float(solver.v.abs().max()))
    for _ in range(100):
        solver.frame(b, b)
    print(damping, twisting, top, float(solver.v[:, 2:-2].abs().max()))
