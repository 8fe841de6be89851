"""Nodes that follow the center line of a rod, and a rod with the calls of a `FrameSolver`: nodes in, nodes out.

A node on edge j between vertices x_j and x_(j+1) is at

    x = x_j + f (x_(j+1) - x_j) + a m1 + b m2,    m2 = t x m1,

with (f, a, b) the place of `Rod.place`. f may lie outside [0, 1]: beyond an end, or in the outer wedge of a bend. A force on the
node acts on the two vertices by 1 - f and f.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch

from neuspring.core.artifacts import Rod, Simulation, Twin
from neuspring.core.errors import InputError
from neuspring.core.geometry import PARALLEL
from neuspring.physics.controllers import ControllerSprings, begins
from neuspring.physics.parameters import CONTACT_LIMITS
from neuspring.physics.rod import RodHands, RodLanes, RodSolver

SMOOTHING_WEIGHT = 1e-6
"""Weight of second differences along the vertices against nodes: decides where no node is."""
SETTLING = 4
"""Rounds in which vertices and directors of frame 0 are made to agree."""
GROUND_FIELDS = ("ground_elasticity", "ground_friction")


def bind(vertices: np.ndarray, directors: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest edge [N] of each node [N, 3], m, and its place (f, a, b) [N, 3]; vertices [V, 3], m, and m1 of edges [E, 3]."""
    x, points = np.asarray(vertices, np.float64), np.asarray(nodes, np.float64)
    along = np.diff(x, axis=0)
    offset = points[:, None] - x[:-1]
    fraction = (offset * along).sum(axis=2) / (along**2).sum(axis=1)
    apart = np.linalg.norm(offset - np.clip(fraction, 0, 1)[..., None] * along, axis=2)
    edge = apart.argmin(axis=1)
    return edge.astype(np.int32), place_on(x, directors, nodes, edge)


def bound(rod: Rod, nodes: np.ndarray) -> Rod:
    """The rod with nodes [N, 3], m, bound to its center line in frame 0. Raises InputError if `axis` lies along a clamp."""
    edge, place = bind(rod.vertices, frame_zero(rod)[0], nodes)
    return replace(rod, edge=edge, place=place)


def frame_zero(rod: Rod) -> tuple[np.ndarray, np.ndarray]:
    """Directors m1 of edges [E, 3] and curvatures k1, k2 of joints [V, 2], 1, in frame 0."""
    require_axis(rod)
    solver = RodSolver(RodLanes.of([rod], [0.0]), Simulation(frame_time=1.0, substeps=1))
    solver.start(torch.tensor(rod.vertices)[None], torch.zeros((1, *rod.vertices.shape), dtype=torch.float64))
    return solver.directors()[0].numpy().copy(), solver.curvatures[0].numpy().copy()


def clamped(points: torch.Tensor, clamps: torch.Tensor, axis: torch.Tensor, ends: Sequence[bool]) -> torch.Tensor:
    """Held vertices [B, V, 3], m, of clamps whose controllers are at points [B, V, 3]; other rows stay. See `Rod.clamps` [B, 2, 3].

    `ends`: whether the first and the last two vertices are held. `axis` [B, 3].
    """
    result = points.clone()
    for end, (inner, outer) in enumerate(((1, 0), (-2, -1))):
        if not ends[end]:
            continue
        along = (points[:, inner] - points[:, outer]) * (1 - 2 * end)
        length = along.norm(dim=-1, keepdim=True)
        t = along / length
        m1 = axis - (axis * t).sum(dim=-1, keepdim=True) * t
        m1 = m1 / m1.norm(dim=-1, keepdim=True)
        local = torch.stack([t, m1, torch.linalg.cross(t, m1)], dim=1)
        result[:, inner] = points[:, inner] + (clamps[:, end, :, None] * local).sum(dim=1)
        result[:, outer] = result[:, inner] - (1 - 2 * end) * along
    return result


