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
from neuspring.physics.parameters import homogeneous
from neuspring.physics.rod_nodes import bind, bound, frame_zero, place_on, radius_of, settled
from neuspring.twin.topology import build, controller_reach, controller_springs, infer_controller_radius, node_spacing

MOST_STRETCH = 0.1
"""Relative difference in length of the center lines of two recordings of one body, at most."""
LEAST_SLENDERNESS = 8.0
"""Length over radius below which a body is no rod: bending would shear it as much."""
BESIDE, MOST_BESIDE = 3.0, 0.1
"""Nodes farther from the line than this times the median lie beside it, and the largest part of them. A cylinder has none: at most
1.4 times the median."""
NEIGHBORS = 12
"""Nearest nodes along which distances on the body are measured."""
MOST_NODES = 3000
"""Of more nodes, evenly chosen ones decide on the line."""
ROUNDS = 4
"""Fits of the line, each with the arc of the one before."""
SAMPLES = 400
"""Points of the smooth line, to which nodes are projected."""
PIECES = 0.15
"""Of the spline per radius of length: one in about seven radii, so that it does not follow the surface."""
PENALTY = 1e-3
"""Of the spline's second differences, where the mean weight of a piece's points is 1."""


@dataclass(frozen=True, kw_only=True)
class RodStart(config.RodSettings):
    """The settings with the other values that a fit starts from, for a body of 1 kg/m."""

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

    @classmethod
    def of(cls, settings: config.RodSettings) -> RodStart:
        """The start that the settings ask for."""
        return cls(**vars(settings))


def rod_twin(observations: Observations, settings: config.Config, axis: Sequence[float] = (0.0, 1.0, 0.0)) -> Twin:
    """The rod that a fit starts from (`settings.rod`), on the body of a recording in frame 0; `axis` [3]: see `Rod`.

    Springs of controllers and all scalars have the starts of `search.variables`, as a lattice's search does, but the linear drag of
    `rod`. Raises InputError if the body is not long and thin, nothing holds it, or only a camera without depth saw it.
    """
    start, variables, scenario = RodStart.of(settings.rod), settings.search.variables, observations.scenario
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
    found = np.linalg.norm(np.diff(vertices, axis=0), axis=1).sum() / rod.lengths.sum()
    if abs(found - 1) > MOST_STRETCH:
        rule = f"the center line must be as long as the twin's within {MOST_STRETCH:.0%}: {rod.lengths.sum():.3f} m"
        raise InputError(where, rule, f"{found * rod.lengths.sum():.3f} m", "Name a recording of the same body.")
    moved = replace(rod, held=held, line=observations.line, vertices=settled([rod], vertices[None])[0])
    return replace(twin, topology=topology, material=material, rod=_bound(moved, observations))


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
    own = replace(rod, vertices=line_of(observations), edge=edge, place=np.zeros((len(nodes), 3)))
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


