"""A twin that is a rod: from observations of a long thin body to its center line, its vertices and the nodes that follow it.

Where the observations give the line (`Observations.line`: markers of a cable), its points are the vertices, and a vertex that is a
controller is held by it. Elsewhere the line is found among the nodes of frame 0 (`center_line`), and springs of controllers pull it
where they pull a lattice.

Where few places of the line are seen, vertices are laid along its unloaded shape (`rod.lay_out`), and frame 0 is the equilibrium of
what hangs from the clamps. Nodes keep their places on the unloaded line.

Only stiffness over mass matters to the motion, as gravity and drag act per mass. A body that is held by its vertices has 1 kg/m.
One that springs pull has 1 kg per node, as a lattice has, so that the searched ranges of springs mean the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from neuspring import config
from neuspring.config.search import VARIABLES
from neuspring.core.artifacts import Observations, Simulation, Twin
from neuspring.core.errors import InputError
from neuspring.extensions.rods.center_line import center_line
from neuspring.extensions.rods.nodes import bound, frame_zero, hanging, place_on, placed, radius_of, settled
from neuspring.extensions.rods.rod import Rod, arc_of, pieces, rod_of
from neuspring.extensions.rods.settings import RodSettings
from neuspring.physics.parameters import homogeneous
from neuspring.physics.topology import build, controller_reach, controller_springs, infer_controller_radius, node_spacing

MOST_STRETCH = 0.1
"""Relative difference in length of the center lines of two recordings of one body, at most."""


@dataclass(frozen=True, kw_only=True)
class RodStart(RodSettings):
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


def rod_twin(observations: Observations, settings: config.Config, axis: Sequence[float] | np.ndarray = (0.0, 1.0, 0.0)) -> Twin:
    """The rod that a fit starts from (`settings.rod`), on the body of a recording in frame 0; `axis` [3]: see `Rod`.

    Springs of controllers and all scalars have the starts of `search.variables`, as a lattice's search does, but the linear drag of
    `rod`. Raises InputError if the body is not long and thin, nothing holds it, or only a camera without depth saw it.
    """
    start, variables, scenario = RodStart(**vars(settings.section(RodSettings))), settings.search.variables, observations.scenario
    where = f"observations of {scenario.name}"
    if observations.image is not None:
        rule = "a rod is fitted to points that are tracked in space"
        raise InputError(where, rule, "a camera without depth", "Choose a method whose twin is a lattice.")
    nodes, hands, held = observations.nodes, observations.controller_points[0], _line(observations)
    pairs = np.zeros((0, 2), np.int32)
    if held is None:
        vertices = center_line(nodes, start.vertices, where)
        held = np.full(len(vertices), -1, np.int32)
        reach = variables.controller_radius.start
        if settings.search.lengths != "meter":
            reach = controller_reach(nodes, hands) + reach * node_spacing(nodes)
        pairs = controller_springs(nodes, hands, reach, int(variables.controller_neighbors.start))
    else:
        vertices = line_of(observations)
        if start.lay_out is not None:
            vertices, held = laid_out(observations, start.lay_out, held)
    if not len(pairs) and not (held >= 0).any():
        raise InputError(where, "a hand must hold the rod", "none does", "Raise search.variables.controller_radius.start.")
    lengths = pieces(vertices)
    # Of a vertex: half of each of its edges.
    own = np.convolve(lengths, [0.5, 0.5])
    density = len(nodes) / lengths.sum() if len(pairs) else 1.0
    laid = start.lay_out is not None and bool(observations.line.size)
    mass = density * own if len(pairs) or laid else own + start.marker_mass
    direction = np.array(axis, np.float64) if (held >= 0).any() else _across(vertices)
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
        line=observations.line,
        axis=direction,
        edge=np.zeros(0, np.int32),
        place=np.zeros((0, 3)),
    )
    if laid:
        rod = _on_unloaded(rod, observations, start.marker_mass)
    elif start.rest == "first_frame":
        rod = replace(rod, curvature=frame_zero(rod)[1])
    rod = rod if laid else _bound(rod, observations)
    values = {name: float(getattr(variables, name).start) for name in VARIABLES}
    values |= {"drag": start.drag, "contact_distance": max(radius_of(rod), 0.05 * float(lengths.mean()))}
    frame_time, substeps = 1.0 / scenario.frame_rate, settings.simulation.substeps
    simulation = Simulation(
        frame_time=frame_time,
        substeps=int(np.ceil(frame_time / start.substep)) if substeps == "auto" else substeps,
        up=scenario.up,
        gravity=settings.simulation.gravity,
        ground=scenario.ground,
        self_collision=scenario.self_collision,
        initial_velocity=settings.simulation.initial_velocity,
    )
    topology = build(nodes, hands, pairs)
    twin = Twin(topology=topology, material=homogeneous(values, len(pairs)), simulation=simulation, body=rod)
    return hung([twin], [observations])[0] if laid else twin


def on_recording(twin: Twin, observations: Observations) -> Twin:
    """The rod of a twin in frame 0 of another recording of the same body; its simulation is still the twin's.

    Lengths, masses, stiffnesses and unloaded curvatures are kept: they belong to the body. Where the line is found among nodes,
    hands hold within the twin's reach, with springs that are alike and together as strong as the twin's; its first end is the one
    that comes first in x, and the rod is turned about itself as the unloaded curvatures ask. Raises InputError if the
    bodies have other vertices, or another length.
    """
    rod, where = rod_of(twin), f"transfer to {observations.scenario.name}"
    nodes, hands, held = observations.nodes, observations.controller_points[0], _line(observations)
    known = len(rod.line) or len(rod.held)
    if (held is None) != (not (rod.held >= 0).any()) or (held is not None and len(held) != known):
        found = "no line" if held is None else f"{len(held)} vertices"
        rule = f"the recording must have the twin's center line of {known} vertices"
        raise InputError(where, rule, found, "Name a recording of the same body.")
    if rod.laid:
        return hung([twin], [observations])[0]
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
    found = pieces(vertices).sum() / rod.lengths.sum()
    if abs(found - 1) > MOST_STRETCH:
        rule = f"the center line must be as long as the twin's within {MOST_STRETCH:.0%}: {rod.lengths.sum():.3f} m"
        raise InputError(where, rule, f"{found * rod.lengths.sum():.3f} m", "Name a recording of the same body.")
    moved = replace(rod, held=held, line=observations.line, vertices=settled([rod], vertices[None])[0])
    return replace(twin, topology=topology, material=material, body=_bound(moved, observations))


def laid_out(observations: Observations, count: int, held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unloaded vertices [count, 3], m, evenly along the unloaded line, and the controller that sets each; -1: none.

    The line runs straight from each of its places to the next. It ends at the inner controller of a clamp, which is the middle of
    an edge, or at its last place. `held` [M] are the controllers of its places. Raises InputError where it is not known
    or not held.
    """
    where, ends = f"observations of {observations.scenario.name}, line", ((held[:2] >= 0).all(), (held[-2:] >= 0).all())
    if not len(observations.rest_shape):
        remedy = "Leave rod.lay_out null, or add the unloaded shape."
        raise InputError(where, "with rod.lay_out the unloaded shape must be known", "no rest_shape", remedy)
    if not ends[0] or (held[2:-2] >= 0).any():
        rule = "with rod.lay_out the line begins with two controllers, and may end with two"
        raise InputError(where, rule, f"controllers {held.tolist()}", "Leave rod.lay_out null.")
    places, arc = _unloaded(observations)
    edge = (arc[-1 - ends[1]] - arc[1]) / (count - 1.5 - 0.5 * ends[1])
    at = arc[1] + edge * (np.arange(count) - 0.5)
    controllers = np.full(count, -1, np.int32)
    controllers[:2] = held[:2]
    if ends[1]:
        controllers[-2:] = held[-2:]
    return _along(arc, places, at), controllers