def settled(rods: Sequence[Rod], lines: np.ndarray) -> np.ndarray:
    """Vertices [B, V, 3], m, in frame 0 of rods with observed lines [B, V, 3]: beside them, as `offsets` and `clamps` say."""
    points = torch.tensor(np.asarray(lines, np.float64))
    if not rods[0].offsets.size:
        return points.numpy()
    free = rods[0].held < 0
    clamps, axis = (torch.tensor(np.stack([getattr(rod, name) for rod in rods])) for name in ("clamps", "axis"))
    offsets = torch.tensor(np.stack([rod.offsets for rod in rods]))[:, free]
    solver = RodSolver(RodLanes.of(rods, [0.0] * len(rods)), Simulation(frame_time=1.0, substeps=1))
    x = clamped(points, clamps, axis, _ends(rods[0]))
    edges = np.minimum(np.flatnonzero(free), len(free) - 2)
    for _ in range(SETTLING):
        solver.start(x, torch.zeros_like(x))
        m1 = solver.directors()[:, edges]
        along = x[:, edges + 1] - x[:, edges]
        m2 = torch.linalg.cross(along / along.norm(dim=-1, keepdim=True), m1)
        x[:, free] = points[:, free] - offsets[..., :1] * m1 - offsets[..., 1:] * m2
    return x.numpy()


def _ends(rod: Rod) -> tuple[bool, bool]:
    """True for each end that is clamped."""
    held = rod.held >= 0
    return bool(held[:2].all()), bool(held[-2:].all())


