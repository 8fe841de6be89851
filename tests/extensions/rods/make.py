"""Rods of the physics tests."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp

from neuspring.core.artifacts import Simulation
from neuspring.extensions.rods.rod import Rod
from neuspring.extensions.rods.solver import RodSolver


def rod(vertices: Any, held: Any = (), *, density: float = 1.0, **changes: Any) -> Rod:
    """A rod through `vertices` [V, 3], by default straight at rest, of 1 kg/m, EI 1e-3, GJ 1e-3 N m^2 and EA 100 N.

    `held` are indices of vertices that are held. Numbers for `bending`, `twisting` mean all joints.
    """
    points = np.asarray(vertices, np.float64)
    count = len(points)
    lengths = np.asarray(changes.pop("lengths", np.linalg.norm(np.diff(points, axis=0), axis=1)))
    mass = density * (np.append(lengths, 0) + np.append(0, lengths)) / 2
    controllers = np.full(count, -1, np.int32)
    controllers[list(held)] = np.arange(len(held))
    values: dict[str, Any] = {
        "bending": 1e-3,
        "twisting": 1e-3,
        "stretching": 100.0,
        "damping": 0.0,
        "drag_quadratic": 0.0,
        "roll": 0.0,
        "axis": np.array([0.0, 0.6, 0.8]),
        "curvature": np.zeros((count, 2)),
        "edge": np.zeros(0, np.int32),
        "place": np.zeros((0, 3)),
        "mass": mass,
    } | changes
    for name in ("bending", "twisting"):
        values[name] = np.broadcast_to(values[name], count).astype(np.float64)
    return Rod(vertices=points, held=controllers, lengths=lengths, **values)


def straight(vertices: int, length: float = 1.0, direction: Any = (1.0, 0.0, 0.0)) -> np.ndarray:
    """Vertices [V, 3] on a line."""
    return np.linspace(0, length, vertices)[:, None] * np.array(direction)


def crooked(vertices: int = 8, spacing: float = 0.05, bend: float = 0.2, seed: int = 0) -> np.ndarray:
    """Vertices [V, 3] on a line with random changes."""
    noise = np.random.default_rng(seed).normal(0, bend * spacing, (vertices, 3))
    return straight(vertices, spacing * (vertices - 1)) + noise


def column(segments: int, load: float, stretching: float = 1e7) -> Rod:
    """A column of 1 m and EI = 1 N m^2 between two hinges; its length at rest is so much longer that it carries `load`, N."""
    lengths = np.full(segments, 1 / segments / (1 - load / stretching))
    return rod(straight(segments + 1), (0, segments), bending=1.0, twisting=1.0, stretching=stretching, lengths=lengths)


def buckling_load(segments: int) -> float:
    """Buckling load of `column`, N: 4 EI / h^2 sin^2(pi / (2 N)) exactly, Euler's pi^2 EI / L^2 for N segments without end."""
    return float(4 * segments**2 * np.sin(np.pi / 2 / segments) ** 2)


GREENHILL = 2 * 4.493409
"""Critical moment of a straight rod with clamped ends, EI / L: 2 x with tan x = x."""


def twisted(segments: int, moment: float, **changes: Any) -> Rod:
    """A straight rod of 1 m and EI = 1 N m^2 between two clamps that twist it with `moment`, N m."""
    points = straight(segments + 2, 1 + 1 / segments)
    values = {"bending": 1.0, "twisting": 2.0, "stretching": 1e4, "roll": moment / 2.0}
    return rod(points, (0, 1, segments, segments + 1), **(values | changes))


LENGTH = 0.5
JAWS = np.array([[-0.05, 0, 0], [0, 0, 0], [-0.05, 0, 0.02]])
"""Outer and inner controller on the line, and the one that says the roll, m in the frame of the hand."""


def clamped(vertices: int, length: float = LENGTH, **changes: Any) -> Rod:
    """A straight rod along x whose first edge a hand with a pose clamps in its middle, at the origin."""
    edge = length / (vertices - 1.5)
    x = edge * (np.arange(vertices) - 0.5)[:, None] * np.array([1.0, 0, 0])
    values = {
        "bending": 0.02,
        "twisting": 0.02,
        "stretching": 1e4,
        "axis": np.array([0, 0, 1.0]),
        "tilts": np.zeros((2, 2)),
        "by_angle": 1.0,
    }
    return rod(x, (0, 1), rolls=np.array([2, -1], np.int32), **(values | changes))


def simulation(**changes: Any) -> Simulation:
    """Frames of 10 ms without gravity and ground."""
    return Simulation(**({"frame_time": 0.01, "substeps": 5, "gravity": 0.0, "ground": False} | changes))


def real(values: Any) -> torch.Tensor:
    """A float64 tensor."""
    return torch.tensor(np.asarray(values), dtype=torch.float64)


def stored(solver: RodSolver) -> float:
    """Energy, J, of the joints, branches and edges of one rod in the state of its solver."""
    (rod,) = solver.rods
    state = {name: wp.to_torch(getattr(solver._state, name))[0].numpy() for name in ("k", "theta", "reference", "z")}
    stretch = np.linalg.norm(np.diff(solver.x[0].numpy(), axis=0), axis=1) / rod.lengths - 1
    joint = np.convolve(rod.lengths, [0.5, 0.5])[1:-1]
    twist = np.diff(state["theta"][:-1]) + state["reference"][1:-1]
    k, ei, gj = state["k"][1:-1], rod.bending[1:-1] / joint, rod.twisting[1:-1] / joint
    energy = (ei * ((k - rod.curvature[1:-1]) ** 2).sum(axis=1) + gj * twist**2).sum() / 2
    energy += (rod.stretching * stretch**2 * rod.lengths).sum() / 2
    for branch, (share, _) in enumerate(rod.slip):
        away = np.column_stack([k, twist]) - state["z"][1:-1, branch]
        twists = gj * away[:, 2] ** 2 if rod.slip_twist else 0.0
        energy += share * (ei * (away[:, :2] ** 2).sum(axis=1) + twists).sum() / 2
    return float(energy)
