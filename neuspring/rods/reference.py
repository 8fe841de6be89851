"""The specification of a rod: a slow, readable float64 simulation of one discrete elastic rod (Bergou et al. 2008, 2010).

Forces are gradients of the energy by automatic differentiation. The fast solver (`solver.py`) must agree. There is no contact here.
Everything can be differentiated with respect to `Parameters`, also through a rollout.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import ceil, pi
from typing import NamedTuple

import torch
from torch import Tensor

from neuspring.core.artifacts import Rod, Simulation
from neuspring.core.errors import NumericalFailure

STEPS_OF_TWIST = 200
"""The most Newton steps towards the equilibrium of twist."""
LARGEST_TURN = 0.5
"""The largest change of an angle in one of them, rad."""
SMALLEST_TURN = 1e-12
"""They end where no angle changes more, rad, ..."""
ROUNDING = 1e-15
"""... or where moments are this part of the largest stiffness: then they are rounding."""
SMALLEST_SINE = 1e-7
"""Sine of half an angle between edges below which the angle is as good as its sine."""
NO_STIFFNESS = 1e-10
"""A turn of the directors that has less than this of the largest stiffness has none: of a straight rod that no clamp holds."""


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """The arrays of a `Rod` (there are shapes and units), as float64 tensors, and the drag of its material."""

    vertices: Tensor
    held: Tensor
    lengths: Tensor
    mass: Tensor
    bending: Tensor
    twisting: Tensor
    curvature: Tensor
    axis: Tensor
    stretching: Tensor
    damping: Tensor
    drag: Tensor
    """Linear drag, 1/s."""
    drag_quadratic: Tensor
    roll: Tensor
    slip: Tensor
    slip_twist: Tensor
    by_angle: bool

    @classmethod
    def of(cls, rod: Rod, drag: float = 0.0) -> Parameters:
        """A rod's numbers; `held` says of each vertex whether a controller sets it."""
        arrays = "vertices lengths mass bending twisting curvature axis stretching damping drag_quadratic roll slip slip_twist"
        numbers = {name: torch.tensor(getattr(rod, name), dtype=torch.float64) for name in arrays.split()}
        return cls(
            held=torch.tensor(rod.held >= 0), drag=torch.tensor(drag, dtype=torch.float64), by_angle=bool(rod.by_angle), **numbers
        )

    @property
    def spans(self) -> Tensor:
        """Length that belongs to each inner vertex [J], m: half of its two edges."""
        return (self.lengths[:-1] + self.lengths[1:]) / 2

    @property
    def inner(self) -> slice:
        """Edges that are free to turn: all but the first and the last, where these are clamped (both vertices held)."""
        first, last = bool(self.held[:2].all()), bool(self.held[-2:].all())
        return slice(int(first), len(self.lengths) - int(last))


class Frames(NamedTuple):
    """Reference frames of the edges. A material frame is its reference frame, turned by theta about the tangent."""

    tangents: Tensor
    """[E, 3]."""
    directors: Tensor
    """u [E, 3], perpendicular to them."""
    twist: Tensor
    """Reference twist of each joint [J], rad: from u of the edge before, carried over the joint, to u of the edge behind."""
    by_angle: bool = False
    """See `Rod.by_angle`."""


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner products along the last axis."""
    return (a * b).sum(-1)


def transport(u: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Vectors u [..., 3] turned by the smallest rotation that takes unit vectors a to b: parallel transport.

    R u = u + w x u + w x (w x u) / (1 + a b), w = a x b.
    """
    w = torch.linalg.cross(a, b)
    once = torch.linalg.cross(w, u)
    return u + once + torch.linalg.cross(w, once) / (1 + dot(a, b))[..., None]  # type: ignore[no-any-return]


def angle(a: Tensor, b: Tensor, t: Tensor) -> Tensor:
    """Angle from a to b about t, rad, in (-pi, pi]."""
    return torch.atan2(dot(torch.linalg.cross(a, b), t), dot(a, b))


def tangents(x: Tensor) -> Tensor:
    """Tangents of the edges between vertices x [V, 3]."""
    edges = x[1:] - x[:-1]
    return edges / edges.norm(dim=1, keepdim=True)  # type: ignore[no-any-return]


def projected(axis: Tensor, t: Tensor) -> Tensor:
    """The unit vector perpendicular to t that is nearest to `axis`."""
    across = axis - dot(axis, t) * t
    return across / across.norm()  # type: ignore[no-any-return]


def carried(frames: Frames, x: Tensor) -> Frames:
    """Frames of vertices x [V, 3]: directors by parallel transport in time, and a twist without jumps."""
    t = tangents(x)
    u = transport(frames.directors, frames.tangents, t)
    twist = angle(transport(u[:-1], t[:-1], t[1:]), u[1:], t[1:])
    return Frames(t, u, frames.twist + torch.remainder(twist - frames.twist + pi, 2 * pi) - pi, frames.by_angle)


