"""Controller motion, and the velocity update by force, gravity and drag (the paper's equation 4) with its adjoint.

v' = (v + dt (f + g)) delta,   delta = exp(-dt drag),   unit mass. Positions follow in position.py.
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
    """(v, force, gravity, dt, delta) -> v'."""
    updated_adjoint: Any
    """(v', dL/dv', dt, delta) -> dL/d(v), dL/d(force), dL/d(delta)."""


def pack(values: Mapping[str, torch.Tensor], substep: float | torch.Tensor) -> torch.Tensor:
    """delta [1], the factor left on velocities after a substep."""
    return torch.exp(-substep * values["drag"]).reshape(*values["drag"].shape, 1)


def allocate(b: Buffers) -> None:
    """The drag's factor, and its adjoint per node."""
    b.add_numbers(decay=None, adj_decay=b.nodes)


def gradient(b: Buffers) -> torch.Tensor:
    """dL/d(delta) [B, 1]."""
    return b.get_numbers("adj_decay").sum(dim=1, keepdim=True)


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
    def updated(v: Vector, force: Vector, gravity: Vector, dt: Number, decay: Number) -> Vector:
        return scaled(v + scaled(force + gravity, dt), decay)

    @wp.func
    def updated_adjoint(after: Vector, adj_after: Vector, dt: Number, decay: Number):
        h = scaled(adj_after, decay)
        return h, scaled(h, dt), wp.cw_div(dot(adj_after, after), decay)

    return Functions(move_controller, updated, updated_adjoint)
