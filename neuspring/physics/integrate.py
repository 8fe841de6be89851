"""Velocity update (force, gravity, drag), free position update, controller motion, and their adjoints.

v' = (v + dt (f + g)) delta,   delta = exp(-dt drag),   unit mass          (velocity)
x' = x + dt v'                                                              (advance; contact.py has the version with ground)
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any, NamedTuple

import warp as wp


class Kernels(NamedTuple):
    """Kernels of this file for one scalar type."""

    controllers: Any
    velocity: Any
    velocity_adjoint: Any
    advance: Any
    advance_adjoint: Any


@functools.cache
def kernels(real: Any) -> Kernels:
    """Kernels for the scalar type `real`, wp.float32 or wp.float64."""
    vec3 = wp.types.vector(3, real)
    zero = wp.constant(real(0.0))

    def move_controllers(
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        slot: int,
        fraction: real,
        inverse_time: real,
        nodes: int,
        begin: wp.array(dtype=vec3),
        end: wp.array(dtype=vec3),
        force: wp.array(dtype=vec3),
    ):
        c = wp.tid()
        travel = end[c] - begin[c]
        x[slot, nodes + c] = begin[c] + travel * fraction
        v[slot, nodes + c] = travel * inverse_time
        force[nodes + c] = vec3(zero, zero, zero)

    def update_velocity(
        v: wp.array2d(dtype=vec3),
        slot: int,
        force: wp.array(dtype=vec3),
        gravity: vec3,
        dt: real,
        decay: wp.array(dtype=real),
        after: wp.array2d(dtype=vec3),
        after_slot: int,
    ):
        i = wp.tid()
        after[after_slot, i] = (v[slot, i] + (force[i] + gravity) * dt) * decay[0]
        force[i] = vec3(zero, zero, zero)

    def update_velocity_adjoint(
        after: wp.array2d(dtype=vec3),
        slot: int,
        dt: real,
        decay: wp.array(dtype=real),
        adj_after: wp.array(dtype=vec3),
        adj_v: wp.array(dtype=vec3),
        adj_force: wp.array(dtype=vec3),
        adj_decay: wp.array(dtype=real),
    ):
        i = wp.tid()
        h = adj_after[i]
        adj_decay[i] = adj_decay[i] + wp.dot(h, after[slot, i]) / decay[0]
        h = h * decay[0]
        adj_v[i] = h
        adj_force[i] = h * dt

    def advance(
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        slot: int,
        target: int,
        moving: wp.array2d(dtype=vec3),
        moving_slot: int,
        dt: real,
    ):
        i = wp.tid()
        w = moving[moving_slot, i]
        x[target, i] = x[slot, i] + w * dt
        v[target, i] = w

    def advance_adjoint(adj_x: wp.array(dtype=vec3), adj_v: wp.array(dtype=vec3), dt: real):
        i = wp.tid()
        adj_v[i] = adj_v[i] + adj_x[i] * dt

    unique = wp.kernel(module="unique", enable_backward=False)
    return Kernels(
        unique(move_controllers), unique(update_velocity), unique(update_velocity_adjoint), unique(advance), unique(advance_adjoint)
    )
