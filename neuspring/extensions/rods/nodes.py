"""Nodes that follow the center line of a rod, clamps that move and rotate, and a rod with the interface of a `FrameSolver`.

A node on edge j between vertices x_j and x_(j+1) is at

    x = x_j + f (x_(j+1) - x_j) + a m1 + b m2,    m2 = t x m1,

with (f, a, b) from `Rod.place`. f may be outside [0, 1], beyond an end or in the outer wedge of a bend. A force on the node acts
on the two vertices with the weights 1 - f and f.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from neuspring.core.artifacts import Simulation, Twin
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.extensions.rods.rod import Rod, rod_of
from neuspring.extensions.rods.solver import RodHands, RodSolver
from neuspring.physics.controllers import ControllerSprings
from neuspring.physics.parameters import CONTACT_LIMITS

PARALLEL = 0.99
"""Maximum cosine of an axis to an end; above it, the projection of the axis is too short."""
SMOOTHING_WEIGHT = 1e-6
"""Weight of second differences along the vertices, relative to nodes. Regularizes vertices without nodes."""
SETTLING = 4
"""Iterations that make vertices and directors of frame 0 consistent."""
STEPS_TO_REST = 150
"""Steps towards the equilibrium under gravity."""
AT_REST = 1e-6
"""Maximum last step, as a fraction of the rod's length."""
TINY_GRAVITY = 1e-3
"""Minimum gravity in the length of these steps, m/s^2."""
GROUND_FIELDS = ("ground_elasticity", "ground_friction")


