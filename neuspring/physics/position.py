"""Motion, with or without a ground plane z = 0, and its adjoint.

x' = x + dt v (the paper's equation 4). With ground, a node that would be below at the end of the substep and moves down is
reflected at its time of impact toi = -z / v_z: x' = x + v toi + v' (dt - toi), with v' by the response of contact.py.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any, NamedTuple

import warp as wp

from neuspring.physics import contact
from neuspring.physics.arrays import Buffers
from neuspring.physics.lanes import lanes


class Functions(NamedTuple):
    """Functions of this file for one scalar type and width."""

    moved: Any
    """(x, v, dt, up, e, mu) -> x', v'."""
    moved_adjoint: Any
    """(x, v, dt, up, e, mu, dL/dx', dL/dv') -> dL/d(x), dL/d(v), dL/d(e), dL/d(mu)."""


def allocate(b: Buffers) -> None:
    """The response, and its adjoints per node."""
    b.add_numbers(ground_e=None, ground_mu=None, adj_ground_e=b.nodes, adj_ground_mu=b.nodes)


@functools.cache
def functions(real: Any, width: int) -> Functions:
    """Functions for a scalar type, wp.float32 or wp.float64, and a number of lanes."""
    lane = lanes(real, width)
    Number, Vector, scaled, column, put = lane.Number, lane.Vector, lane.scaled, lane.column, lane.put
    vec3 = wp.types.vector(3, real)
    zero, one = wp.constant(real(0.0)), wp.constant(real(1.0))
    approach, floor = wp.constant(real(contact.APPROACH)), wp.constant(real(contact.MIN_TANGENT))

    @wp.func
    def count() -> int:
        """The width, but no constant: what is rarely done is not unrolled."""
        return wp.int32(width)

    @wp.func
    def falls(z: real, speed: real, dt: real, up: real) -> bool:
        """Whether a node would be below at the end of the substep and moves down; never without ground (up = 0)."""
        return (z + speed * dt) * up < zero and speed * up < -approach

    @wp.func
    def bounced(w: vec3, e: real, mu: real) -> vec3:
        t = wp.max(wp.sqrt(w[0] * w[0] + w[1] * w[1]), floor)
        a = wp.max(zero, one - mu * (one + e) * wp.abs(w[2]) / t)
        return vec3(a * w[0], a * w[1], -e * w[2])

    @wp.func
    def moved(p: Vector, w: Vector, dt: Number, up: real, e: Number, mu: Number):
        x = p + scaled(w, dt)
        v = w
        # Almost no node is at the ground: one look at all lanes first.
        if wp.min(x[2] * up) < zero:
            for q in range(count()):
                if falls(p[2, q], w[2, q], dt[q], up):
                    after = bounced(column(w, q), e[q], mu[q])
                    toi = -p[2, q] / w[2, q]
                    x = put(x, q, column(p, q) + column(w, q) * toi + after * (dt[q] - toi))
                    v = put(v, q, after)
        return x, v

    @wp.func
    def bounce_adjoint(p: vec3, w: vec3, dt: real, e: real, mu: real, hx: vec3, hv: vec3):
        """Adjoints of x, v, e and mu of a node that is reflected."""
        t = wp.sqrt(w[0] * w[0] + w[1] * w[1])
        tf = wp.max(t, floor)
        a = wp.max(zero, one - mu * (one + e) * wp.abs(w[2]) / tf)
        toi = -p[2] / w[2]
        h = hv + hx * (dt - toi)
        htoi = wp.dot(hx, w - vec3(a * w[0], a * w[1], -e * w[2]))
        ha = h[0] * w[0] + h[1] * w[1]
        gx = hx[0] * toi + a * h[0]
        gy = hx[1] * toi + a * h[1]
        gz = hx[2] * toi - e * h[2] + htoi * p[2] / (w[2] * w[2])
        he = -h[2] * w[2]
        hmu = zero
        if a > zero:
            hmu = -ha * (one + e) * wp.abs(w[2]) / tf
            he = he - ha * mu * wp.abs(w[2]) / tf
            gz = gz - wp.sign(w[2]) * ha * mu * (one + e) / tf
            if t > floor:
                ht = ha * mu * (one + e) * wp.abs(w[2]) / (tf * tf * t)
                gx = gx + ht * w[0]
                gy = gy + ht * w[1]
        return vec3(hx[0], hx[1], hx[2] - htoi / w[2]), vec3(gx, gy, gz), he, hmu

    @wp.func
    def moved_adjoint(p: Vector, w: Vector, dt: Number, up: real, e: Number, mu: Number, hx: Vector, hv: Vector):
        adj_x = hx
        adj_v = hv + scaled(hx, dt)
        adj_e = Number()
        adj_mu = Number()
        if wp.min((p[2] + wp.cw_mul(w[2], dt)) * up) < zero:
            for q in range(count()):
                if falls(p[2, q], w[2, q], dt[q], up):
                    gx, gv, ge, gmu = bounce_adjoint(column(p, q), column(w, q), dt[q], e[q], mu[q], column(hx, q), column(hv, q))
                    adj_x = put(adj_x, q, gx)
                    adj_v = put(adj_v, q, gv)
                    adj_e[q] = ge
                    adj_mu[q] = gmu
        return adj_x, adj_v, adj_e, adj_mu

    return Functions(moved, moved_adjoint)
