"""Controller motion (path.py), and the velocity update by force, gravity and drag (the paper's equation 4) with its adjoint.

w = v + dt (f / m + g),   v' = w delta / (1 + q |w|),   mass m, 1 kg if none is given. Positions follow in position.py.

The drag is dv/dt = -(c + b |v|) v with c = drag [1/s] and b = drag_quadratic [1/m], a Bernoulli equation: from speed s it leaves
1 / ((1/s + b/c) e^(ct) - b/c) after t. So a substep of drag alone is exact, and stable for any b >= 0 and dt, with

    delta = exp(-dt c),   q = b (1 - delta) / c   (b dt without linear drag).

Without quadratic drag v' = w delta.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
import warp as wp

from neuspring.physics.arrays import Buffers, structs
from neuspring.physics.lanes import lanes

SERIES = 1e-4
"""Below this dt c, (1 - exp(-dt c)) / (dt c) is its series to second order, off by 4e-14 there."""


class Functions(NamedTuple):
    """Functions of this file for one scalar type and width."""

    move_controller: Any
    updated: Any
    """(v, force, gravity, dt, delta, q, 1 / m) -> v'."""
    updated_adjoint: Any
    """(v', dL/dv', dt, delta, q, 1 / m) -> dL/d(v), dL/d(force), dL/d(delta), dL/d(q)."""


def pack(values: Mapping[str, torch.Tensor], substep: float | torch.Tensor) -> torch.Tensor:
    """(delta, q) [2]: the factor that a substep leaves of slow velocities, and how much less is left of fast ones, s/m."""
    drag = values["drag"]
    decay = torch.exp(-substep * drag)
    quadratic = values["drag_quadratic"] if "drag_quadratic" in values else torch.zeros_like(drag)
    return torch.stack([decay, quadratic * substep * _mean_decay(substep * drag)], dim=-1)


def _mean_decay(z: torch.Tensor) -> torch.Tensor:
    """(1 - exp(-z)) / z, the mean of exp(-z t) over t in [0, 1], with its series where z is small."""
    small = z < SERIES
    safe = torch.where(small, torch.ones_like(z), z)
    return torch.where(small, 1 - z / 2 + z * z / 6, -torch.expm1(-safe) / safe)


def allocate(b: Buffers) -> None:
    """The masses' inverses, the drag's factors, and the factors' adjoints per node."""
    b.add_numbers(inverse_mass=b.nodes)
    b.add_numbers(decay=None, quadratic=None, adj_decay=b.nodes, adj_quadratic=b.nodes)


def fill(b: Buffers, packed: torch.Tensor) -> None:
    """Take the drags [B, 2]."""
    for column, name in enumerate(("decay", "quadratic")):
        b.set_numbers(name, packed[:, column])


def fill_masses(b: Buffers, inverse: torch.Tensor) -> None:
    """Take the inverse masses [B, N], or [B, 1] for all nodes of a twin."""
    b.set_numbers("inverse_mass", inverse.expand(-1, b.nodes))


def pack_masses(values: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """The inverse masses [N], 1/kg, or [1] where all are 1 kg."""
    mass = values.get("mass")
    return values["drag"].detach().new_ones(1) if mass is None or not len(mass) else 1.0 / mass


def gradient(b: Buffers) -> torch.Tensor:
    """dL/d(delta, q) [B, 2]."""
    return torch.stack([b.get_numbers(name).sum(dim=1) for name in ("adj_decay", "adj_quadratic")], dim=-1)


@functools.cache
def functions(real: Any, width: int) -> Functions:
    """Functions for a scalar type, wp.float32 or wp.float64, and a number of lanes."""
    lane = lanes(real, width)
    Number, Vector, dot, scaled = lane.Number, lane.Vector, lane.dot, lane.scaled
    root, divided, floored = lane.root, lane.divided, lane.floored
    Model, State, _ = structs(real, width)
    zero, one, ones = wp.constant(real(0.0)), wp.constant(real(1.0)), wp.constant(Number(*[real(1.0)] * width))

    @wp.func
    def move_controller(model: Model, state: State, step: int, slot: int, c: int, g: int):
        """Put a controller where it is at the end of a substep."""
        travel = state.end[c, g] - state.begin[c, g]
        fraction = Number()
        for q in range(width):
            fraction[q] = wp.min(real(step + 1) / model.counts[g][q], one)
        place = state.begin[c, g] + scaled(travel, fraction)
        if model.cubic != 0:
            first = state.bend_begin[c, g]
            last = state.bend_end[c, g]
            rest = ones - fraction
            both = wp.cw_mul(fraction, rest)
            place = place + scaled(first, wp.cw_mul(both, rest)) - scaled(last, wp.cw_mul(both, fraction))
            travel = travel + scaled(first, wp.cw_mul(rest, rest - fraction - fraction))
            travel = travel - scaled(last, wp.cw_mul(fraction, rest + rest - fraction))
        state.x[slot, model.nodes + c, g] = place
        state.v[slot, model.nodes + c, g] = scaled(travel, model.inverse_time[g])

    @wp.func
    def updated(v: Vector, force: Vector, gravity: Vector, dt: Number, decay: Number, quadratic: Number, light: Number) -> Vector:
        w = v + scaled(scaled(force, light) + gravity, dt)
        after = scaled(w, decay)
        if wp.max(quadratic) != zero:
            speed = root(dot(w, w))
            # A speed whose square overflows is a divergence, not a stop: inf - inf is not a number.
            after = divided(after, ones + wp.cw_mul(quadratic, speed) + (speed - speed))
        return after

    @wp.func
    def updated_adjoint(after: Vector, adj_after: Vector, dt: Number, decay: Number, quadratic: Number, light: Number):
        # In terms of v' alone, for |w| / (1 + q |w|) = |v'| / delta: the substep keeps neither w nor the force.
        along = dot(adj_after, after)
        adj_decay = wp.cw_div(along, decay)
        speed = root(dot(after, after))
        across = adj_after
        factor = decay
        if wp.max(quadratic) != zero:
            # dv'/dw = delta m (1 - (1 - m) v' v'^T / |v'|^2) with m = 1 / (1 + q |w|).
            lost = wp.cw_div(quadratic, decay)
            across = adj_after - scaled(after, wp.cw_mul(lost, wp.cw_div(along, floored(speed))))
            factor = wp.cw_mul(decay, ones - wp.cw_mul(lost, speed))
        h = scaled(across, factor)
        return h, scaled(scaled(h, dt), light), adj_decay, -wp.cw_mul(adj_decay, speed)

    return Functions(move_controller, updated, updated_adjoint)
