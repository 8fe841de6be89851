"""Scenes of the benchmark: boxes of random points, and a folded sheet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neuspring.core.artifacts import Material, Simulation, Topology, Twin
from neuspring.physics import stability
from neuspring.physics.topology import uniform_topology

HANDS = 8
FRAME_TIME = 1 / 30
CASES = {"a": (400, 67, 22), "b": (2000, 667, 31), "c": (2500, 667, 22)}
"""Nodes, substeps, neighbors (including the node itself). The connection radius has no effect."""
SPACING, GAP = 0.005, 0.006
"""Distance between the nodes of a sheet, and between its layers, m."""


def box(nodes: int, substeps: int, neighbors: int, *, self_collision: bool = False) -> tuple[Twin, np.ndarray]:
    """A box of random points just above the ground, held at its top, and the controllers of one frame [2, C, 3]."""
    rng = np.random.default_rng(0)
    edge = 0.01 * nodes ** (1 / 3)
    points = rng.uniform(0, edge, (nodes, 3)) + np.array([0, 0, 0.001])
    hands = rng.uniform(0, edge, (HANDS, 3)) * [1, 1, 0] + [0, 0, edge + 0.005]
    topology = uniform_topology(points, hands, 10 * edge, neighbors, 10 * edge, 20)
    simulation = Simulation(frame_time=FRAME_TIME, substeps=substeps, self_collision=self_collision)
    return stable_twin(topology, simulation, 0.005), np.stack([hands, hands + np.array([0, 0, 0.005])])


def sheet(nodes: int, substeps: int, neighbors: int = 13) -> tuple[Twin, np.ndarray]:
    """A square sheet of about `nodes` nodes, folded once, with self-collision, and the controllers of one frame [2, C, 3].

    Springs and rest lengths are those of the flat sheet. The upper layer is 6 mm above the lower one, within the contact distance
    of 10 mm, and falls onto it. Controllers lift a part of the upper layer's edge.
    """
    columns = int(nodes**0.5)
    rows = nodes // columns
    along, across = np.meshgrid(SPACING * np.arange(columns), SPACING * np.arange(rows), indexing="ij")
    # Less than a tenth of the spacing, so that all distances differ, as in a captured cloth.
    noise = np.random.default_rng(0).uniform(-4e-4, 4e-4, (columns * rows, 2))
    flat = np.column_stack([along.ravel(), across.ravel(), np.zeros(columns * rows)]) + np.pad(noise, ((0, 0), (0, 1)))
    edge = flat[-rows:][:HANDS] + np.array([SPACING, 0, 0])
    topology = uniform_topology(flat, edge, 1.0, neighbors, 0.04, 20)
    middle = SPACING * (columns - 1) / 2
    hands = folded(edge, middle)
    topology = replace(topology, nodes=folded(flat, middle), controllers=hands)
    simulation = Simulation(frame_time=FRAME_TIME, substeps=substeps, self_collision=True)
    return stable_twin(topology, simulation, 0.01), np.stack([hands, hands + np.array([0, 0, 0.005])])


def folded(flat: np.ndarray, middle: float) -> np.ndarray:
    """Points of a flat sheet [N, 3], folded back beyond x = `middle` by a half circle of height GAP."""
    radius = GAP / 2
    past = np.maximum(flat[:, 0] - middle, 0)
    angle = np.minimum(past / radius, np.pi)
    back = np.maximum(past - np.pi * radius, 0)
    x = np.minimum(flat[:, 0], middle) + radius * np.sin(angle) - back
    return np.column_stack([x, flat[:, 1], flat[:, 2] + 0.001 + radius * (1 - np.cos(angle))])


def shortened(twin: Twin, substeps: int) -> Twin:
    """The twin with shorter frames: fewer substeps of the same length."""
    simulation = replace(twin.simulation, frame_time=substeps * twin.simulation.substep, substeps=substeps)
    return replace(twin, simulation=simulation)


def stable_twin(topology: Topology, simulation: Simulation, contact_distance: float) -> Twin:
    """A twin with the largest stiffness that its substep allows, with a margin."""
    scalars = dict.fromkeys(("ground_elasticity", "ground_friction", "contact_elasticity", "contact_friction"), 0.5)
    count = len(topology.springs)
    common = {"drag": 3.0, "contact_distance": contact_distance, **scalars}
    unit = Material(stiffness=topology.rest_lengths, dashpot=np.zeros(count), **common)
    spectrum = stability.twin_spectrum(Twin(topology=topology, material=unit, simulation=simulation))
    stiffness = topology.rest_lengths * min(3e6, 1.0 / (spectrum.stiffness * simulation.substep**2))
    material = Material(stiffness=stiffness, dashpot=np.full(count, 0.5), **common)
    twin = Twin(topology=topology, material=material, simulation=simulation)
    stability.check(twin)
    return twin
