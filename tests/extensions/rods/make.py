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


def helix(vertices: int, radius: float, rise: float, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] of a helix about z, `turn` rad and `rise` m from each to the next, and the curvatures [V, 2] that it has.

    A joint bends by the angle phi, and the plane of bending turns by psi about the edge from a joint to the next; a frame without
    twist sees kb = 2 tan(phi / 2) turn by psi. Curvatures belong to directors whose m2 is, at joint 1, along kb.
    """
    angles = turn * np.arange(vertices)
    points = np.stack([radius * np.cos(angles), radius * np.sin(angles), rise * np.arange(vertices)], axis=1)
    edges = np.diff(points, axis=0)
    t = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    normals = np.cross(t[:-1], t[1:])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    phi = np.arccos(t[0] @ t[1])
    psi = np.arctan2(np.cross(normals[0], normals[1]) @ t[1], normals[0] @ normals[1])
    around = psi * (np.arange(vertices) - 1)
    return points, 2 * np.tan(phi / 2) * np.stack([np.cos(around), np.sin(around)], axis=1)


def coil(vertices: int, held: Any) -> Rod:
    """A rod at rest in a helix of 5 cm radius."""
    points, curvature = helix(vertices, radius=0.05, rise=0.02, turn=0.7)
    first, second = points[1] - points[0], points[2] - points[1]
    # m2 of edge 0 is along kb, so m1 is along kb x t.
    return rod(points, held, curvature=curvature, axis=np.cross(np.cross(first, second), first))


SAG = 1e-3
"""Of the end of `cantilever` in theory, q L^4 / (8 EI), m."""


def cantilever(vertices: int) -> Rod:
    """A beam of 1 m and 1 kg/m for 9.8 m/s^2. A clamp holds the middle of an edge: there the free length ends."""
    spacing = 1 / (vertices - 1.5)
    bending = 9.8 / (8 * SAG)
    return rod(straight(vertices, spacing * (vertices - 1)), (0, 1), bending=bending, twisting=bending, stretching=1e7)


def column(segments: int, load: float, stretching: float = 1e7) -> Rod:
    """A column of 1 m and EI = 1 N m^2 between two hinges; its length at rest is so much longer that it carries `load`, N."""
    lengths = np.full(segments, 1 / segments / (1 - load / stretching))
    return rod(straight(segments + 1), (0, segments), bending=1.0, twisting=1.0, stretching=stretching, lengths=lengths)


def buckling_load(segments: int) -> float:
    """Of `column`, N: 4 EI / h^2 sin^2(pi / (2 N)) exactly, Euler's pi^2 EI / L^2 for N segments without end."""
    return float(4 * segments**2 * np.sin(np.pi / 2 / segments) ** 2)


GREENHILL = 2 * 4.493409
"""Critical moment of a straight rod with clamped ends, EI / L: 2 x with tan x = x."""


def twisted(segments: int, moment: float, **changes: Any) -> Rod:
    """A straight rod of 1 m and EI = 1 N m^2 between two clamps that twist it with `moment`, N m."""
    points = straight(segments + 2, 1 + 1 / segments)
    values = {"bending": 1.0, "twisting": 2.0, "stretching": 1e4, "roll": moment / 2.0}
    return rod(points, (0, 1, segments, segments + 1), **(values | changes))


def simulation(**changes: Any) -> Simulation:
    """Frames of 10 ms without gravity and ground."""
    return Simulation(**({"frame_time": 0.01, "substeps": 5, "gravity": 0.0, "ground": False} | changes))


def real(values: Any) -> torch.Tensor:
    """A float64 tensor."""
    return torch.tensor(np.asarray(values), dtype=torch.float64)


def stored(solver: RodSolver) -> float:
    """Energy, J, of the joints, branches and edges of one rod in the state of its solver."""
    lanes, state = (
        solver.lanes,
        {name: wp.to_torch(getattr(solver._state, name))[0].numpy() for name in ("k", "theta", "reference", "z")},
    )
    stretch = np.linalg.norm(np.diff(solver.x[0].numpy(), axis=0), axis=1) / lanes.lengths[0] - 1
    joint = np.convolve(lanes.lengths[0], [0.5, 0.5])[1:-1]
    twist = np.diff(state["theta"][:-1]) + state["reference"][1:-1]
    k, ei, gj = state["k"][1:-1], lanes.bending[0, 1:-1] / joint, lanes.twisting[0, 1:-1] / joint
    energy = (ei * ((k - lanes.curvature[0, 1:-1]) ** 2).sum(axis=1) + gj * twist**2).sum() / 2
    energy += (lanes.stretching[0] * stretch**2 * lanes.lengths[0]).sum() / 2
    for branch, (share, _) in enumerate(lanes.slip[0]):
        away = np.column_stack([k, twist]) - state["z"][1:-1, branch]
        twists = gj * away[:, 2] ** 2 if lanes.slip_twist[0] else 0.0
        energy += share * (ei * (away[:, :2] ** 2).sum(axis=1) + twists).sum() / 2
    return float(energy)