def start(parameters: Parameters, x: Tensor) -> tuple[Frames, Tensor]:
    """Frames of frame 0, carried along the rod from edge 0, and the angles theta [E] in equilibrium."""
    t = tangents(x)
    directors = [projected(parameters.axis, t[0])]
    for before, behind in pairwise(t):
        directors.append(transport(directors[-1], before, behind))
    frames = Frames(t, torch.stack(directors), torch.zeros_like(parameters.spans), parameters.by_angle)
    end = angle(directors[-1], projected(parameters.axis, t[-1]), t[-1]) + parameters.roll
    along = torch.cat([torch.zeros_like(parameters.spans[:1]), parameters.spans.cumsum(0)]) / parameters.spans.sum()
    return frames, relaxed(parameters, x, frames, end * along)


def clamped(parameters: Parameters, frames: Frames, theta: Tensor) -> Tensor:
    """Theta [E] with the directors of clamped ends where `axis` and `roll` want them, by the smallest change."""
    rows, inner, edges = list(theta), parameters.inner, len(theta)
    for end, roll, held in ((0, 0.0, inner.start > 0), (edges - 1, parameters.roll, inner.stop < edges)):
        if held:
            t = frames.tangents[end]
            wanted = angle(frames.directors[end], projected(parameters.axis, t), t) + roll
            rows[end] = theta[end] + torch.remainder(wanted - theta[end] + pi, 2 * pi) - pi
    return torch.stack(rows)


def curvatures(frames: Frames, theta: Tensor) -> Tensor:
    """k1, k2 of each joint [J, 2], as the docstring of `Rod` says."""
    t, u = frames.tangents, frames.directors
    m1 = theta.cos()[:, None] * u + theta.sin()[:, None] * torch.linalg.cross(t, u)
    m2 = torch.linalg.cross(t, m1)
    cosine = dot(t[:-1], t[1:])
    factor = 2 / (1 + cosine)
    if frames.by_angle:
        sine = ((1 - cosine) / 2).clamp(min=0).sqrt().clamp(min=SMALLEST_SINE)
        # angle / sine of the angle
        factor = torch.arcsin(sine) / sine / (1 - sine**2).sqrt()
    kb = factor[:, None] * torch.linalg.cross(t[:-1], t[1:])
    return torch.stack([dot(kb, m2[:-1] + m2[1:]) / 2, -dot(kb, m1[:-1] + m1[1:]) / 2], dim=1)


def energy(parameters: Parameters, x: Tensor, frames: Frames, theta: Tensor) -> Tensor:
    """Elastic energy, J, of vertices x [V, 3] with their frames and angles theta [E].

    EA / 2 sum L (|e| / L - 1)^2 + sum EI / (2 l) |k - k0|^2 + sum GJ / (2 l) m^2, m = theta_i - theta_(i-1) + reference twist.
    """
    p = parameters
    strain = (x[1:] - x[:-1]).norm(dim=1) / p.lengths - 1
    bent = (curvatures(frames, theta) - p.curvature[1:-1]).square().sum(1)
    twist = theta[1:] - theta[:-1] + frames.twist
    joints = (p.bending[1:-1] * bent + p.twisting[1:-1] * twist.square()) / p.spans
    return (p.stretching * (p.lengths * strain.square()).sum() + joints.sum()) / 2  # type: ignore[no-any-return]


def strains(frames: Frames, theta: Tensor) -> Tensor:
    """k1, k2 and the twist of each joint [J, 3]."""
    return torch.cat([curvatures(frames, theta), (theta[1:] - theta[:-1] + frames.twist)[:, None]], dim=1)


def slipping(parameters: Parameters) -> tuple[Tensor, Tensor]:
    """Largest |k - z| of the curvatures and of the twist of each branch [J, B], 1 and rad."""
    most = parameters.spans[:, None] * parameters.slip[:, 1]
    return most, parameters.slip_twist * most


def friction(parameters: Parameters, frames: Frames, theta: Tensor, z: Tensor) -> Tensor:
    """Potential of branches at z [J, B, 3], J, from which their moments share (EI, GJ) / l (k - z) follow with the new z.

    share (EI, GJ) / l times e^2 / 2, where e = |k - z| is at most what it slips at, y, and y (e - y / 2) beyond.
    """
    p, away, total = parameters, strains(frames, theta)[:, None] - z, torch.zeros_like(parameters.roll)
    for stiffness, part, most in zip((p.bending, p.twisting), away.split((2, 1), dim=-1), slipping(p), strict=True):
        square = part.square().sum(-1)
        slips = square > most**2
        size = torch.where(slips, square, 1.0).sqrt()
        level = torch.where(slips, most * (size - most / 2), square / 2)
        total = total + (p.slip[:, 0] * level * (stiffness[1:-1] / p.spans)[:, None]).sum()
    return total