def _unloaded(observations: Observations) -> tuple[np.ndarray, np.ndarray]:
    """Places of the line [M, 3], m, without load, and their distances along it [M], m."""
    places = observations.canonical[observations.line].astype(np.float64)
    return places, arc_of(pieces(places))


def _along(arc: np.ndarray, places: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Points at distances `at` [n], m, on the polyline through places [M, 3] at distances arc [M], m, and on straight beyond it."""
    edge = np.clip(np.searchsorted(arc, at, side="right") - 1, 0, len(arc) - 2)
    part = ((at - arc[edge]) / (arc[edge + 1] - arc[edge]))[:, None]
    return np.asarray((1 - part) * places[edge] + part * places[edge + 1])


def _on_unloaded(rod: Rod, observations: Observations, marker_mass: float) -> Rod:
    """A rod that lies as it was laid out, with clamps, the places of all nodes, and masses at those of the tracked points."""
    unloaded, count = observations.canonical.astype(np.float64), len(observations.nodes)
    held, hand = observations.line[observations.line >= count] - count, observations.controller_hand
    rolls = np.full(2, -1)
    for end, outer in enumerate((held[0], held[-1] if len(held) > 2 else -1)):
        # Others of that hand have a direction too.
        others = np.setdiff1d(np.flatnonzero(hand == hand[outer]), held) if hand.size and outer >= 0 else held[:0]
        rolls[end] = others[0] if len(others) else -1
    axis = unloaded[count + rolls[0]] - unloaded[count + held[0]] if rolls[0] >= 0 else rod.axis
    rod = replace(rod, axis=axis, by_angle=1.0)
    found = replace(bound(rod, unloaded[:count]), curvature=frame_zero(rod)[1])
    tracked = slice(len(observations.object_points[0]))
    mass = rod.mass + marker_shares(found, tracked.stop) @ np.full(tracked.stop, marker_mass)
    return replace(found, tilts=np.zeros((2, 2)), rolls=rolls.astype(np.int32), mass=mass)


def marker_shares(rod: Rod, tracked: int) -> np.ndarray:
    """The part of the mass of each of the first nodes that each vertex carries [V, tracked]."""
    shares, nodes = np.zeros((len(rod.mass), tracked)), np.arange(tracked)
    shares[rod.edge[:tracked], nodes] = 1 - rod.place[:tracked, 0]
    shares[rod.edge[:tracked] + 1, nodes] += rod.place[:tracked, 0]
    return shares


def of_first(twin: Twin, count: int) -> Twin:
    """A rod that was laid out, with its first nodes alone."""
    rod, here = rod_of(twin), twin.topology
    own = replace(rod, edge=rod.edge[:count], place=rod.place[:count])
    return replace(twin, topology=build(here.nodes[:count], here.controllers, here.springs), body=own)


def hung(twins: Sequence[Twin], recordings: Sequence[Observations]) -> list[Twin]:
    """Twins whose vertices were laid out, each in frame 0 of a recording: at rest, with the nodes where they are then.

    A twin may have the first nodes alone. Raises NumericalFailure.
    """
    rods = []
    for twin, seen in zip(twins, recordings, strict=True):
        rod = rod_of(twin)
        # Rest is sought from the line that was seen.
        arc, at = _unloaded(seen)[1], arc_of(rod.lengths) - rod.lengths[0] / 2
        rods.append(replace(rod, vertices=_along(arc - arc[1], line_of(seen), at)))
    hands = np.stack([seen.controller_points[0] for seen in recordings])
    vertices, directors, axes = hanging(rods, hands, twins[0].simulation)
    done = []
    for twin, rod, hand, x, m1, axis in zip(twins, rods, hands, vertices, directors, axes, strict=True):
        lanes = [torch.tensor(values)[None] for values in (x, m1, rod.edge.astype(np.int64), rod.place)]
        topology = build(placed(*lanes)[0].numpy(), hand, twin.topology.springs)
        done.append(replace(twin, topology=topology, body=replace(rod, vertices=x, axis=axis[0])))
    return done


def _across(vertices: np.ndarray) -> np.ndarray:
    """The coordinate axis that lies least along the first edge of a line [V, 3]: a rod that no clamp holds may have any."""
    return np.asarray(np.eye(3)[np.abs(vertices[1] - vertices[0]).argmin()])


def of_markers(twin: Twin, observations: Observations) -> Twin:
    """A twin in frame 0 of a recording whose line is observed, with tracked points as its only nodes, not yet settled or bound."""
    rod, line = rod_of(twin), observations.line
    hands, nodes = observations.controller_points[0], observations.object_points[0]
    edge = np.zeros(len(nodes), np.int32)
    edge[line[line < len(nodes)]] = np.flatnonzero(line < len(nodes))
    topology = build(nodes, hands, np.zeros((0, 2), np.int32))
    own = replace(rod, vertices=line_of(observations), edge=edge, place=np.zeros((len(nodes), 3)))
    return replace(twin, topology=topology, body=own)


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
