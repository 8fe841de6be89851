"""Clamps that move and turn with a hand's pose, and rest under gravity, against rigid motions and the elastica."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_bvp
from scipy.spatial.transform import Rotation

from neuspring.extensions.rods.nodes import Clamps, hanging
from neuspring.extensions.rods.rod import Rod
from neuspring.extensions.rods.solver import RodSolver
from tests.extensions.rods import make


def moved(rod: Rod, turns: Rotation, shifts: np.ndarray, drag: float = 0.0, **changes: object) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [F, V, 3] and m1 [F, E, 3] behind each frame of a hand with rotations [F + 1] and positions [F + 1, 3]."""
    hands = np.stack([turns.apply(jaw) for jaw in make.JAWS], axis=1) + shifts[:, None]
    paths, axes = Clamps.of([rod]).paths(make.real(hands)[:, None])
    solver = RodSolver([rod], [drag], make.simulation(**changes))
    solver.start(make.real(turns[0].apply(np.array(rod.vertices)) + shifts[0])[None], torch.zeros(1, len(rod.mass), 3), axes[0])
    x, m1 = solver.frames(paths, axes)
    return x[:, 0].numpy().copy(), m1[:, 0].numpy().copy()


@pytest.mark.parametrize("jolt", [0.0, 0.05])
def test_turned_and_shifted_paths_of_a_hand_move_the_rod_alike(jolt):
    rod = make.clamped(
        9, damping=0.01, curvature=np.full((9, 2), 0.1), tilts=np.array([[0.1, -0.2], [0, 0]]), clamps=np.full((2, 3), 0.01)
    )
    path = Rotation.from_rotvec(np.linspace(0, 1, 12)[:, None] * [1.0, 0.5, -0.8])
    shifts = jolt * np.sin(np.arange(12))[:, None] * [1, 2, 3]
    turn = Rotation.from_rotvec([0.4, -1.0, 0.7])
    here, there = moved(rod, path, shifts), moved(rod, turn * path, turn.apply(shifts) + 3.0)
    np.testing.assert_allclose(there[0], (turn.apply(here[0].reshape(-1, 3)) + 3.0).reshape(here[0].shape), atol=1e-9)
    np.testing.assert_allclose(there[1], turn.apply(here[1].reshape(-1, 3)).reshape(here[1].shape), atol=1e-9)


def elastica(length: float, bending: float, weight: float) -> np.ndarray:
    """End [2], m, of a cantilever that begins along x: EI theta'' = q (L - s) cos theta, theta below the horizontal."""
    s = np.linspace(0, length, 201)
    found = solve_bvp(
        lambda s, y: np.stack([y[1], -weight * (length - s) * np.cos(y[0]) / bending]),
        lambda a, b: np.array([a[0], b[1]]),
        s,
        np.stack([0.5 * s, np.full_like(s, 0.5)]),
        tol=1e-8,
    )
    theta = found.sol(s)[0]
    return np.array([np.trapezoid(np.cos(theta), s), -np.trapezoid(np.sin(theta), s)])


def test_a_rod_at_rest_is_the_elastica():
    wanted, apart = elastica(make.LENGTH, 0.1, 9.8), []
    for vertices in (9, 17, 33):
        rod = make.clamped(vertices, bending=0.1, stretching=1e6)
        x = hanging([rod], make.JAWS[None], make.simulation(gravity=9.8))[0][0]
        apart.append(np.linalg.norm(x[-1, [0, 2]] - wanted))
    assert wanted[1] < -0.2 * make.LENGTH, "it bends far"
    assert apart[1] < 0.003 * make.LENGTH
    # Second order in the length of an edge.
    assert np.log2(apart[0] / apart[1]) == pytest.approx(2, abs=0.25)
    assert np.log2(apart[1] / apart[2]) == pytest.approx(2, abs=0.25)


def test_a_rod_at_rest_stays_and_lanes_do_not_mix():
    rods = [make.clamped(9, bending=each, curvature=np.full((9, 2), 0.05)) for each in (0.01, 0.05)]
    x, m1, axes = hanging(rods, np.stack([make.JAWS, make.JAWS + 1.0]), make.simulation(gravity=9.8))
    np.testing.assert_allclose(hanging(rods[1:], make.JAWS[None] + 1.0, make.simulation(gravity=9.8))[0][0], x[1], atol=1e-12)
    moved = [replace(rod, vertices=own) for rod, own in zip(rods, x, strict=True)]
    solver = RodSolver(moved, [0, 0], make.simulation(gravity=9.8))
    solver.start(make.real(x), torch.zeros(2, 9, 3), make.real(axes))
    np.testing.assert_array_equal(solver.directors().numpy(), m1)
    later, _ = solver.frames(solver.x.expand(51, -1, -1, -1))
    np.testing.assert_allclose(later[-1].numpy(), x, atol=1e-6)