def dragged(parameters: Parameters, frames: Frames, theta: Tensor, before: Tensor, z: Tensor) -> Tensor:
    """z [J, B, 3] after joints have gone straight from the curvatures `before` [J, 2].

    Where e = k - z is as long as it can be, y, de is dk less its part along e. So half the angle from the way u to e has a tangent
    that falls by exp(-way / y): cos -> (cos + t) / (1 + cos t), sin -> sin (1 - t^2)^(1/2) / (1 + cos t), t = tanh(way / y).
    """
    now, (most, turn) = strains(frames, theta)[:, None], slipping(parameters)
    twisted = (now[..., 2] - z[..., 2]).clamp(-turn, turn)
    e, move, most = before[:, None] - z[..., :2], now[..., :2] - before[:, None], most[..., None]
    slips, none = (e + move).square().sum(-1, keepdim=True) > most**2, most <= 0
    way = torch.where(slips, move.square().sum(-1, keepdim=True), 1.0).sqrt()
    u, y = move / way, torch.where(none, 1.0, most)
    along = dot(e, u)[..., None]
    across = e - along * u
    begin = torch.where(slips, y**2 - across.square().sum(-1, keepdim=True), 1.0).clamp(min=0).sqrt()
    cos, t = begin / y, torch.tanh((way - begin + along) / y)
    slid = (y * (cos + t) * u + (1 - t**2).sqrt() * across) / (1 + cos * t)
    bent = torch.where(none, 0.0, torch.where(slips, slid, e + move))
    return now - torch.cat([bent, twisted[..., None]], dim=-1)


class Rate(NamedTuple):
    """Rate at which curvatures change, from those of earlier times: dk/dt = factor k - past [J, 2], 1/s; and z of branches."""

    factor: float
    past: Tensor
    z: Tensor | None = None
    """[J, B, 3]; None: there are no branches."""


def potential(parameters: Parameters, x: Tensor, frames: Frames, theta: Tensor, rate: Rate | None = None) -> Tensor:
    """Energy, and what damping and branches add in a step, J: its gradients are minus the forces and the moments about tangents.

    Moments EI / l (k - k0 + damping dk/dt) are derivatives of energy + sum EI damping / (2 l factor) |dk/dt|^2 by k.
    """
    total = energy(parameters, x, frames, theta)
    if rate is None:
        return total
    if rate.z is not None:
        total = total + friction(parameters, frames, theta, rate.z)
    fast = (rate.factor * curvatures(frames, theta) - rate.past).square().sum(1)
    return total + parameters.damping * (parameters.bending[1:-1] * fast / parameters.spans).sum() / (2 * rate.factor)


def turned(parameters: Parameters, theta: Tensor, free: Tensor) -> Tensor:
    """Theta [E] with angles `free` [I] where edges are free to turn."""
    inner = parameters.inner
    return torch.cat([theta[: inner.start], free, theta[inner.stop :]])


def relaxed(parameters: Parameters, x: Tensor, frames: Frames, theta: Tensor, rate: Rate | None = None) -> Tensor:
    """Theta [E] in quasi-static equilibrium: the minimum of the potential next to `theta`. Clamped ends keep their angles.

    Newton's steps with the absolute eigenvalues of the stiffness go down, not to a saddle. The last one is differentiable,
    which is the implicit function theorem: d theta = -H^-1 dg. Raises NumericalFailure if there is no end.
    """
    free = theta[parameters.inner].detach()
    for _ in range(STEPS_OF_TWIST):
        with torch.enable_grad():
            free.requires_grad_()
            level = potential(parameters, x, frames, turned(parameters, theta, free), rate)
            moments = torch.autograd.grad(level, free, create_graph=True)[0]
            each = torch.eye(len(free), dtype=free.dtype)
            stiffness = torch.autograd.grad(moments, free, each, retain_graph=True, is_grads_batched=True)[0]
        sizes, modes = torch.linalg.eigh(stiffness.detach())
        sizes = sizes.abs()
        stiffest = float(sizes.max())
        sizes[sizes <= NO_STIFFNESS * stiffest] = torch.inf
        step = modes @ (modes.T @ moments / sizes)
        largest = float(step.detach().abs().max())
        if largest <= SMALLEST_TURN or float(moments.detach().abs().max()) <= ROUNDING * stiffest:
            return turned(parameters, theta, free.detach() - step)
        free = (free - step * min(1.0, LARGEST_TURN / largest)).detach()
    raise NumericalFailure(f"the twist of a rod found no equilibrium in {STEPS_OF_TWIST} steps")


