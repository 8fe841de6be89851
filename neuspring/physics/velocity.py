"""Controller motion, and the velocity update by force, gravity and drag (the paper's equation 4) with its adjoint.

    x_c = begin + (end - begin) (k + 1) / n in substep k of n
    v' = (v + dt (f / m + g)) delta,   delta = exp(-dt drag)

Drag is dv/dt = -drag v; its exact solution is taken over a substep, so any value is stable. The mass m is 1 kg if none is given.
Positions follow in contact.py.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
import warp as wp

from neuspring.physics.arrays import Buffers, structs
from neuspring.physics.lanes import lanes


class Functions(NamedTuple):
    """Functions of this file for one scalar type and width."""

    move_controller: Any
    updated: Any
    """(v, force, gravity, dt, delta, 1 / m) -> v'."""
    updated_adjoint: Any
    """(v', dL/dv', dt, delta, 1 / m) -> dL/d(v), dL/d(force), dL/d(delta)."""


def pack(values: Mapping[str, torch.Tensor], substep: float | torch.Tensor) -> torch.Tensor:
    """delta [1]: the factor of velocities that a substep leaves."""
    return torch.exp(-substep * values["drag"])[None]


def allocate(b: Buffers) -> None:
    """The masses' inverses, the drag's factor, and its adjoint per node."""
    b.add_numbers(inverse_mass=b.nodes, decay=None, adj_decay=b.nodes)


def fill(b: Buffers, packed: torch.Tensor) -> None:
    """Take the drag's factors [B, 1]."""
    b.set_numbers("decay", packed[:, 0])


def fill_masses(b: Buffers, inverse: torch.Tensor) -> None:
    """Take the inverse masses [B, N], or [B, 1] for all nodes of a twin."""
    b.set_numbers("inverse_mass", inverse.expand(-1, b.nodes))


def pack_masses(values: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """The inverse masses [N], 1/kg, or [1] where all are 1 kg."""
    mass = values.get("mass")
    return values["drag"].detach().new_ones(1) if mass is None or not len(mass) else 1.0 / mass


def gradient(b: Buffers) -> torch.Tensor:
    """dL/d(delta) [B, 1]."""
    return b.get_numbers("adj_decay").sum(dim=1)[:, None]


@functools.cache
def functions(real: Any, width: int) -> Functions:
    """Functions for a scalar type, wp.float32 or wp.float64, and a number of lanes."""
    lane = lanes(real, width)
    Number, Vector, dot, scaled = lane.Number, lane.Vector, lane.dot, lane.scaled
    Model, State, _ = structs(real, width)
    one = wp.constant(real(1.0))

    @wp.func
    def move_controller(model: Model, state: State, step: int, slot: int, c: int, g: int):
        """Put a controller where it is at the end of a substep."""
        travel = state.end[c, g] - state.begin[c, g]
        fraction = Number()
        for q in range(width):
            fraction[q] = wp.min(real(step + 1) / model.counts[g][q], one)
        state.x[slot, model.nodes + c, g] = state.begin[c, g] + scaled(travel, fraction)
        state.v[slot, model.nodes + c, g] = scaled(travel, model.inverse_time[g])

    @wp.func
    def updated(v: Vector, force: Vector, gravity: Vector, dt: Number, decay: Number, light: Number) -> Vector:
        return scaled(v + scaled(scaled(force, light) + gravity, dt), decay)

    @wp.func
    def updated_adjoint(after: Vector, adj_after: Vector, dt: Number, decay: Number, light: Number):
        # In terms of v' alone: the substep keeps neither the force nor the velocity before the drag.
        adj_decay = wp.cw_div(dot(adj_after, after), decay)
        adj_v = scaled(adj_after, decay)
        return adj_v, scaled(scaled(adj_v, dt), light), adj_decay

    return Functions(move_controller, updated, updated_adjoint)
