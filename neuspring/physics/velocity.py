"""Controller motion, and the velocity update by force, gravity and drag (the paper's equation 4) with its adjoint.

v' = (v + dt (f + g)) delta,   delta = exp(-dt drag),   unit mass. Positions follow in position.py.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
import warp as wp

from neuspring.physics.buffers import Buffers, array_types


class Kernels(NamedTuple):
    """Kernels of this file for one scalar type."""

    controllers: Any
    velocity: Any
    velocity_adjoint: Any


def pack(values: Mapping[str, torch.Tensor], substep: float) -> torch.Tensor:
    """delta [1], the factor left on velocities after a substep."""
    return torch.exp(-substep * values["drag"]).reshape(1)


def allocate(b: Buffers) -> None:
    """The drag's factor."""
    b.add(decay=(1,), adj_decay=(b.nodes,))


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
    b.launch(kernels(b.real).velocity, b.nodes, gravity, sim.substep, b.decay, *state, b.after, b.inner_slot(step))


def update_velocity_adjoint(b: Buffers, step: int) -> None:
    """From dL/dv' to dL/d(v, force, delta)."""
    state = (b.after, b.inner_slot(step), b.adj_after)
    adjoints = (b.adj_v, b.adj_force, b.adj_decay)
    b.launch(kernels(b.real).velocity_adjoint, b.nodes, b.simulation.substep, b.decay, *state, *adjoints)


def gradient(b: Buffers) -> torch.Tensor:
    """dL/d(delta) [1]."""
    return b.tensors["adj_decay"].sum().reshape(1)


@functools.cache
def kernels(real: Any) -> Kernels:
    """Kernels for the scalar type `real`, wp.float32 or wp.float64."""
    vec3, numbers, vectors, states = array_types(real)
    zero = wp.constant(real(0.0))

    def move_controllers(
        begin: vectors,
        end: vectors,
        fraction: real,
        inverse_time: real,
        nodes: int,
        x: states,
        v: states,
        slot: int,
        force: vectors,
    ):
        c = wp.tid()
        travel = end[c] - begin[c]
        x[slot, nodes + c] = begin[c] + travel * fraction
        v[slot, nodes + c] = travel * inverse_time
        force[nodes + c] = vec3(zero, zero, zero)

    def update_velocity(
        gravity: vec3, dt: real, decay: numbers, v: states, slot: int, force: vectors, after: states, after_slot: int
    ):
        i = wp.tid()
        after[after_slot, i] = (v[slot, i] + (force[i] + gravity) * dt) * decay[0]
        force[i] = vec3(zero, zero, zero)

    def update_velocity_adjoint(
        dt: real,
        decay: numbers,
        after: states,
        slot: int,
        adj_after: vectors,
        adj_v: vectors,
        adj_force: vectors,
        adj_decay: numbers,
    ):
        i = wp.tid()
        h = adj_after[i]
        adj_decay[i] = adj_decay[i] + wp.dot(h, after[slot, i]) / decay[0]
        h = h * decay[0]
        adj_v[i] = h
        adj_force[i] = h * dt

    unique = wp.kernel(module="unique", enable_backward=False)
    return Kernels(unique(move_controllers), unique(update_velocity), unique(update_velocity_adjoint))
