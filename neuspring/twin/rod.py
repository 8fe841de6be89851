"""A twin that is a rod: from observations of a long thin body to its center line, its vertices and the nodes that follow it.

Where the observations give the line (`Observations.line`: markers of a cable), its points are the vertices, and a vertex that is a
controller is held by it. Elsewhere the line is found among the nodes of frame 0 (`center_line`), and springs of controllers pull it
where they pull a lattice.

Only stiffness over mass matters to the motion, as gravity and drag act per mass. A body that is held by its vertices has 1 kg/m.
One that springs pull has 1 kg per node, as a lattice has, so that the searched ranges of springs mean the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from neuspring import config
from neuspring.config.search import VARIABLES
from neuspring.core.artifacts import Observations, Rod, Simulation, Twin
from neuspring.core.errors import InputError
from neuspring.core.geometry import SAME_WORLD, axis_on, heading
from neuspring.physics.center_line import center_line
from neuspring.physics.parameters import homogeneous
from neuspring.physics.rod_nodes import bound, frame_zero, place_on, radius_of, settled
from neuspring.twin.topology import build, controller_reach, controller_springs, infer_controller_radius, node_spacing

MOST_STRETCH = 0.1
"""Relative difference in length of the center lines of two recordings of one body, at most."""


@dataclass(frozen=True, kw_only=True)
class RodStart(config.RodSettings):
    """The settings with the other values that a fit starts from, for a body of 1 kg/m.

    Motion depends on stiffness over mass alone, so a body of another mass per length has as many times the stiffness.
    """

    vertices: int = 24
    """Vertices of a center line that is found among nodes. One that the observations give has its own."""
    bending: float = 0.1
    """EI, N m^2."""
    twisting: float = 0.1
    """GJ, N m^2."""
    stretching: float = 2e4
    """EA, N."""
    damping: float = 0.05
    """Time of inner damping, s."""
    marker_mass: float = 0.03
    """Mass of a marker at each vertex of a center line that the observations give, kg."""
    drag: float = 0.1
    """Linear drag, 1/s."""
    drag_quadratic: float = 0.05
    """Quadratic drag, 1/m."""
    substep: float = 0.005
    """Longest integration step with `simulation.substeps: auto`, s."""


def rod_twin(
    observations: Observations, settings: config.Config, axis: Sequence[float] = (0.0, 1.0, 0.0), steady: float = SAME_WORLD
) -> Twin:
    """The rod that a fit starts from (`settings.rod`), on the body of a recording in frame 0; `axis` [3], `steady`: see `Rod`.

    Springs of controllers and all scalars have the starts of `search.variables`, as a lattice's search does, but the linear drag of
    `rod`. Raises InputError if the body is not long and thin, nothing holds it, or only a camera without depth saw it.
    """
    start, variables, scenario = RodStart(**vars(settings.rod)), settings.search.variables, observations.scenario
    where = f"observations of {scenario.name}"
    if observations.image is not None:
        rule = "a rod is fitted to points that are tracked in space"
        raise InputError(where, rule, "a camera without depth", "Choose a method whose twin is a lattice.")
    nodes, hands, held = observations.nodes, observations.controller_points[0], _line(observations)
    pairs = np.zeros((0, 2), np.int32)
    if held is None:
        vertices = center_line(nodes, start.vertices, where)
        held = np.full(len(vertices), -1, np.int32)
        reach = controller_reach(nodes, hands) + variables.controller_radius.start * node_spacing(nodes)
        reach = variables.controller_radius.start if settings.search.lengths == "meter" else reach
        pairs = controller_springs(nodes, hands, reach, int(variables.controller_neighbors.start))
    else:
        vertices = line_of(observations)
    if not len(pairs) and not (held >= 0).any():
        raise InputError(where, "a hand must hold the rod", "none does", "Raise search.variables.controller_radius.start.")
    lengths = np.linalg.norm(np.diff(vertices, axis=0), axis=1)
    # Of a vertex: half of each of its edges.
    own = np.convolve(lengths, [0.5, 0.5])
    density = len(nodes) / lengths.sum() if len(pairs) else 1.0
    mass = density * own if len(pairs) else own + start.marker_mass
    direction = axis_on(np.array(axis, np.float64), heading(vertices), vertices) if (held >= 0).any() else _across(vertices)
    rod = Rod(
        vertices=vertices,
        held=held,
        lengths=lengths,
        mass=mass,
        bending=np.full(len(vertices), density * start.bending),
        twisting=np.full(len(vertices), density * start.twisting),
        curvature=np.zeros((len(vertices), 2)),
        stretching=density * start.stretching,
        damping=start.damping,
        drag_quadratic=start.drag_quadratic,
        roll=0.0,
        steady=steady,
        line=observations.line,
        axis=direction,
        edge=np.zeros(0, np.int32),
        place=np.zeros((0, 3)),
    )
    if start.rest == "first_frame":
        rod = replace(rod, curvature=frame_zero(rod)[1])
    rod = _bound(rod, observations)
    values = {name: float(getattr(variables, name).start) for name in VARIABLES}
    values |= {"drag": start.drag, "contact_distance": max(radius_of(rod), 0.05 * float(lengths.mean()))}
    frame_time, substeps = 1.0 / scenario.frame_rate, settings.simulation.substeps
    simulation = Simulation(
        frame_time=frame_time,
        substeps=int(np.ceil(frame_time / start.substep)) if substeps == "auto" else substeps,
        up=scenario.up,
        gravity=settings.simulation.gravity,
        ground=scenario.ground,
        obstacles=scenario.obstacles,
        self_collision=scenario.self_collision,
        initial_velocity=settings.simulation.initial_velocity,
    )
    topology = build(nodes, hands, pairs)
    return Twin(topology=topology, material=homogeneous(values, len(pairs)), simulation=simulation, rod=rod)


def on_recording(twin: Twin, observations: Observations) -> Twin:
    """The rod of a twin in frame 0 of another recording of the same body; its simulation is still the twin's.

    Lengths, masses, stiffnesses and unloaded curvatures are kept: they belong to the body. Where the line is found among nodes,
    hands hold within the twin's reach, with springs that are alike and together as strong as the twin's; its first end is the one
    that comes first in x, and the rod is turned about itself as the unloaded curvatures ask. Raises InputError if the
    bodies have other vertices, or another length.
    """
    rod, where = twin.rod, f"transfer to {observations.scenario.name}"
    assert rod is not None
    nodes, hands, held = observations.nodes, observations.controller_points[0], _line(observations)
    if (held is None) != (not (rod.held >= 0).any()) or (held is not None and len(held) != len(rod.held)):
        found = "no line" if held is None else f"{len(held)} vertices"
        rule = f"the recording must have the twin's center line of {len(rod.held)} vertices"
        raise InputError(where, rule, found, "Name a recording of the same body.")
    here = twin.topology
    if held is None and np.array_equal(here.nodes, nodes) and np.array_equal(here.controllers, hands):
        return twin  # as it is
    material = twin.material
    if held is None:
        vertices, held = center_line(nodes, len(rod.held), where), rod.held
        rod = replace(rod, axis=_across(vertices))
        reach, neighbors = infer_controller_radius(twin.topology)
        grown = max(round(neighbors * len(nodes) / len(twin.topology.nodes)), 1)
        pairs = controller_springs(nodes, hands, reach, grown)
        if not len(pairs):
            rule = f"a hand must be within {reach:.3g} m of a node, as the twin's hands are"
            raise InputError(where, rule, "none is", "Check the controllers of frame 0.")
        topology = build(nodes, hands, pairs)
        # The body keeps its mass, so all springs together keep their force per displacement, and their damping.
        stiffness = (material.stiffness / here.rest_lengths).sum() / (1 / topology.rest_lengths).sum()
        dashpot = material.dashpot.sum() / len(pairs)
        material = replace(material, stiffness=np.full(len(pairs), stiffness), dashpot=np.full(len(pairs), dashpot))
    else:
        topology, vertices = build(nodes, hands, here.springs), line_of(observations)
        rod = replace(rod, axis=_axis(twin, vertices))
    found = np.linalg.norm(np.diff(vertices, axis=0), axis=1).sum() / rod.lengths.sum()
    if abs(found - 1) > MOST_STRETCH:
        rule = f"the center line must be as long as the twin's within {MOST_STRETCH:.0%}: {rod.lengths.sum():.3f} m"
        raise InputError(where, rule, f"{found * rod.lengths.sum():.3f} m", "Name a recording of the same body.")
    moved = replace(rod, held=held, line=observations.line, vertices=settled([rod], vertices[None])[0])
    return replace(twin, topology=topology, material=material, rod=_bound(moved, observations))


def _axis(twin: Twin, line: np.ndarray) -> np.ndarray:
    """`Rod.axis` [3] on a recording with the line [V, 3] in frame 0, of a twin whose line is observed."""
    rod, topology = twin.rod, twin.topology
    assert rod is not None
    own = np.concatenate([topology.nodes, topology.controllers])[rod.line].astype(np.float64)
    return axis_on(rod.axis, heading(own), line, rod.steady)


def _across(vertices: np.ndarray) -> np.ndarray:
    """The coordinate axis that lies least along the first edge of a line [V, 3]: a rod that no clamp holds may have any."""
    return np.asarray(np.eye(3)[np.abs(vertices[1] - vertices[0]).argmin()])


def of_markers(twin: Twin, observations: Observations) -> Twin:
    """A twin in frame 0 of a recording whose line is observed, with tracked points as its only nodes, not yet settled or bound."""
    rod, line = twin.rod, observations.line
    assert rod is not None
    hands, nodes = observations.controller_points[0], observations.object_points[0]
    edge = np.zeros(len(nodes), np.int32)
    edge[line[line < len(nodes)]] = np.flatnonzero(line < len(nodes))
    topology = build(nodes, hands, np.zeros((0, 2), np.int32))
    vertices = line_of(observations)
    own = replace(rod, vertices=vertices, axis=_axis(twin, vertices), edge=edge, place=np.zeros((len(nodes), 3)))
    return replace(twin, topology=topology, rod=own)


def _bound(rod: Rod, observations: Observations) -> Rod:
    """The rod with all nodes of a recording; those of an observed line follow the edge behind their vertex."""
    line, nodes = observations.line, observations.nodes
    found = bound(rod, nodes)
    if not line.size:
        return found
    edge, own = found.edge.copy(), line < len(nodes)
    edge[line[own]] = np.minimum(np.flatnonzero(own), len(line) - 2)
    return replace(found, edge=edge, place=place_on(rod.vertices, frame_zero(rod)[0], nodes, edge))


def _line(observations: Observations) -> np.ndarray | None:
    """The controller that holds each vertex of the line [V] that the observations give, -1: none; None: they give no line."""
    if not observations.line.size:
        return None
    return np.asarray(np.maximum(observations.line - len(observations.nodes), -1))


def line_of(observations: Observations) -> np.ndarray:
    """The center line [V, 3] in frame 0 that the observations give, m."""
    points = np.concatenate([observations.nodes, observations.controller_points[0]])
    return np.asarray(points[observations.line].astype(np.float64))
