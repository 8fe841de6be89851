"""A twin with a rod: from observations of a long thin object to its center line, its vertices and the nodes that follow it.

- If the observations contain the line (`Observations.line`: markers of a cable), its points are the vertices, and controllers
  among them hold their vertices.
- Otherwise the line is found among the nodes of frame 0 (`center_line`), and springs of controllers pull it, as in a lattice.
- With few observed points, the vertices are at equal distances along the unloaded shape (`rod.lay_out`). Frame 0 is then the
  equilibrium of the rod that hangs from its clamps, and nodes keep their positions on the unloaded line.

Gravity and drag act per mass, so the motion depends only on stiffness over mass. An object held by its vertices has 1 kg/m. An
object pulled by springs has 1 kg per node like a lattice, so that the search ranges of springs mean the same.
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
"""Maximum relative difference in length of the center lines of two recordings of one object."""


@dataclass(frozen=True, kw_only=True)
class RodStart(RodSettings):
    """The settings, and the other initial values of a fit, for an object of 1 kg/m.

    The motion depends only on stiffness over mass, so stiffness is proportional to the mass per length.
    """

    vertices: int = 24
    """Number of vertices of a center line that is found among nodes."""
    bending: float = 0.1
    """EI, N m^2."""
    twisting: float = 0.1
    """GJ, N m^2."""
    stretching: float = 2e4
    """EA, N."""
    damping: float = 0.05
    """Time of inner damping, s."""
    marker_mass: float = 0.03
    """Mass of the marker at each vertex of an observed center line, kg."""
    drag: float = 0.1
    """Linear drag, 1/s."""
    drag_quadratic: float = 0.05
    """Quadratic drag, 1/m."""
    substep: float = 0.005
    """Maximum integration step with `simulation.substeps: auto`, s."""


def rod_twin(observations: Observations, settings: config.Config, axis: Sequence[float] | np.ndarray = (0.0, 1.0, 0.0)) -> Twin:
    """The initial rod of a search (`settings.rod`), on the object of a recording in frame 0; `axis` [3]: see `Rod`.

    Springs of controllers and scalars have the start values of `search.variables`, as for a lattice; the linear drag is that of
    `rod`. Raises InputError if the object is not long and thin, if no controller holds it, or for a camera without depth.
    """
    start, variables, scenario = RodStart(**vars(settings.section(RodSettings))), settings.search.variables, observations.scenario
    where = f"observations of {scenario.name}"
    if observations.image is not None:
        rule = "a rod requires points that are tracked in 3D"
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
        raise InputError(where, "a controller must hold the rod", "none", "Raise search.variables.controller_radius.start.")
    lengths = pieces(vertices)
    # The length of a vertex is half of its edges.
    spans = np.convolve(lengths, [0.5, 0.5])
    density = len(nodes) / lengths.sum() if len(pairs) else 1.0
    laid = start.lay_out is not None and bool(observations.line.size)
    mass = density * spans if len(pairs) or laid else spans + start.marker_mass
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
    """The rod of a twin in frame 0 of another recording of the same object, with the twin's simulation.

    Lengths, masses, stiffness and unloaded curvatures do not change. If the line is found among nodes, controllers hold within
    the twin's reach; their springs are equal and in total as strong as the twin's. The first end is the one that is first in x,
    and the unloaded curvatures determine the rotation of the rod about its line. Raises InputError for other vertices or another
    length.
    """
    rod, where = rod_of(twin), f"transfer to {observations.scenario.name}"
    nodes, hands, held = observations.nodes, observations.controller_points[0], _line(observations)
    known = len(rod.line) or len(rod.held)
    if (held is None) != (not (rod.held >= 0).any()) or (held is not None and len(held) != known):
        found = "no line" if held is None else f"{len(held)} vertices"
        rule = f"the recording must have the twin's center line of {known} vertices"
        raise InputError(where, rule, found, "Choose a recording of the same object.")
    if rod.laid:
        return hung([twin], [observations])[0]
    here = twin.topology
    if held is None and np.array_equal(here.nodes, nodes) and np.array_equal(here.controllers, hands):
        return twin
    material = twin.material
    if held is None:
        vertices, held = center_line(nodes, len(rod.held), where), rod.held
        rod = replace(rod, axis=_across(vertices))
        reach, neighbors = infer_controller_radius(twin.topology)
        grown = max(round(neighbors * len(nodes) / len(twin.topology.nodes)), 1)
        pairs = controller_springs(nodes, hands, reach, grown)
        if not len(pairs):
            rule = f"a controller must be within {reach:.3g} m of a node, like those of the twin"
            raise InputError(where, rule, "none", "Check the controllers of frame 0.")
        topology = build(nodes, hands, pairs)
        # The object keeps its mass, so the springs keep their total force per displacement and their total damping.
        stiffness = (material.stiffness / here.rest_lengths).sum() / (1 / topology.rest_lengths).sum()
        dashpot = material.dashpot.sum() / len(pairs)
        material = replace(material, stiffness=np.full(len(pairs), stiffness), dashpot=np.full(len(pairs), dashpot))
    else:
        topology, vertices = build(nodes, hands, here.springs), line_of(observations)
    ratio = pieces(vertices).sum() / rod.lengths.sum()
    if abs(ratio - 1) > MOST_STRETCH:
        rule = f"the center line must be as long as the twin's within {MOST_STRETCH:.0%}: {rod.lengths.sum():.3f} m"
        raise InputError(where, rule, f"{ratio * rod.lengths.sum():.3f} m", "Choose a recording of the same object.")
    moved = replace(rod, held=held, line=observations.line, vertices=settled([rod], vertices[None])[0])
    return replace(twin, topology=topology, material=material, body=_bound(moved, observations))


def laid_out(observations: Observations, count: int, held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [count, 3], m, at equal distances along the unloaded line, and the controller that sets each; -1: none.

    The line is straight between its points. It ends at the inner controller of a clamp, which is the middle of an edge, or at its
    last point. `held` [M] are the controllers of its points. Raises InputError if the line is unknown or not held.
    """
    where, ends = f"observations of {observations.scenario.name}, line", ((held[:2] >= 0).all(), (held[-2:] >= 0).all())
    if not len(observations.rest_shape):
        remedy = "Set rod.lay_out: null, or add the unloaded shape."
        raise InputError(where, "rod.lay_out requires the unloaded shape", "no rest_shape", remedy)
    if not ends[0] or (held[2:-2] >= 0).any():
        rule = "with rod.lay_out the line must start with two controllers, and may end with two"
        raise InputError(where, rule, f"controllers {held.tolist()}", "Set rod.lay_out: null.")
    points, arc = _unloaded(observations)
    edge = (arc[-1 - ends[1]] - arc[1]) / (count - 1.5 - 0.5 * ends[1])
    at = arc[1] + edge * (np.arange(count) - 0.5)
    controllers = np.full(count, -1, np.int32)
    controllers[:2] = held[:2]
    if ends[1]:
        controllers[-2:] = held[-2:]
    return _along(arc, points, at), controllers


