"""Controller motion, velocity update (force, gravity, drag) and free motion (the paper's equation 4), and their adjoints.

v' = (v + dt (f + g)) delta,   delta = exp(-dt drag),   unit mass          (velocity)
x' = x + dt v'                                                              (advance; ground.py has the version with ground)
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
import warp as wp

from neuspring.physics.buffers import Buffers


class Kernels(NamedTuple):
    """Kernels of this file for one scalar type."""

    controllers: Any
    velocity: Any
    velocity_adjoint: Any
    advance: Any
    advance_adjoint: Any


def pack(values: Mapping[str, torch.Tensor], substep: float) -> torch.Tensor:
    """delta [1], the factor left on velocities after a substep."""
    return torch.exp(-substep * values["drag"]).reshape(1)


def allocate(b: Buffers) -> None:
    """The drag's factor."""
    b.add_scalars(decay=1)
    b.add_adjoints(adj_decay=(b.nodes,))


def move_controllers(b: Buffers, step: int) -> None:
    """Put the controllers where they are at the end of the substep; their forces are cleared."""
    sim = b.simulation
    fraction, inverse_time = (step + 1) / sim.substeps, 1.0 / sim.frame_time if sim.controller_velocity else 0.0
    path = (b.begin, b.end, fraction, inverse_time, b.nodes)
    b.launch(kernels(b.real).controllers, b.controllers, *path, b.x, b.v, b.slot(step), b.force)


def update_velocity(b: Buffers, step: int) -> None:
    """v' from the forces, which are cleared for the next substep."""
    sim = b.simulation
    gravity = b.vec3(0.0, 0.0, -sim.gravity * sim.up_sign)
    state = (b.v, b.slot(step), b.force)
    b.launch(kernels(b.real).velocity, b.nodes, gravity, sim.substep, b.decay, *state, b.after, b.kept(step))


def update_velocity_adjoint(b: Buffers, step: int) -> None:
    """From dL/dv' to dL/d(v, force, delta)."""
    state = (b.after, b.kept(step), b.adj_after)
    adjoints = (b.adj_v, b.adj_force, b.adj_decay)
    b.launch(kernels(b.real).velocity_adjoint, b.nodes, b.simulation.substep, b.decay, *state, *adjoints)


def advance(b: Buffers, step: int) -> None:
    """x' without ground."""
    state = (b.moving, b.kept(step), b.slot(step), b.slot(step + 1))
    b.launch(kernels(b.real).advance, b.nodes, b.simulation.substep, *state, b.x, b.v)


def advance_adjoint(b: Buffers, step: int) -> None:
    """dL/dv' += dt dL/dx'."""
    b.launch(kernels(b.real).advance_adjoint, b.nodes, b.simulation.substep, b.adj_x, b.adj_v)


def gradient(b: Buffers) -> torch.Tensor:
    """dL/d(delta) [1]."""
    return b.tensors["adj_decay"].sum().reshape(1)


@functools.cache
def kernels(real: Any) -> Kernels:
    """Kernels for the scalar type `real`, wp.float32 or wp.float64."""
    vec3 = wp.types.vector(3, real)
    zero = wp.constant(real(0.0))

    def move_controllers(
        # model
        begin: wp.array(dtype=vec3),
        end: wp.array(dtype=vec3),
        fraction: real,
        inverse_time: real,
        nodes: int,
        # out
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        slot: int,
        force: wp.array(dtype=vec3),
    ):
        c = wp.tid()
        travel = end[c] - begin[c]
        x[slot, nodes + c] = begin[c] + travel * fraction
        v[slot, nodes + c] = travel * inverse_time
        force[nodes + c] = vec3(zero, zero, zero)

    def update_velocity(
        # model
        gravity: vec3,
        dt: real,
        decay: wp.array(dtype=real),
        # state
        v: wp.array2d(dtype=vec3),
        slot: int,
        force: wp.array(dtype=vec3),
        # out
        after: wp.array2d(dtype=vec3),
        after_slot: int,
    ):
        i = wp.tid()
        after[after_slot, i] = (v[slot, i] + (force[i] + gravity) * dt) * decay[0]
        force[i] = vec3(zero, zero, zero)

    def update_velocity_adjoint(
        # model
        dt: real,
        decay: wp.array(dtype=real),
        # state
        after: wp.array2d(dtype=vec3),
        slot: int,
        adj_after: wp.array(dtype=vec3),
        # out
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
        # model
        dt: real,
        # state
        moving: wp.array2d(dtype=vec3),
        moving_slot: int,
        slot: int,
        target: int,
        # out
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
    ):
        i = wp.tid()
        w = moving[moving_slot, i]
        x[target, i] = x[slot, i] + w * dt
        v[target, i] = w

    def advance_adjoint(dt: real, adj_x: wp.array(dtype=vec3), adj_v: wp.array(dtype=vec3)):
        i = wp.tid()
        adj_v[i] = adj_v[i] + adj_x[i] * dt

    unique = wp.kernel(module="unique", enable_backward=False)
    return Kernels(
        unique(move_controllers), unique(update_velocity), unique(update_velocity_adjoint), unique(advance), unique(advance_adjoint)
    )
