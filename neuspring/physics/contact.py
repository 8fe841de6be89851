"""Ground contact and self-collision as impulses, and their adjoints.

Both use the same response with elasticity e and friction mu: a relative velocity u = u_n + u_t (normal, tangential) becomes

    -e u_n + a u_t,   a = max(0, 1 - mu (1 + e) |u_n| / |u_t|).

Ground (plane z = 0): a node that would be below at the end of the substep and moves down is reflected at its time of impact
toi = -z / v_z:  x' = x + v toi + v' (dt - toi). Self-collision (Jacobi): node i takes the mean impulse over its listed
partners that are closer than the contact distance and approach. `response` holds (e, mu).
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any, NamedTuple

import warp as wp

APPROACH = 1e-4
"""Slower approaches do not collide (m/s for the ground; m^2/s, distance times speed, for pairs)."""
MIN_TANGENT = 1e-6
"""Tangential speeds are floored here when dividing, m/s."""


class Kernels(NamedTuple):
    """Kernels of this file for one scalar type."""

    candidates: Any
    collide: Any
    collide_adjoint: Any
    ground: Any
    ground_adjoint: Any


@functools.cache
def kernels(real: Any) -> Kernels:
    """Kernels for the scalar type `real`, wp.float32 or wp.float64."""
    vec3 = wp.types.vector(3, real)
    zero, half, one = wp.constant(real(0.0)), wp.constant(real(0.5)), wp.constant(real(1.0))
    approach, floor = wp.constant(real(APPROACH)), wp.constant(real(MIN_TANGENT))

    def find_candidates(
        x: wp.array2d(dtype=vec3),
        nodes: int,
        distance: wp.array(dtype=real),
        capacity: int,
        partners: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        overflow: wp.array(dtype=int),
    ):
        i = wp.tid()
        # wp.int32(0), not 0: Warp takes a bare literal for a constant, which a loop may not change.
        found = wp.int32(0)
        reach = distance[0]
        xi = x[0, i]
        for j in range(nodes):
            offset = x[0, j] - xi
            # The nested test is cheap first: most nodes are far along x already.
            if wp.abs(offset[0]) < reach and j != i:  # noqa: SIM102
                if wp.length(offset) < reach:
                    if found < capacity:
                        partners[i, found] = j
                    found = found + 1
        count[i] = wp.min(found, capacity)
        overflow[i] = overflow[i] + wp.max(found - capacity, 0)

    def collide(
        x: wp.array2d(dtype=vec3),
        slot: int,
        v: wp.array2d(dtype=vec3),
        v_slot: int,
        distance: wp.array(dtype=real),
        response: wp.array(dtype=real),
        partners: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        after: wp.array2d(dtype=vec3),
    ):
        i = wp.tid()
        e = response[0]
        mu = response[1]
        total = vec3(zero, zero, zero)
        hits = wp.int32(0)
        for k in range(count[i]):
            j = partners[i, k]
            dx = x[slot, j] - x[slot, i]
            u = v[v_slot, j] - v[v_slot, i]
            length = wp.length(dx)
            if length < distance[0] and wp.dot(dx, u) < -approach:
                n = dx / wp.max(length, floor)
                s = wp.dot(u, n)
                ut = u - n * s
                a = wp.max(zero, one - mu * (one + e) * wp.abs(s) / wp.max(wp.length(ut), floor))
                total = total + (ut * (a - one) - n * ((one + e) * s)) * half
                hits = hits + 1
        if hits > 0:
            after[v_slot, i] = v[v_slot, i] - total / real(hits)
        else:
            after[v_slot, i] = v[v_slot, i]

    def collide_adjoint(
        x: wp.array2d(dtype=vec3),
        slot: int,
        v: wp.array2d(dtype=vec3),
        distance: wp.array(dtype=real),
        response: wp.array(dtype=real),
        partners: wp.array2d(dtype=int),
        count: wp.array(dtype=int),
        adj_after: wp.array(dtype=vec3),
        adj_v: wp.array(dtype=vec3),
        adj_x: wp.array(dtype=vec3),
        adj_e: wp.array(dtype=real),
        adj_mu: wp.array(dtype=real),
    ):
        i = wp.tid()
        e = response[0]
        mu = response[1]
        h = adj_after[i]
        hits = wp.int32(0)
        for k in range(count[i]):
            j = partners[i, k]
            dx = x[slot, j] - x[slot, i]
            u = v[slot, j] - v[slot, i]
            if wp.length(dx) < distance[0] and wp.dot(dx, u) < -approach:
                hits = hits + 1
        wp.atomic_add(adj_v, i, h)
        if hits > 0:
            g = h * (-half / real(hits))
            for k in range(count[i]):
                j = partners[i, k]
                dx = x[slot, j] - x[slot, i]
                u = v[slot, j] - v[slot, i]
                length = wp.length(dx)
                if length < distance[0] and wp.dot(dx, u) < -approach:
                    inverse = one / wp.max(length, floor)
                    n = dx * inverse
                    s = wp.dot(u, n)
                    ut = u - n * s
                    t = wp.length(ut)
                    tf = wp.max(t, floor)
                    a = wp.max(zero, one - mu * (one + e) * wp.abs(s) / tf)
                    gn = wp.dot(g, n)
                    ha = wp.dot(g, ut)
                    hs = -(a + e) * gn
                    hn = g * (-(a + e) * s)
                    hu = g * (a - one)
                    he = -s * gn
                    if a > zero:
                        adj_mu[i] = adj_mu[i] - ha * (one + e) * wp.abs(s) / tf
                        he = he - ha * mu * wp.abs(s) / tf
                        hs = hs - wp.sign(s) * ha * mu * (one + e) / tf
                        if t > floor:
                            ht = ut * (ha * mu * (one + e) * wp.abs(s) / (tf * tf * t))
                            hu = hu + ht
                            hs = hs - wp.dot(ht, n)
                            hn = hn - ht * s
                    adj_e[i] = adj_e[i] + he
                    hu = hu + n * hs
                    hn = hn + u * hs
                    hx = (hn - n * wp.dot(hn, n)) * inverse
                    wp.atomic_add(adj_x, j, hx)
                    wp.atomic_sub(adj_x, i, hx)
                    wp.atomic_add(adj_v, j, hu)
                    wp.atomic_sub(adj_v, i, hu)

    def ground(
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        slot: int,
        target: int,
        moving: wp.array2d(dtype=vec3),
        moving_slot: int,
        dt: real,
        up: real,
        response: wp.array(dtype=real),
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
        x: wp.array2d(dtype=vec3),
        slot: int,
        moving: wp.array2d(dtype=vec3),
        dt: real,
        up: real,
        response: wp.array(dtype=real),
        adj_x: wp.array(dtype=vec3),
        adj_v: wp.array(dtype=vec3),
        adj_e: wp.array(dtype=real),
        adj_mu: wp.array(dtype=real),
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
    return Kernels(unique(find_candidates), unique(collide), unique(collide_adjoint), unique(ground), unique(ground_adjoint))