def center_line(nodes: np.ndarray, count: int, where: str = "observations") -> np.ndarray:
    """Vertices [count, 3], m, at equal distances along a smooth line through a long thin body of nodes [N, 3], m.

    A principal curve: the first arc of a node is its distance along the body from an end (the node farthest from the one that is
    farthest from any). Then cubic splines x(s) are fitted, and each node takes the arc of the nearest point. Does not depend on the
    order of the nodes. Raises InputError, naming `where`, if the body is not long and thin, or has branches.
    """
    points = np.asarray(nodes, np.float64)
    points = points[np.lexsort(points.T)]
    points = points[:: -(-len(points) // MOST_NODES)]
    arc = _from_an_end(points)
    weights, slenderness = np.ones(len(points)), LEAST_SLENDERNESS
    for _ in range(ROUNDS):
        line = _spline(arc, points, weights, int(np.clip(PIECES * slenderness, 2, count // 2)))
        arc, apart = _projected(points, line)
        # What lies far beside the line, as points of a hand, hardly pulls it.
        typical = max(float(np.median(apart)), 1e-9)
        weights = 1 / (1 + (apart / (0.67 * BESIDE * typical)) ** 8)
        length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
        slenderness = min(length / max(float(np.quantile(apart, 0.9)), 1e-9), 1e3)
    beside = float((apart > BESIDE * typical + 1e-3 * length).mean())
    if slenderness < LEAST_SLENDERNESS or beside > MOST_BESIDE:
        rule = f"a rod is long and thin: its nodes lie around one line without branches, at least {LEAST_SLENDERNESS:g} radii long"
        found = f"{slenderness:.1f} radii" if slenderness < LEAST_SLENDERNESS else f"{beside:.0%} of the nodes far beside the line"
        raise InputError(f"{where}, nodes of frame 0", rule, found, "Choose a method whose twin is a lattice.")
    return _equally_spaced(line, arc[apart < BESIDE * typical + 1e-3 * length], count)


def _from_an_end(points: np.ndarray) -> np.ndarray:
    """Distance of each node along the body from one of its ends [N], m; the end that comes first in x, then y, z."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
    from scipy.spatial import cKDTree
    from scipy.spatial.distance import cdist

    near, partner = cKDTree(points).query(points, k=min(NEIGHBORS, len(points)))
    rows = np.repeat(np.arange(len(points)), near.shape[1])
    # The tree joins parts that no near neighbor does.
    tree = minimum_spanning_tree(cdist(points, points)).tocoo()
    both = (np.concatenate([rows, tree.row]), np.concatenate([partner.ravel(), tree.col]))
    lengths, index = np.concatenate([near.ravel(), tree.data]), np.sort(np.stack(both), axis=0)
    _, first = np.unique(index, axis=1, return_index=True)
    shape = (len(points), len(points))
    graph = coo_array((lengths[first], (index[0, first], index[1, first])), shape=shape).tocsr()

    def far(node: int) -> np.ndarray:
        return np.asarray(dijkstra(graph, directed=False, indices=node))

    one = int(far(0).argmax())
    other = int(far(one).argmax())
    return far(min((one, other), key=lambda node: tuple(points[node])))


def _spline(arc: np.ndarray, points: np.ndarray, weights: np.ndarray, pieces: int) -> np.ndarray:
    """Points [SAMPLES, 3] of the cubic spline of equal pieces that is nearest to points [N, 3] with weights [N] at arcs [N].

    Its second differences are penalized a little (a P-spline), which decides where there are no points.
    """
    from scipy.interpolate import BSpline

    low, high = float(arc.min()), float(arc.max())
    knots = np.concatenate([[low] * 3, np.linspace(low, high, pieces + 1), [high] * 3])
    design = BSpline.design_matrix(arc, knots, 3).toarray()
    bends = np.diff(np.eye(design.shape[1]), n=2, axis=0)
    normal = design.T @ (weights[:, None] * design) + PENALTY * weights.sum() / pieces * bends.T @ bends
    coefficients = np.linalg.solve(normal, design.T @ (weights[:, None] * points))
    return np.asarray(BSpline(knots, coefficients, 3)(np.linspace(low, high, SAMPLES)))


def _projected(points: np.ndarray, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Arc of the nearest point of a polyline for each point [N], beyond its ends too, and the distance from there [N], m."""
    ends = 2 * line[[0, -1]] - line[[1, -2]]
    reach = len(line) // 8
    before, after = (line[[k]] + np.arange(1, reach + 1)[:, None] * (end - line[k]) for k, end in ((0, ends[0]), (-1, ends[1])))
    longer = np.concatenate([before[::-1], line, after])
    edge, place = bind(longer, np.zeros((len(longer) - 1, 3)), points)
    lengths = np.linalg.norm(np.diff(longer, axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(lengths)])[edge] + np.clip(place[:, 0], 0, 1) * lengths[edge]
    foot = longer[edge] + np.clip(place[:, :1], 0, 1) * np.diff(longer, axis=0)[edge]
    return arc - lengths[:reach].sum(), np.linalg.norm(points - foot, axis=1)


def _equally_spaced(line: np.ndarray, arc: np.ndarray, count: int) -> np.ndarray:
    """Points [count, 3] at equal arcs of a polyline, from the least to the largest arc of the nodes [N]."""
    own = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(max(arc.min(), 0.0), min(arc.max(), own[-1]), count)
    return np.stack([np.interp(at, own, column) for column in line.T], axis=1)