def forces(parameters: Parameters, x: Tensor, frames: Frames, theta: Tensor, rate: Rate | None = None) -> Tensor:
    """Forces of the rod on its vertices [V, 3], N: minus the gradient of the potential, at fixed theta where it is in equilibrium.

    `frames` are of x or of a time before, for directors are carried in time.
    """
    further = torch.is_grad_enabled()
    with torch.enable_grad():
        x = x.clone() if x.requires_grad else x.detach().requires_grad_()
        level = potential(parameters, x, carried(frames, x), theta, rate)
        return -torch.autograd.grad(level, x, create_graph=further)[0]


def steps_needed(parameters: Parameters, frame_time: float) -> int:
    """Steps per frame that are stable: h (w + damping w^2) < 0.7, w^2 < (16 EI / L^3 + 4 EA / L) / m the largest frequency."""
    p = parameters
    length, mass = float(p.lengths.min()), float(p.mass[~p.held].min())
    bending = 16 * float(p.bending.max()) / length**3 / mass
    highest = (bending + 4 * float(p.stretching) / length / mass) ** 0.5
    return max(1, ceil(frame_time * (highest + float(p.damping) * bending) / 0.7))  # type: ignore[no-any-return]


class State(NamedTuple):
    """State of a rod at a time."""

    x: Tensor
    """[V, 3], m."""
    v: Tensor
    """[V, 3], m/s; those of held vertices are not used."""
    frames: Frames
    theta: Tensor
    k: Tensor
    """Curvatures [J, 2] half a step before; in frame 0 those of frame 0."""
    k_before: Tensor | None = None
    """Curvatures a step before them; none in frame 0."""
    z: Tensor | None = None
    """k1, k2 and twist [J, B, 3] at which branches have no moment; None: there are none."""


def advanced(p: Parameters, state: State, h: float, middle: Tensor, end: Tensor, gravity: Tensor) -> State:
    """The state after a step of h s: drift for h / 2, kick, drift. Held vertices pass `middle` [V, 3] and reach `end` [V, 3]."""
    k, k_before, fixed = state.k, state.k_before, p.held[:, None]
    x = torch.where(fixed, middle, state.x + h / 2 * state.v)
    frames = carried(state.frames, x)
    rate = Rate(2 / h, 2 / h * k, state.z) if k_before is None else Rate(1.5 / h, (2 * k - k_before / 2) / h, state.z)
    theta = relaxed(p, x, frames, clamped(p, frames, state.theta), rate)
    k_now = curvatures(frames, theta)
    push = forces(p, x, frames, theta, rate) / p.mass[:, None] + gravity
    v = state.v + h * (push - slowed(p, state.v + h / 2 * (push - slowed(p, state.v))))
    # The k of frame 0 lies half a step back: it is continued to a whole one.
    z = None if state.z is None else dragged(p, frames, theta, state.k, state.z)
    return State(torch.where(fixed, end, x + h / 2 * v), v, frames, theta, k_now, 2 * k - k_now if k_before is None else k, z)


def slowed(p: Parameters, v: Tensor) -> Tensor:
    """Deceleration by drag, m/s^2: c v + b |v| v."""
    return (p.drag + p.drag_quadratic * v.norm(dim=1, keepdim=True)) * v  # type: ignore[no-any-return]


def beginning(p: Parameters, v: Tensor) -> State:
    """Frame 0."""
    frames, theta = start(p, p.vertices)
    z = strains(frames, theta)[:, None].repeat(1, len(p.slip), 1) if len(p.slip) else None
    return State(p.vertices, v, frames, theta, curvatures(frames, theta), z=z)


def roll_out(
    rod: Rod | Parameters, simulation: Simulation, held: Tensor, velocity: Tensor, drag: float = 0.0, steps: int = 0
) -> Tensor:
    """Positions [T, V, 3], m, in all frames, from `rod.vertices` with `velocity` [V, 3], m/s.

    Held vertices follow `held` [T, V, 3], m, linearly within a frame. The scheme is of second order; `steps` per frame, 0: as many
    as are needed. `drag` is linear drag, 1/s, where `rod` is a `Rod`.
    """
    p = rod if isinstance(rod, Parameters) else Parameters.of(rod, drag)
    count = steps or steps_needed(p, simulation.frame_time)
    gravity = torch.tensor([0.0, 0.0, -simulation.up_sign * simulation.gravity], dtype=torch.float64)
    wanted = torch.is_grad_enabled() and any(
        torch.is_tensor(value) and value.requires_grad for value in (*vars(p).values(), held, velocity)
    )
    with torch.set_grad_enabled(wanted):
        state = beginning(p, velocity)
        rows = [state.x]
        for begin, end in pairwise(held):
            for step in range(count):
                middle, close = (begin + (end - begin) * (part / count) for part in (step + 0.5, step + 1.0))
                state = advanced(p, state, simulation.frame_time / count, middle, close, gravity)
            rows.append(state.x)
    return torch.stack(rows)
