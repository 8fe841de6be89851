"""Friction inside a rod: closed forms of a joint, limits, energy, order in steps, and any number of vertices."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from scipy.integrate import solve_bvp

from neuspring.extensions.rods.rod import Rod
from neuspring.extensions.rods.solver import RodSolver
from tests.extensions.rods import make

NONE = np.zeros((0, 2))
BRANCHES = np.array([[1.0, 0.1], [0.7, 1.0], [2.0, 0.02]])
LIVELY = {"curvature": np.random.default_rng(1).normal(0, 0.3, (7, 2)), "roll": 0.5, "stretching": 20.0, "damping": 0.01}


def started(rods: list[Rod], v: Any = 0.0, **changes: Any) -> RodSolver:
    """A solver at frame 0."""
    solver = RodSolver(rods, [0.0] * len(rods), make.simulation(**({"substeps": 1} | changes)))
    x = make.real([body.vertices for body in rods])
    solver.start(x, torch.zeros_like(x) + v)
    return solver


def rolled(body: Rod, hands: np.ndarray, v: Any = 0.0, **changes: Any) -> torch.Tensor:
    """Vertices [V, 3] at the end of the path of controllers, [T, V, 3] or [T, 1, 3] for all, from the present state."""
    solver = started([body], v, **changes)
    for begin, end in pairwise(make.real(hands)[:, None] + solver.x):
        solver.frame(begin, end)
    return solver.x[0].clone()


def state(solver: RodSolver, name: str) -> torch.Tensor:
    return wp.to_torch(getattr(solver._state, name))


def energy(body: Rod, solver: RodSolver) -> float:
    """Kinetic energy and all that joints and edges have stored, those of branches among them, J."""
    mass = make.real(body.mass * (body.held < 0))
    return make.stored(solver) + float((mass * solver.v[0].square().sum(1)).sum() / 2)


def test_a_joint_goes_round_masings_loop_and_turns_as_it_slips():
    most, largest = 1e-3, 4e-3
    body = make.rod(make.straight(3, 2.0), (0, 1, 2), axis=np.array([0.0, 0.0, 1.0]), slip=[[0.5, most]])
    solver = started([body])
    rows = []

    def go(y: float, z: float, steps: int = 1):
        begin = solver.x.clone()
        for part in np.arange(1, steps + 1) / steps:
            end = begin.clone()
            end[0, 2, 1:] += part * (make.real([y, z]) - begin[0, 2, 1:])
            solver.frame(solver.x, end)
            rows.append((solver.curvatures[0, 1].clone(), state(solver, "z")[0, 1, 0, :2].clone()))

    for y in (largest, -largest, largest):
        go(y, 0.0, 40)
    k, z = (torch.stack(values).numpy() for values in zip(*rows, strict=True))
    bent = np.abs(k).argmax(axis=1)[0]
    lost = np.trapezoid((k - z)[39:, bent], k[39:, bent])
    assert lost == pytest.approx(4 * most * (largest - most), rel=1e-4)
    go(largest, 1.5 * most)
    across, e = 1 - bent, rows[-1][0] - rows[-1][1]
    # From a right angle to the way.
    assert float(torch.atan2(e[bent].abs(), e[across].abs())) == pytest.approx(2 * np.arctan(np.exp(-1.5)), rel=1e-4)
    assert float(e.norm()) == pytest.approx(most, rel=1e-9)


def test_what_never_slips_is_a_stiffer_rod_and_what_always_slips_is_none():
    stiff = {"bending": 3e-3, "twisting": 3e-3}
    plain = make.rod(make.crooked(7), (0, 1), **LIVELY | {"damping": 0.0, "curvature": np.zeros((7, 2))})
    # Unloaded in frame 0, as its branches are.
    plain = replace(plain, vertices=make.straight(7, 0.3), lengths=np.full(6, 0.05))
    hands, v = 0.002 * np.arange(20)[:, None, None] * np.array([0.3, 1, 0.5]), make.real([0.2, -0.1, 0.3])

    def end(share: float, most: float, twist: float = 1.0, **changes: Any) -> torch.Tensor:
        slip = np.array([[share, most]]) if share else NONE
        return rolled(replace(plain, slip=slip, slip_twist=twist, **changes), hands, v, gravity=9.8, substeps=5)

    both = {name: np.full(7, value) for name, value in stiff.items()}
    assert torch.allclose(end(2.0, 1e6), end(0.0, 0.0, **both), atol=1e-12, rtol=0)
    assert torch.allclose(end(2.0, 1e6, 0.0), end(0.0, 0.0, bending=both["bending"]), atol=1e-12, rtol=0)
    assert torch.equal(end(2.0, 0.0), end(0.0, 0.0))
    assert float((end(2.0, 0.3) - end(0.0, 0.0)).abs().max()) > 1e-3


@pytest.mark.parametrize("branches", [BRANCHES, np.array([[3.0, 0.05]])])
def test_energy_never_grows_even_where_modes_are_fast_for_a_substep(branches):
    """A foam of 1.9 m, EI / m = 10 m^4/s^2, with 33 vertices: its fastest mode turns by 28 rad per substep of 8 ms."""
    count, length = 33, 1.9
    spacing = length / (count - 1.5)
    options: dict[str, Any] = {"bending": 10.0, "twisting": 3.0, "stretching": 1e5, "slip": branches, "slip_twist": 0.5}
    body = make.rod(make.straight(count, spacing * (count - 1)), (0, 1), **options)
    shape = np.clip((np.arange(count) - 0.5) * spacing, 0, None) ** 2 / length**2
    zigzag = shape * np.cos(2 * np.arange(count))
    solver = started([body], make.real(np.outer(shape, [0, 2.0, 1.2]) + np.outer(zigzag, [0, 0.3, -0.3])), frame_time=0.008)
    energies = []
    for _ in range(200):
        solver.frame(solver.x, solver.x)
        energies.append(energy(body, solver))
    assert np.diff(energies)[2:].max() < 1e-12 * energies[0]
    assert energies[-1] < 0.6 * energies[0]


def beam(vertices: int, bending: float, **changes: Any) -> Rod:
    """A beam of 1 m and 1 kg/m. A clamp holds the middle of its first edge."""
    spacing = 1 / (vertices - 1.5)
    points = make.straight(vertices, spacing * (vertices - 1)) - [spacing / 2, 0, 0]
    return make.rod(points, (0, 1), bending=bending, twisting=bending, stretching=1e5, **changes)


# What the end of the bent beam is off, of its length, times squared edges: angles are better than 2 tan of their half.
@pytest.mark.parametrize(("by_angle", "off"), [(0.0, 0.58), (1.0, 0.29)])
@pytest.mark.parametrize("vertices", [9, 17])
def test_a_beam_is_the_elastica_and_swings_as_theory_says_with_any_number_of_vertices(vertices, by_angle, off):
    load = 5.0
    solver = started([beam(vertices, 1 / load, damping=0.5, by_angle=by_angle)], frame_time=0.2, gravity=1.0)
    for _ in range(300):
        solver.frame(solver.x, solver.x)
    arc = np.linspace(0, 1, 50)
    theory = solve_bvp(
        lambda s, y: [y[1], load * (s - 1) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])],
        lambda a, b: [a[0], b[1], a[2], a[3]],
        arc,
        np.zeros((4, 50)),
    )
    assert np.linalg.norm(solver.x[0, -1, [0, 2]].numpy() - [theory.y[2, -1], -theory.y[3, -1]]) < off / (vertices - 1.5) ** 2
    # The first mode, 1.8751^2 (EI / m L^4)^(1/2).
    wave = 1.8751041
    at = np.clip(beam(vertices, 1.0).vertices[:, 0], 0, None) * wave
    ratio = (np.cosh(wave) + np.cos(wave)) / (np.sinh(wave) + np.sin(wave))
    mode = np.cosh(at) - np.cos(at) - ratio * (np.sinh(at) - np.sin(at))
    solver = started([beam(vertices, 1.0, by_angle=by_angle)], make.real(np.outer(mode, [0, 0.005, 0])), frame_time=0.002)
    rows = []
    for _ in range(1000):
        solver.frame(solver.x, solver.x)
        rows.append(float(solver.x[0, -1, 1]))
    x = np.array(rows)
    crossings = np.flatnonzero(np.diff(np.sign(x)))
    times = 0.002 * (crossings + x[crossings] / (x[crossings] - x[crossings + 1]))
    assert np.pi / np.diff(times).mean() / wave**2 == pytest.approx(1, abs=0.22 / (vertices - 1.5) ** 2)
