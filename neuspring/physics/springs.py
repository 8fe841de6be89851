"""Spring and dashpot forces (the paper's equations 2 and 3), and their adjoint.

With d = (x_j - x_i) / l, l = |x_j - x_i|, strain s = l / l0 - 1 and closing speed w = (v_j - v_i) . d, spring e = (i, j) adds

    f_e = (Y s + gamma w) d        to node i, and -f_e to node j.

Per-spring parameters are packed as (Y [N], 1 / l0 [1/m], gamma [N s/m]) so that one load serves a spring; the adjoint
accumulates (dL/dY, (1/Y) dL/d(1/l0), dL/dgamma) the same way.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
import warp as wp

from neuspring.physics.buffers import Buffers, array_types

MIN_LENGTH = 1e-6
"""Lengths are floored here when a direction is formed, m."""


def pack(values: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Parameters [S, 3] of springs."""
    stiffness = values["stiffness"]
    return torch.stack([stiffness, 1.0 / values["rest_lengths"], values["dashpot"].expand_as(stiffness)], dim=1)


def allocate(b: Buffers, pairs: np.ndarray) -> None:
    """Springs between `pairs` [S, 2] of points; i >= N means controller i - N."""
    b.views["pairs"] = wp.array(np.ascontiguousarray(pairs, np.int32), dtype=wp.vec2i, device=b.device)
    b.add(springs=(len(pairs), 3), adj_springs=(len(pairs), 3))


def add_forces(b: Buffers, step: int) -> None:
    """Add every spring's force to its two ends."""
    force, _ = kernels(b.real)
    b.launch(force, len(b.pairs), b.pairs, b.springs, b.x, b.v, b.slot(step), b.force)


def add_forces_adjoint(b: Buffers, step: int) -> None:
    """From dL/d(force) to dL/d(x, v, parameters)."""
    _, adjoint = kernels(b.real)
    state = (b.x, b.v, b.slot(step), b.adj_force)
    b.launch(adjoint, len(b.pairs), b.pairs, b.springs, *state, b.adj_x, b.adj_v, b.adj_springs)


def gradient(b: Buffers) -> torch.Tensor:
    """dL/d(packed parameters) [S, 3]."""
    result = b.tensors["adj_springs"].clone()
    result[:, 1] *= b.tensors["springs"][:, 0]
    return result


@functools.cache
def kernels(real: Any) -> tuple[Any, Any]:
    """(force, adjoint) kernels for the scalar type `real`, wp.float32 or wp.float64."""
    vec3, _, vectors, states = array_types(real)
    pairs: Any = wp.array(dtype=wp.vec2i)
    floor = wp.constant(real(MIN_LENGTH))
    one = wp.constant(real(1.0))

    def spring_force(springs: pairs, parameters: vectors, x: states, v: states, slot: int, force: vectors):
        e = wp.tid()
        i = springs[e][0]
        j = springs[e][1]
        p = parameters[e]
        offset = x[slot, j] - x[slot, i]
        length = wp.length(offset)
        d = offset / wp.max(length, floor)
        magnitude = p[0] * (length * p[1] - one) + p[2] * wp.dot(v[slot, j] - v[slot, i], d)
        f = d * magnitude
        wp.atomic_add(force, i, f)
        wp.atomic_sub(force, j, f)

    def spring_force_adjoint(
        springs: pairs,
        parameters: vectors,
        x: states,
        v: states,
        slot: int,
        adj_force: vectors,
        adj_x: vectors,
        adj_v: vectors,
        adj_parameters: vectors,
    ):
        e = wp.tid()
        i = springs[e][0]
        j = springs[e][1]
        p = parameters[e]
        offset = x[slot, j] - x[slot, i]
        length = wp.length(offset)
        inverse = one / wp.max(length, floor)
        d = offset * inverse
        relative = v[slot, j] - v[slot, i]
        c = adj_force[i] - adj_force[j]
        cd = wp.dot(c, d)
        wd = wp.dot(relative, d)
        strain = length * p[1] - one
        magnitude = p[0] * strain + p[2] * wd
        # d(f.c)/d(offset): the direction turns (c and the relative velocity, without their parts along d), the length
        # stretches the spring (along d).
        turn = magnitude * inverse
        drift = cd * p[2] * inverse
        g = c * turn + relative * drift + d * (cd * p[0] * p[1] - cd * turn - wd * drift)
        h = d * (cd * p[2])
        wp.atomic_add(adj_x, j, g)
        wp.atomic_sub(adj_x, i, g)
        wp.atomic_add(adj_v, j, h)
        wp.atomic_sub(adj_v, i, h)
        adj_parameters[e] = adj_parameters[e] + vec3(cd * strain, cd * length, cd * wd)

    unique = wp.kernel(module="unique", enable_backward=False)
    return unique(spring_force), unique(spring_force_adjoint)
