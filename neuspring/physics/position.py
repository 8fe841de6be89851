"""Motion, with or without a ground plane z = 0, and its adjoint.

x' = x + dt v (the paper's equation 4). With ground, a node that would be below at the end of the substep and moves down is
reflected at its time of impact toi = -z / v_z: x' = x + v toi + v' (dt - toi), with v' by the response of contact.py.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any

import warp as wp

from neuspring.physics import contact
from neuspring.physics.buffers import Buffers, array_types


def allocate(b: Buffers) -> None:
    """The response, and its adjoints per node."""
    b.add(ground=(2,), adj_ground_e=(b.nodes,), adj_ground_mu=(b.nodes,))


def advance(b: Buffers, step: int) -> None:
    """x' and v'."""
    state = (b.moving, b.inner_slot(step), b.slot(step), b.slot(step + 1))
    b.launch(kernels(b.real)[0], b.nodes, b.simulation.substep, _up(b), b.ground, *state, b.x, b.v)


def advance_adjoint(b: Buffers, step: int) -> None:
    """From dL/d(x', v') to dL/d(x, v, e, mu)."""
    state, adjoints = (b.x, b.slot(step), b.moving), (b.adj_x, b.adj_v, b.adj_ground_e, b.adj_ground_mu)
    b.launch(kernels(b.real)[1], b.nodes, b.simulation.substep, _up(b), b.ground, *state, *adjoints)


def _up(b: Buffers) -> float:
    """The sign of up; 0, below which no node can be, without ground."""
    return b.simulation.up_sign if b.simulation.ground else 0.0


@functools.cache
def kernels(real: Any) -> tuple[Any, Any]:
    """(motion, adjoint) kernels for the scalar type `real`, wp.float32 or wp.float64."""
    vec3, numbers, vectors, states = array_types(real)
    zero, one = wp.constant(real(0.0)), wp.constant(real(1.0))
    approach, floor = wp.constant(real(contact.APPROACH)), wp.constant(real(contact.MIN_TANGENT))

    def ground(
        dt: real, up: real, response: numbers, moving: states, moving_slot: int, slot: int, target: int, x: states, v: states
    ):
        i = wp.tid()
        p = x[slot, i]
        w = moving[moving_slot, i]
        if (p[2] + w[2] * dt) * up < zero and w[2] * up < -approach:
            e = response[0]
            t = wp.max(wp.sqrt(w[0] * w[0] + w[1] * w[1]), floor)
            a = wp.max(zero, one - response[1] * (one + e) * wp.abs(w[2]) / t)
            bounced = vec3(a * w[0], a * w[1], -e * w[2])
            toi = -p[2] / w[2]
            x[target, i] = p + w * toi + bounced * (dt - toi)
            v[target, i] = bounced
        else:
            x[target, i] = p + w * dt
            v[target, i] = w

    def ground_adjoint(
        dt: real,
        up: real,
        response: numbers,
        x: states,
        slot: int,
        moving: states,
        adj_x: vectors,
        adj_v: vectors,
        adj_e: numbers,
        adj_mu: numbers,
    ):
        i = wp.tid()
        p = x[slot, i]
        w = moving[slot, i]
        hx = adj_x[i]
        if (p[2] + w[2] * dt) * up < zero and w[2] * up < -approach:
            e = response[0]
            mu = response[1]
            t = wp.sqrt(w[0] * w[0] + w[1] * w[1])
            tf = wp.max(t, floor)
            a = wp.max(zero, one - mu * (one + e) * wp.abs(w[2]) / tf)
            bounced = vec3(a * w[0], a * w[1], -e * w[2])
            toi = -p[2] / w[2]
            h = adj_v[i] + hx * (dt - toi)
            htoi = wp.dot(hx, w - bounced)
            ha = h[0] * w[0] + h[1] * w[1]
            gx = hx[0] * toi + a * h[0]
            gy = hx[1] * toi + a * h[1]
            gz = hx[2] * toi - e * h[2] + htoi * p[2] / (w[2] * w[2])
            he = -h[2] * w[2]
            if a > zero:
                adj_mu[i] = adj_mu[i] - ha * (one + e) * wp.abs(w[2]) / tf
                he = he - ha * mu * wp.abs(w[2]) / tf
                gz = gz - wp.sign(w[2]) * ha * mu * (one + e) / tf
                if t > floor:
                    ht = ha * mu * (one + e) * wp.abs(w[2]) / (tf * tf * t)
                    gx = gx + ht * w[0]
                    gy = gy + ht * w[1]
            adj_e[i] = adj_e[i] + he
            adj_v[i] = vec3(gx, gy, gz)
            adj_x[i] = vec3(hx[0], hx[1], hx[2] - htoi / w[2])
        else:
            adj_v[i] = adj_v[i] + hx * dt

    unique = wp.kernel(module="unique", enable_backward=False)
    return unique(ground), unique(ground_adjoint)