def turn_of(line: np.ndarray, axis: np.ndarray) -> float:
    """Angle about the last tangent of a line [V, 3] from `axis`, projected at the first edge and carried along, to `axis` there."""
    tangents = np.diff(line, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    first, last = (axis - (axis @ t) * t for t in tangents[[0, -1]])
    for before, after in pairwise(tangents):
        first = first - (after @ first) / (1 + before @ after) * (before + after)
    return float(np.arctan2(np.cross(first, last) @ tangents[-1], first @ last))


def place_on(vertices: np.ndarray, directors: np.ndarray, nodes: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """The place (f, a, b) [N, 3] of nodes [N, 3], m, on edges [N]. Inverse of `placed`."""
    x, m1 = np.asarray(vertices, np.float64), np.asarray(directors, np.float64)[edge]
    along = np.diff(x, axis=0)[edge]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    offset, tangent = np.asarray(nodes, np.float64) - x[edge], along / length
    coordinates = [(offset * axis).sum(axis=1) for axis in (along / length**2, m1, np.cross(tangent, m1))]
    return np.stack(coordinates, axis=1)


def placed(vertices: torch.Tensor, directors: torch.Tensor, edge: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """Nodes [B, N, 3], m, at places [B, N, 3] on edges [B, N]; vertices [B, V, 3], m, and m1 of edges [B, E, 3]."""
    begin, m1 = of_edges(vertices, edge), of_edges(directors, edge)
    along = of_edges(vertices, edge + 1) - begin
    m2 = torch.linalg.cross(along / along.norm(dim=-1, keepdim=True), m1)
    f, a, b = place.split(1, dim=-1)
    found: torch.Tensor = begin + f * along + a * m1 + b * m2
    return found


def of_edges(values: torch.Tensor, edge: torch.Tensor) -> torch.Tensor:
    """Rows [B, N, 3] of values [B, E, 3] at indices [B, N]."""
    return values.gather(1, edge[..., None].expand(-1, -1, 3))


def at_vertices(rod: Rod, values: np.ndarray, held: np.ndarray | None = None) -> np.ndarray:
    """Values [..., V, 3] at vertices whose interpolation along the edges is nearest to values [..., N, 3] of the nodes.

    With values `held` [..., C, 3] of controllers, those vertices that are held have theirs. Offsets of nodes from the line are left
    out, so that of positions it is exact where nodes are vertices, and else as good as they lie evenly around the line.
    """
    count, nodes = len(rod.vertices), np.arange(len(rod.edge))
    weights = np.zeros((len(nodes), count))
    weights[nodes, rod.edge], weights[nodes, rod.edge + 1] = 1 - rod.place[:, 0], rod.place[:, 0]
    known = rod.held >= 0 if held is not None else np.zeros(count, bool)
    # Where no node is, neighbors decide: of positions, their second differences.
    rows = np.concatenate([weights, SMOOTHING_WEIGHT * np.diff(np.eye(count), n=2, axis=0)])
    given = np.asarray(values, np.float64)
    result = np.zeros((*given.shape[:-2], count, 3))
    if held is not None:
        result[..., known, :] = held[..., rod.held[known], :]
    right = np.concatenate([given, np.zeros((*given.shape[:-2], count - 2, 3))], axis=-2) - rows @ result
    result[..., ~known, :] = np.linalg.pinv(rows[:, ~known]) @ right
    return result


def radius_of(rod: Rod) -> float:
    """Radius of a rod, m: the 0.9 quantile of the nodes' distances from the center line."""
    return float(np.quantile(np.linalg.norm(rod.place[:, 1:], axis=1), 0.9))


class RodFrames:
    """The rods of twins with the same hands, with the calls of `FrameSolver` that rollouts make. Their state is that of the rods.

    A sequence of twins makes rods of as many vertices in lanes; then every tensor has a leading axis [B].
    """

    dtype = torch.float32
    collision_overflow = 0

    def __init__(self, twins: Twin | Sequence[Twin], device: str = "cpu") -> None:
        self.together = not isinstance(twins, Twin)
        every = [twins] if isinstance(twins, Twin) else list(twins)
        self.rods, self.device = [_rod(twin) for twin in every], device
        first, simulation = every[0].topology, every[0].simulation
        self.grips = ControllerSprings(first.springs, len(first.nodes), device)
        self._nodes = np.stack([twin.topology.nodes for twin in every])
        self._packed = self._tensor([_packed(twin) for twin in every])
        hands = self._hands(every)
        drags = [twin.material.drag for twin in every]
        self.solver = RodSolver(RodLanes.of(self.rods, drags), simulation, device, hands)
        held, edge = (np.stack([getattr(rod, name) for rod in self.rods]) for name in ("held", "edge"))
        self._held, self._edge = (torch.tensor(np.maximum(a, 0), dtype=torch.long, device=device) for a in (held, edge))
        self._place = self._tensor([rod.place for rod in self.rods])
        beside = bool(self.rods[0].offsets.size)
        self._clamps = [self._tensor([getattr(rod, name) for rod in self.rods]) for name in ("clamps", "axis")] if beside else None
        self._x: torch.Tensor | None = None
        self._lengths: torch.Tensor | None = None
        """Rest lengths of grips that began since the start [B, S]."""

    def forward(
        self, x: torch.Tensor, v: torch.Tensor, begin: torch.Tensor, end: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """As `FrameSolver.forward`: (x, v) [N, 3] one frame later; controllers move from begin to end [C, 3 or 4].

        It goes on from what it returned last, and begins anew where x is frame 0. Raises InputError for other states: nodes do not
        say how a rod is twisted.
        """
        if x is not self._x:
            self._start(x, v)
        begin, end = (points if self.together else points[None] for points in (begin, end))
        ends = [points[..., :3].to(self.device, torch.float64) for points in (begin, end)]
        self.solver.pull(self._law(begin, end), *ends)
        paths = [of_edges(points, self._held) for points in ends]
        if self._clamps:
            clamps, axis = self._clamps
            paths = [clamped(path, clamps, axis, _ends(self.rods[0])) for path in paths]
        self.solver.frame(*paths)
        return self._state()

    def resume(self, rows: torch.Tensor, positions: Sequence[np.ndarray]) -> None:
        """As `FrameSolver.resume`, of one twin."""
        known = torch.nonzero(begins(rows).any(dim=-1)).flatten().tolist()
        states = [self._tensor([positions[number]]) for number in known]
        self._lengths = self.grips.taken_before([rows[number][None].double() for number in known], states)

    def follow(self, other: RodFrames) -> None:
        """Take the state of another solver of the same rods, whose springs may be others."""
        self.solver.follow(other.solver)
        self._place, self._x = other._place, other._x
        self._bind()

    def _hands(self, twins: Sequence[Twin]) -> RodHands:
        """Springs of controllers, and the height at which vertices touch the ground: the radius, or less where they begin lower."""
        up = twins[0].simulation.up_sign
        heights = [np.minimum(radius_of(rod), np.maximum(up * rod.vertices[:, 2], 0.0)) for rod in self.rods]
        leaders = np.tile(self.grips.leaders.cpu().numpy(), (len(twins), 1))
        surface = [[np.clip(getattr(twin.material, name), *CONTACT_LIMITS[name]) for twin in twins] for name in GROUND_FIELDS]
        return RodHands(
            len(twins[0].topology.controllers), leaders, np.stack(heights), *(np.array(values, np.float64) for values in surface)
        )

    def _law(self, begin: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
        """Stiffness, N/m, rest length, m, and dashpot, N s/m, of the springs of hands [B, S, 3] in a frame (controllers.py)."""
        if begin.shape[-1] == 4:
            self._lengths = self.grips.taken(self._lengths, self.nodes()[0], begin.to(self.device, torch.float64))
        y, inverse, dashpot = self.grips.applied(self._packed, self._lengths).unbind(dim=-1)
        acts = torch.ones_like(y)
        if begin.shape[-1] == 4:
            acts = (begin[..., 3] * end[..., 3] > 0).to(self.device, torch.float64)[:, self.grips.leaders]
        return torch.stack([y * inverse * acts, 1 / inverse, dashpot * acts], dim=-1)

    def _start(self, x: torch.Tensor, v: torch.Tensor) -> None:
        """Frame 0. Nodes are bound to the directors there, which depend on what the rod is made of."""
        if not np.array_equal(x.cpu().numpy(), self._nodes if self.together else self._nodes[0]):
            raise InputError("twin.rod", "a rod begins in frame 0 of its twin", "another state", "Begin at frame 0.")
        for rod in self.rods:
            require_axis(rod)
        speeds = v.cpu().numpy() if self.together else v[None].cpu().numpy()
        at = self._tensor([at_vertices(rod, own) for rod, own in zip(self.rods, speeds, strict=True)])
        self.solver.start(self._tensor([rod.vertices for rod in self.rods]), at)
        turned = self.solver.directors().cpu().numpy()
        lanes = zip(self.rods, turned, self._nodes, strict=True)
        self._place = self._tensor([place_on(rod.vertices, m1, nodes, rod.edge) for rod, m1, nodes in lanes])
        self._lengths = None
        self._bind()

    def _bind(self) -> None:
        """Tell the solver where the springs of hands act."""
        self.solver.bind(self._edge[:, self.grips.nodes], self._place[:, self.grips.nodes])

    def _state(self) -> tuple[torch.Tensor, torch.Tensor]:
        x, v = (values.to(self.dtype) if self.together else values[0].to(self.dtype) for values in self.nodes())
        self._x = x
        return x, v

    def nodes(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Nodes and their velocities [B, N, 3] in double precision; what the turn of directors adds to these is left out."""
        f, v = self._place[..., :1], self.solver.v
        speeds = (1 - f) * of_edges(v, self._edge) + f * of_edges(v, self._edge + 1)
        return placed(self.solver.x, self.solver.directors(), self._edge, self._place), speeds

    def _tensor(self, values: Sequence[np.ndarray]) -> torch.Tensor:
        return torch.tensor(np.stack(values).astype(np.float64), device=self.device)


def _packed(twin: Twin) -> np.ndarray:
    """Y, 1 / l0 and dashpot of the springs of hands [S, 3], as `ControllerSprings.applied` takes them."""
    lengths = twin.topology.rest_lengths.astype(np.float64)
    return np.stack([twin.material.stiffness.astype(np.float64), 1 / lengths, twin.material.dashpot], axis=1)


def _rod(twin: Twin) -> Rod:
    """The rod of a twin. Raises InputError where the scene asks for what a rod does not do."""
    assert twin.rod is not None
    simulation = twin.simulation
    if simulation.self_collision or simulation.obstacles:
        found = "self-collision" if simulation.self_collision else f"{len(simulation.obstacles)} obstacles"
        remedy = "Turn it off in the table of scenarios, or choose a method whose twin is a lattice."
        raise InputError("twin.rod", "a rod touches the ground alone", found, remedy)
    return twin.rod


def require_axis(rod: Rod) -> None:
    """Raise InputError if `axis` lies along an end: its projection there is the first director."""
    ends = [0, -1] if rod.held[-1] >= 0 else [0]
    along = np.diff(rod.vertices, axis=0)[ends]
    cosine = np.abs(along @ rod.axis) / np.linalg.norm(along, axis=1) / np.linalg.norm(rod.axis)
    if cosine.max() > PARALLEL:
        rule = f"the angle to the first and last edge must have a cosine below {PARALLEL}"
        raise InputError("rod.axis", rule, f"{cosine.max():.3f}", "Name another direction of the world.")