def bind(vertices: np.ndarray, directors: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest edge of each node [N], and (f, a, b) of each node on it [N, 3].

    Arguments: vertices [V, 3], m, directors m1 of edges [E, 3] and nodes [N, 3], m.
    """
    x, points = np.asarray(vertices, np.float64), np.asarray(nodes, np.float64)
    along = np.diff(x, axis=0)
    offset = points[:, None] - x[:-1]
    fraction = (offset * along).sum(axis=2) / (along**2).sum(axis=1)
    apart = np.linalg.norm(offset - np.clip(fraction, 0, 1)[..., None] * along, axis=2)
    edge = apart.argmin(axis=1)
    return edge.astype(np.int32), place_on(x, directors, nodes, edge)


def bound(rod: Rod, nodes: np.ndarray) -> Rod:
    """The rod with nodes [N, 3], m, bound to its center line in frame 0. Raises InputError if `axis` is parallel to a clamp."""
    edge, place = bind(rod.vertices, frame_zero(rod)[0], nodes)
    return replace(rod, edge=edge, place=place)


def frame_zero(rod: Rod) -> tuple[np.ndarray, np.ndarray]:
    """Directors m1 of edges [E, 3] and curvatures k1, k2 of joints [V, 2] in frame 0."""
    require_axis(rod)
    solver = RodSolver([rod], [0.0], Simulation(frame_time=1.0, substeps=1))
    solver.start(torch.tensor(rod.vertices)[None], torch.zeros((1, *rod.vertices.shape), dtype=torch.float64))
    return solver.directors()[0].numpy().copy(), solver.curvatures[0].numpy().copy()


@dataclass(frozen=True)
class Clamps:
    """Ends of B rods that controllers hold; see `Rod.clamps`, `tilts` and `rolls`."""

    ends: tuple[bool, bool]
    """Whether each end is clamped."""
    held: torch.Tensor
    """The controller that sets each vertex [B, V]; 0 for a free vertex."""
    axes: torch.Tensor
    """`Rod.axis` for each end [B, 2, 3]."""
    clamps: torch.Tensor
    """`Rod.clamps` [B, 2, 3], m."""
    lengths: torch.Tensor
    """Lengths of the edges at both ends [B, 2], m."""
    tilts: torch.Tensor | None = None
    """`Rod.tilts` [B, 2, 2]."""
    rolls: torch.Tensor | None = None
    """`Rod.rolls` [B, 2]."""
    beside: bool = False
    """Whether held vertices are beside their controllers."""

    @classmethod
    def of(cls, rods: Sequence[Rod], device: str = "cpu") -> Clamps:
        """Clamps of rods with the same clamped ends."""

        def stacked(values: Sequence[np.ndarray], dtype: torch.dtype = torch.float64) -> torch.Tensor:
            return torch.tensor(np.stack(values), dtype=dtype, device=device)

        first = rods[0]
        held = first.held >= 0
        return cls(
            (bool(held[:2].all()), bool(held[-2:].all())),
            stacked([np.maximum(rod.held, 0) for rod in rods], torch.long),
            stacked([np.stack([rod.axis, rod.axis]) for rod in rods]),
            stacked([rod.clamps for rod in rods]),
            stacked([rod.lengths[[0, -1]] for rod in rods]),
            stacked([rod.tilts for rod in rods]) if first.laid else None,
            stacked([rod.rolls for rod in rods], torch.long) if (first.rolls >= 0).any() else None,
            bool(first.offsets.size) or first.laid,
        )

    def paths(self, controllers: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Held vertices [F, B, V, 3], m, and axes of both ends [F, B, 2, 3], from controllers [F, B, C, 3], m."""
        count = len(controllers)
        index = self.held[None, ..., None].expand(count, -1, -1, 3)
        points, axes = controllers.gather(2, index), self.axes.expand(count, -1, -1, -1)
        if self.rolls is not None:
            towards = controllers.gather(2, self.rolls.clamp(min=0)[None, ..., None].expand(count, -1, -1, 3))
            axes = torch.where((self.rolls >= 0)[..., None], towards - points[:, :, [0, -1]], axes)
        return (self.moved(points, axes) if self.beside else points), axes

    def moved(self, points: torch.Tensor, axes: torch.Tensor) -> torch.Tensor:
        """Held vertices [..., B, V, 3], m, from the positions of their controllers [..., B, V, 3]; other rows do not change."""
        result = points.clone()
        for end, (inner, outer) in enumerate(((1, 0), (-2, -1))):
            if not self.ends[end]:
                continue
            inwards, axis = 1 - 2 * end, axes[..., end, :]
            along = (points[..., inner, :] - points[..., outer, :]) * inwards
            length = along.norm(dim=-1, keepdim=True)
            t = along / length
            m1 = axis - (axis * t).sum(dim=-1, keepdim=True) * t
            m1 = m1 / m1.norm(dim=-1, keepdim=True)
            local = torch.stack([t, m1, torch.linalg.cross(t, m1)], dim=-2)
            vertex = points[..., inner, :] + (self.clamps[:, end, :, None] * local).sum(dim=-2)
            if self.tilts is not None:
                t = t + (self.tilts[:, end, :, None] * local[..., 1:, :]).sum(dim=-2)
                along = t / t.norm(dim=-1, keepdim=True) * self.lengths[:, end, None]
                vertex = vertex + inwards * along / 2
            result[..., inner, :] = vertex
            result[..., outer, :] = vertex - inwards * along
        return result


def hanging(rods: Sequence[Rod], controllers: np.ndarray, simulation: Simulation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rods at rest under gravity: vertices [B, V, 3], m, directors m1 [B, E, 3], and axes of both ends [B, 2, 3].

    The rods hang from controllers [B, C, 3], m, and start from their `vertices`. Each step is one step of backward Euler from
    rest, (M / h^2 + K) d = f. h is so long that a pendulum of the rod's length covers a fifth of its distance per step. Raises
    NumericalFailure if a rod still moves at the end.
    """
    held, axes = Clamps.of(rods).paths(torch.tensor(np.asarray(controllers, np.float64))[None])
    length = max(float(rod.lengths.sum()) for rod in rods)
    step = 0.5 * (length / max(simulation.gravity, TINY_GRAVITY)) ** 0.5
    plain = [replace(rod, damping=0.0, drag_quadratic=0.0, slip=rod.slip[:0]) for rod in rods]
    still = replace(simulation, frame_time=step, substeps=1, ground=False)
    solver = RodSolver(plain, [0.0] * len(rods), still)
    x = torch.tensor(np.stack([rod.vertices for rod in rods]))
    solver.start(x, torch.zeros_like(x), axes[0])
    steps, _ = solver.frames(held.expand(STEPS_TO_REST + 1, -1, -1, -1), still=True)
    moved = float((steps[-1] - steps[-2]).norm(dim=-1).max())
    if not moved < AT_REST * length:
        raise NumericalFailure(f"a rod of {length:.3g} m does not come to rest under gravity: its last step is {moved:.2g} m")
    solver.start(steps[-1], torch.zeros_like(x), axes[0])
    return solver.x.numpy().copy(), solver.directors().numpy().copy(), axes[0].numpy().copy()


def settled(rods: Sequence[Rod], lines: np.ndarray) -> np.ndarray:
    """Vertices in frame 0 of rods with observed lines [B, V, 3], m: beside the lines by `offsets` and `clamps`."""
    points = torch.tensor(np.asarray(lines, np.float64))
    if not rods[0].offsets.size:
        return points.numpy()
    free = rods[0].held < 0
    clamps = Clamps.of(rods)
    offsets = torch.tensor(np.stack([rod.offsets for rod in rods]))[:, free]
    solver = RodSolver(rods, [0.0] * len(rods), Simulation(frame_time=1.0, substeps=1))
    x = clamps.moved(points, clamps.axes)
    edges = np.minimum(np.flatnonzero(free), len(free) - 2)
    for _ in range(SETTLING):
        solver.start(x, torch.zeros_like(x))
        m1 = solver.directors()[:, edges]
        along = x[:, edges + 1] - x[:, edges]
        m2 = torch.linalg.cross(along / along.norm(dim=-1, keepdim=True), m1)
        x[:, free] = points[:, free] - offsets[..., :1] * m1 - offsets[..., 1:] * m2
    return x.numpy()


def place_on(vertices: np.ndarray, directors: np.ndarray, nodes: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """(f, a, b) [N, 3] of nodes [N, 3], m, on edges [N]. Inverse of `placed`."""
    x, m1 = np.asarray(vertices, np.float64), np.asarray(directors, np.float64)[edge]
    along = np.diff(x, axis=0)[edge]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    offset, tangent = np.asarray(nodes, np.float64) - x[edge], along / length
    coordinates = [(offset * axis).sum(axis=1) for axis in (along / length**2, m1, np.cross(tangent, m1))]
    return np.stack(coordinates, axis=1)


def placed(vertices: torch.Tensor, directors: torch.Tensor, edge: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """Nodes [B, N, 3], m, from (f, a, b) [B, N, 3] on edges [B, N], vertices [B, V, 3], m, and m1 of edges [B, E, 3]."""
    begin, m1 = of_edges(vertices, edge), of_edges(directors, edge)
    along = of_edges(vertices, edge + 1) - begin
    m2 = torch.linalg.cross(along / along.norm(dim=-1, keepdim=True), m1)
    f, a, b = place.split(1, dim=-1)
    nodes: torch.Tensor = begin + f * along + a * m1 + b * m2
    return nodes


def of_edges(values: torch.Tensor, edge: torch.Tensor) -> torch.Tensor:
    """Rows [B, N, 3] of values [B, E, 3] at indices [B, N]."""
    return values.gather(1, edge[..., None].expand(-1, -1, 3))


def at_vertices(rod: Rod, values: np.ndarray, held: np.ndarray | None = None) -> np.ndarray:
    """Values at vertices [..., V, 3] whose interpolation along the edges best fits the values of the nodes [..., N, 3].

    Held vertices have the values `held` [..., C, 3] of their controllers, if given. Offsets of nodes from the line are ignored.
    So positions are exact if nodes are vertices, and otherwise accurate if nodes are uniform around the line.
    """
    count, nodes = len(rod.vertices), np.arange(len(rod.edge))
    weights = np.zeros((len(nodes), count))
    weights[nodes, rod.edge], weights[nodes, rod.edge + 1] = 1 - rod.place[:, 0], rod.place[:, 0]
    known = rod.held >= 0 if held is not None and not rod.laid else np.zeros(count, bool)
    # Second differences determine vertices without nodes.
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
    """The rods of twins with the same controllers, with the interface of `FrameSolver` that rollouts use.

    The state is that of the rods. For a sequence of twins with equally many vertices, rods are batch lanes, and every tensor has
    a leading axis [B].
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
        self.solver = RodSolver(self.rods, drags, simulation, device, hands)
        self._edge = torch.tensor(np.stack([rod.edge for rod in self.rods]), dtype=torch.long, device=device)
        self._place = self._tensor([rod.place for rod in self.rods])
        self._clamps = Clamps.of(self.rods, device)
        self._x: torch.Tensor | None = None
        self._lengths: torch.Tensor | None = None
        """Rest lengths of grasps that began after the start [B, S]."""

    def forward(
        self, x: torch.Tensor, v: torch.Tensor, begin: torch.Tensor, end: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Like `FrameSolver.forward`: (x, v) [N, 3] after one frame; controllers move from begin to end [C, 3 or 4].

        Continues from the last returned state, or starts again if x is frame 0. Raises InputError for other states, because nodes
        do not determine the twist of a rod.
        """
        rows = torch.stack([begin, end]) if self.together else torch.stack([begin, end])[:, None]
        if x is not self._x:
            self.start(x, v, rows[0])
        self.advance(rows)
        x, v = (values.to(self.dtype) if self.together else values[0].to(self.dtype) for values in self.nodes())
        self._x = x
        return x, v

    def advance(self, rows: torch.Tensor, every: slice = slice(None)) -> torch.Tensor:
        """Nodes [F', B, N, 3], m, in double precision, in the frames `every` of the next F frames with waypoints [F + 1, B, C,
        3].

        With a fourth column in the waypoints, F must be 1.
        """
        ends = rows[..., :3].to(self.device, torch.float64)
        self.solver.pull(self._law(rows[0], rows[-1]), ends)
        x, m1 = (values[every] for values in self.solver.frames(*self._clamps.paths(ends)))
        edge, place = (values.repeat(len(x), 1, *[1] * (values.dim() - 2)) for values in (self._edge, self._place))
        nodes: torch.Tensor = placed(x.flatten(0, 1), m1.flatten(0, 1), edge, place).unflatten(0, x.shape[:2])
        return nodes

    def follow(self, other: RodFrames) -> None:
        """Copy the state of another solver of the same rods, whose springs may differ."""
        self.solver.follow(other.solver)
        self._place, self._x = other._place, other._x
        self._bind()

    def _hands(self, twins: Sequence[Twin]) -> RodHands:
        """Springs of controllers, and the heights at which vertices touch the ground: the radius, or less if they start lower."""
        up = twins[0].simulation.up_sign
        heights = [np.minimum(radius_of(rod), np.maximum(up * rod.vertices[:, 2], 0.0)) for rod in self.rods]
        leaders = np.tile(self.grips.leaders.cpu().numpy(), (len(twins), 1))
        surface = [[np.clip(getattr(twin.material, name), *CONTACT_LIMITS[name]) for twin in twins] for name in GROUND_FIELDS]
        return RodHands(
            len(twins[0].topology.controllers), leaders, np.stack(heights), *(np.array(values, np.float64) for values in surface)
        )

    def _law(self, begin: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
        """Stiffness, N/m, rest length, m, and dashpot, N s/m, of controllers' springs in a frame [B, S, 3] (controllers.py)."""
        if begin.shape[-1] == 4:
            self._lengths = self.grips.taken(self._lengths, self.nodes()[0], begin.to(self.device, torch.float64))
        y, inverse, dashpot = self.grips.applied(self._packed, self._lengths).unbind(dim=-1)
        acts = torch.ones_like(y)
        if begin.shape[-1] == 4:
            acts = (begin[..., 3] * end[..., 3] > 0).to(self.device, torch.float64)[:, self.grips.leaders]
        return torch.stack([y * inverse * acts, 1 / inverse, dashpot * acts], dim=-1)

    def start(self, x: torch.Tensor, v: torch.Tensor, begin: torch.Tensor) -> None:
        """Set the state of frame 0, with the controllers at `begin` [B, C, 3]. Raises InputError for another frame.

        Nodes are bound to the directors of frame 0, which depend on the material; with `lay_out` they keep their binding.
        """
        if not np.array_equal(x.cpu().numpy(), self._nodes if self.together else self._nodes[0]):
            raise InputError("twin.body", "a rod must start in frame 0 of its twin", "another state", "Start at frame 0.")
        for rod in self.rods:
            require_axis(rod)
        speeds = v.cpu().numpy() if self.together else v[None].cpu().numpy()
        velocities = self._tensor([at_vertices(rod, speed) for rod, speed in zip(self.rods, speeds, strict=True)])
        _, axes = self._clamps.paths(begin[None, ..., :3].to(self.device, torch.float64))
        self.solver.start(self._tensor([rod.vertices for rod in self.rods]), velocities, axes[0])
        if not self.rods[0].laid:
            turned = self.solver.directors().cpu().numpy()
            lanes = zip(self.rods, turned, self._nodes, strict=True)
            self._place = self._tensor([place_on(rod.vertices, m1, nodes, rod.edge) for rod, m1, nodes in lanes])
        self._lengths = None
        self._bind()

    def _bind(self) -> None:
        """Set where the springs of controllers act."""
        self.solver.bind(self._edge[:, self.grips.nodes], self._place[:, self.grips.nodes])

    def nodes(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Nodes and their velocities [B, N, 3] in double precision; velocities ignore the rotation of directors."""
        f, v = self._place[..., :1], self.solver.v
        speeds = (1 - f) * of_edges(v, self._edge) + f * of_edges(v, self._edge + 1)
        return placed(self.solver.x, self.solver.directors(), self._edge, self._place), speeds

    def _tensor(self, values: Sequence[np.ndarray]) -> torch.Tensor:
        return torch.tensor(np.stack(values).astype(np.float64), device=self.device)


def _packed(twin: Twin) -> np.ndarray:
    """Y, 1 / l0 and dashpot of the springs of controllers [S, 3], for `ControllerSprings.applied`."""
    lengths = twin.topology.rest_lengths.astype(np.float64)
    return np.stack([twin.material.stiffness.astype(np.float64), 1 / lengths, twin.material.dashpot], axis=1)


def _rod(twin: Twin) -> Rod:
    """The rod of a twin. Raises InputError for self-collision, which rods do not support."""
    simulation = twin.simulation
    if simulation.self_collision:
        remedy = "Turn it off in scenarios.tsv, or choose a method whose twin is a lattice."
        raise InputError("twin.body", "a rod must not collide with itself", "self-collision", remedy)
    return rod_of(twin)


def require_axis(rod: Rod) -> None:
    """Raise InputError if `axis` is parallel to an end, where its projection is the first director."""
    ends = [0, -1] if rod.held[-1] >= 0 else [0]
    along = np.diff(rod.vertices, axis=0)[ends]
    cosine = np.abs(along @ rod.axis) / np.linalg.norm(along, axis=1) / np.linalg.norm(rod.axis)
    if cosine.max() > PARALLEL:
        rule = f"the angle to the first and last edge must have a cosine below {PARALLEL}"
        raise InputError("rod.axis", rule, f"{cosine.max():.3f}", "Choose another direction of the world.")
