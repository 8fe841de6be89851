"""Motion and its adjoints: controllers, velocities, and positions with or without a ground plane z = 0 (the paper's equation 4).

    x_c = begin + (end - begin) (k + 1) / n in substep k of n
    v' = (v + dt (f / m + g)) delta,   delta = exp(-dt drag)
    x' = x + dt v'

Drag is dv/dt = -drag v. The update uses the exact solution over a substep, so any value is stable. The default mass m is 1 kg.

With ground, a node that moves down and would be below ground at the end of the substep is reflected at its time of impact toi =
-z / v_z: x' = x + v toi + v' (dt - toi). All contacts (collision.py) have the same response, an impulse with elasticity e in [0,
1] and friction mu in [0, 2]. It changes a relative velocity u = u_n + u_t (normal, tangential) to

    -e u_n + a u_t,   a = max(0, 1 - mu (1 + e) |u_n| / |u_t|).

`reference.bounce` is the float64 specification.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any

import warp as wp

from neuspring.physics.arrays import structs
from neuspring.physics.lanes import lanes

APPROACH = 1e-4
"""Slowest approach that collides: m/s for the ground; m^2/s, distance times speed, for pairs."""
MIN_TANGENT = 1e-6
"""Smallest tangential speed in divisions, m/s."""


@functools.cache
def velocity(real: Any, width: int) -> tuple[Any, Any, Any]:
    """Three functions for a scalar type, wp.float32 or wp.float64, and a number of lanes:

    move_controller    moves a controller to its position at the end of a substep
    updated            (v, force, gravity, dt, delta, 1 / m) -> v'
    updated_adjoint    (v', dL/dv', dt, delta, 1 / m) -> dL/d(v), dL/d(force), dL/d(delta)
    """
    lane = lanes(real, width)
    Number, Vector, dot, scaled = lane.Number, lane.Vector, lane.dot, lane.scaled
    Model, State, _ = structs(real, width)
    one = real(1.0)

    @wp.func
    def move_controller(model: Model, state: State, step: int, slot: int, c: int, g: int):
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
        # In terms of v' only, because a substep stores neither the force nor the velocity before drag.
        adj_decay = wp.cw_div(dot(adj_after, after), decay)
        adj_v = scaled(adj_after, decay)
        return adj_v, scaled(scaled(adj_v, dt), light), adj_decay

    return move_controller, updated, updated_adjoint


@functools.cache
def position(real: Any, width: int) -> tuple[Any, Any]:
    """Two functions for a scalar type and a number of lanes:

    moved            (x, v, dt, up, e, mu) -> x', v'
    moved_adjoint    (x, v, dt, up, e, mu, dL/dx', dL/dv') -> dL/d(x), dL/d(v), dL/d(e), dL/d(mu)
    """
    lane = lanes(real, width)
    Number, Vector, scaled, column, put = lane.Number, lane.Vector, lane.scaled, lane.column, lane.put
    vec3 = wp.types.vector(3, real)
    zero, one = real(0.0), real(1.0)
    approach, floor = real(APPROACH), real(MIN_TANGENT)

    @wp.func
    def count() -> int:
        """The width, but not as a constant, so that loops over rare cases are not unrolled."""
        return wp.int32(width)

    @wp.func
    def falls(z: real, speed: real, dt: real, up: real) -> bool:
        """True if a node moves down and would be below ground at the end of the substep; False without ground (up = 0)."""
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
        # Few nodes are at the ground, so one check of all lanes comes first.
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
        """Adjoints of x, v, e and mu of a reflected node."""
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

    return moved, moved_adjoint