def _unloaded(observations: Observations) -> tuple[np.ndarray, np.ndarray]:
    """Points of the unloaded line [M, 3], m, and their distances along it [M], m."""
    points = observations.canonical[observations.line].astype(np.float64)
    return points, arc_of(pieces(points))


def _along(arc: np.ndarray, points: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Points at distances `at` [n], m, on the polyline through points [M, 3] at distances arc [M], m, extended straight."""
    edge = np.clip(np.searchsorted(arc, at, side="right") - 1, 0, len(arc) - 2)
    fraction = ((at - arc[edge]) / (arc[edge + 1] - arc[edge]))[:, None]
    return np.asarray((1 - fraction) * points[edge] + fraction * points[edge + 1])


def _on_unloaded(rod: Rod, observations: Observations, marker_mass: float) -> Rod:
    """The rod on its unloaded line, with clamps, all nodes, and the masses of markers at the tracked points."""
    unloaded, count = observations.canonical.astype(np.float64), len(observations.nodes)
    held, hand = observations.line[observations.line >= count] - count, observations.controller_hand
    rolls = np.full(2, -1)
    for end, outer in enumerate((held[0], held[-1] if len(held) > 2 else -1)):
        # Other controllers of this hand give the roll.
        others = np.setdiff1d(np.flatnonzero(hand == hand[outer]), held) if hand.size and outer >= 0 else held[:0]
        rolls[end] = others[0] if len(others) else -1
    axis = unloaded[count + rolls[0]] - unloaded[count + held[0]] if rolls[0] >= 0 else rod.axis
    rod = replace(rod, axis=axis, by_angle=1.0)
    rod_with_nodes = replace(bound(rod, unloaded[:count]), curvature=frame_zero(rod)[1])
    tracked = slice(len(observations.object_points[0]))
    mass = rod.mass + marker_shares(rod_with_nodes, tracked.stop) @ np.full(tracked.stop, marker_mass)
    return replace(rod_with_nodes, tilts=np.zeros((2, 2)), rolls=rolls.astype(np.int32), mass=mass)


def marker_shares(rod: Rod, tracked: int) -> np.ndarray:
    """Fraction of the mass of each of the first nodes that each vertex carries [V, tracked]."""
    shares, nodes = np.zeros((len(rod.mass), tracked)), np.arange(tracked)
    shares[rod.edge[:tracked], nodes] = 1 - rod.place[:tracked, 0]
    shares[rod.edge[:tracked] + 1, nodes] += rod.place[:tracked, 0]
    return shares


def of_first(twin: Twin, count: int) -> Twin:
    """A rod with `lay_out`, with only its first nodes."""
    rod, here = rod_of(twin), twin.topology
    body = replace(rod, edge=rod.edge[:count], place=rod.place[:count])
    return replace(twin, topology=build(here.nodes[:count], here.controllers, here.springs), body=body)


def hung(twins: Sequence[Twin], recordings: Sequence[Observations]) -> list[Twin]:
    """Twins with `lay_out`, each at rest in frame 0 of a recording, with the positions of their nodes there.

    A twin may have only the first nodes. Raises NumericalFailure.
    """
    rods = []
    for twin, seen in zip(twins, recordings, strict=True):
        rod = rod_of(twin)
        # The equilibrium is computed from the observed line.
        arc, at = _unloaded(seen)[1], arc_of(rod.lengths) - rod.lengths[0] / 2
        rods.append(replace(rod, vertices=_along(arc - arc[1], line_of(seen), at)))
    hands = np.stack([seen.controller_points[0] for seen in recordings])
    vertices, directors, axes = hanging(rods, hands, twins[0].simulation)
    result = []
    for twin, rod, hand, x, m1, axis in zip(twins, rods, hands, vertices, directors, axes, strict=True):
        lanes = [torch.tensor(values)[None] for values in (x, m1, rod.edge.astype(np.int64), rod.place)]
        topology = build(placed(*lanes)[0].numpy(), hand, twin.topology.springs)
        result.append(replace(twin, topology=topology, body=replace(rod, vertices=x, axis=axis[0])))
    return result


def _across(vertices: np.ndarray) -> np.ndarray:
    """The coordinate axis with the largest angle to the first edge of a line [V, 3]. Without clamps any axis is valid."""
    return np.asarray(np.eye(3)[np.abs(vertices[1] - vertices[0]).argmin()])


def of_markers(twin: Twin, observations: Observations) -> Twin:
    """A twin in frame 0 of a recording with an observed line. Its nodes are the tracked points, not yet settled or bound."""
    rod, line = rod_of(twin), observations.line
    hands, nodes = observations.controller_points[0], observations.object_points[0]
    edge = np.zeros(len(nodes), np.int32)
    edge[line[line < len(nodes)]] = np.flatnonzero(line < len(nodes))
    topology = build(nodes, hands, np.zeros((0, 2), np.int32))
    body = replace(rod, vertices=line_of(observations), edge=edge, place=np.zeros((len(nodes), 3)))
    return replace(twin, topology=topology, body=body)


def _bound(rod: Rod, observations: Observations) -> Rod:
    """The rod with all nodes of a recording; those of an observed line follow the edge behind their vertex."""
    line, nodes = observations.line, observations.nodes
    nearest = bound(rod, nodes)
    if not line.size:
        return nearest
    edge, is_node = nearest.edge.copy(), line < len(nodes)
    edge[line[is_node]] = np.minimum(np.flatnonzero(is_node), len(line) - 2)
    return replace(nearest, edge=edge, place=place_on(rod.vertices, frame_zero(rod)[0], nodes, edge))


def _line(observations: Observations) -> np.ndarray | None:
    """The controller that holds each vertex of the observed line [V], -1 for none; None without an observed line."""
    if not observations.line.size:
        return None
    return np.asarray(np.maximum(observations.line - len(observations.nodes), -1))


def line_of(observations: Observations) -> np.ndarray:
    """The observed center line in frame 0 [V, 3], m."""
    points = np.concatenate([observations.nodes, observations.controller_points[0]])
    return np.asarray(points[observations.line].astype(np.float64))
