"""Motion among static obstacles, with or without a ground plane z = 0, and its adjoint. Used only where there are obstacles.

A node at x with velocity v that would pass a surface inwards within the substep is reflected at its time of impact, as by the
ground (motion.py). With n the outward normal, d the distance of x from the surface along n, and s = v . n < 0,

    toi = -d / s,   x' = x + v toi + v' (dt - toi),   v' = a (v - s n) - e s n    (with the ground's e and mu).

The surface is that of the box's face through which the node enters (inside already: of the nearest face), or the sphere's tangent
plane nearest to x. Of several contacts, the ground among them, the one that is first in time acts.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any

import numpy as np
import torch
import warp as wp

from neuspring.physics.arrays import Buffers
from neuspring.physics.lanes import lanes
from neuspring.physics.motion import APPROACH, MIN_TANGENT

NO_IMPACT_TIME = 1e30
"""s; the time of an impact that does not come."""


def allocate(b: Buffers) -> None:
    """The obstacles [O, 16] of the simulation (core/geometry.py)."""
    rows = np.array([obstacle.row() for obstacle in b.simulation.obstacles], np.float64).reshape(-1, 16)
    b.constants["obstacles"] = torch.tensor(rows, dtype=b.dtype, device=b.device)
    b.views["obstacles"] = wp.from_torch(b.constants["obstacles"], dtype=b.real)


@functools.cache
def position(real: Any, width: int) -> tuple[Any, Any]:
    """Functions for a scalar type and a number of lanes: those of motion.py, among obstacles [O, 16]."""
    lane = lanes(real, width)
    Number, Vector, scaled, column, put = lane.Number, lane.Vector, lane.scaled, lane.column, lane.put
    vec3 = wp.types.vector(3, real)
    Table: Any = wp.array2d(dtype=real)
    zero, one, never = wp.constant(real(0.0)), wp.constant(real(1.0)), wp.constant(real(NO_IMPACT_TIME))
    approach, floor = wp.constant(real(APPROACH)), wp.constant(real(MIN_TANGENT))

    @wp.func
    def count() -> int:
        """The width, but no constant: this loop is not unrolled."""
        return wp.int32(width)

    @wp.func
    def box_contact(p: vec3, w: vec3, table: Table, o: int):
        """The axis of the face through which a node enters a box, or of the nearest face if it is inside; -1: none."""
        away = p - vec3(table[o, 1], table[o, 2], table[o, 3])
        inside = wp.int32(1)
        axis = wp.int32(-1)
        nearest = -real(NO_IMPACT_TIME)
        latest = -real(NO_IMPACT_TIME)
        entry = wp.int32(-1)
        for k in range(3):
            a = vec3(table[o, 4 + 3 * k], table[o, 5 + 3 * k], table[o, 6 + 3 * k])
            q = wp.dot(away, a)
            gap = wp.abs(q) - table[o, 13 + k]
            if gap > nearest:
                nearest = gap
                axis = k
            if gap > zero:
                inside = 0
                closing = wp.dot(w, a) * wp.sign(q)
                t = never
                if closing < zero:
                    t = -gap / closing
                if t > latest:
                    latest = t
                    entry = k
        if inside == 0:
            axis = entry
            # Where it enters the last slab it must be within the two others.
            for k in range(3):
                a = vec3(table[o, 4 + 3 * k], table[o, 5 + 3 * k], table[o, 6 + 3 * k])
                if k != entry and wp.abs(wp.dot(away + w * latest, a)) > table[o, 13 + k]:
                    axis = -1
        return axis

    @wp.func
    def first(p: vec3, w: vec3, dt: real, up: real, table: Table):
        """The contact that is first: obstacle (-1 the ground, -2 none), distance, normal, distance from a sphere's center."""
        hit = wp.int32(-2)
        soonest = real(NO_IMPACT_TIME)
        d = real(0.0)
        n = vec3()
        length = real(0.0)
        if (p[2] + w[2] * dt) * up < zero and w[2] * up < -approach:
            hit = -1
            soonest = -p[2] / w[2]
            d = p[2] * up
            n = vec3(zero, zero, up)
        for o in range(table.shape[0]):
            gap = real(0.0)
            normal = vec3()
            radius = real(0.0)
            found = wp.int32(0)
            if table[o, 0] > zero:
                away = p - vec3(table[o, 1], table[o, 2], table[o, 3])
                radius = wp.length(away)
                if radius > zero and wp.length(away + w * dt) < table[o, 13]:
                    found = 1
                    normal = away / radius
                    gap = radius - table[o, 13]
            else:
                k = box_contact(p, w, table, o)
                if k >= 0:
                    a = vec3(table[o, 4 + 3 * k], table[o, 5 + 3 * k], table[o, 6 + 3 * k])
                    q = wp.dot(p - vec3(table[o, 1], table[o, 2], table[o, 3]), a)
                    found = 1
                    normal = a * wp.sign(q)
                    gap = wp.abs(q) - table[o, 13 + k]
            s = wp.dot(w, normal)
            if found == 1 and s < -approach and gap + s * dt < zero and -gap / s < soonest:
                hit = o
                soonest = -gap / s
                d = gap
                n = normal
                length = radius
        return hit, d, n, length

    @wp.func
    def bounced(w: vec3, n: vec3, e: real, mu: real) -> vec3:
        s = wp.dot(w, n)
        tangent = w - n * s
        a = wp.max(zero, one - mu * (one + e) * wp.abs(s) / wp.max(wp.length(tangent), floor))
        return tangent * a - n * (e * s)

    @wp.func
    def moved(p: Vector, w: Vector, dt: Number, up: real, e: Number, mu: Number, table: Table):
        x = p + scaled(w, dt)
        v = w
        for q in range(count()):
            hit, d, n, _ = first(column(p, q), column(w, q), dt[q], up, table)
            if hit > -2:
                after = bounced(column(w, q), n, e[q], mu[q])
                toi = -d / wp.dot(column(w, q), n)
                x = put(x, q, column(p, q) + column(w, q) * toi + after * (dt[q] - toi))
                v = put(v, q, after)
        return x, v

    @wp.func
    def bounce_adjoint(w: vec3, n: vec3, d: real, length: real, dt: real, e: real, mu: real, hx: vec3, hv: vec3):
        """Adjoints of x, v, e and mu of a node that is reflected; `length` is 0 where the normal does not turn with x."""
        s = wp.dot(w, n)
        tangent = w - n * s
        t = wp.length(tangent)
        tf = wp.max(t, floor)
        a = wp.max(zero, one - mu * (one + e) * wp.abs(s) / tf)
        toi = -d / s
        h = hv + hx * (dt - toi)
        htoi = wp.dot(hx, w - tangent * a + n * (e * s))
        ha = wp.dot(h, tangent)
        ht = h * a
        hs = htoi * d / (s * s) - e * wp.dot(h, n)
        hn = h * (-e * s)
        he = -s * wp.dot(h, n)
        hmu = zero
        if a > zero:
            hmu = -ha * (one + e) * wp.abs(s) / tf
            he = he - ha * mu * wp.abs(s) / tf
            hs = hs - wp.sign(s) * ha * mu * (one + e) / tf
            if t > floor:
                ht = ht + tangent * (ha * mu * (one + e) * wp.abs(s) / (tf * tf * t))
        hs = hs - wp.dot(ht, n)
        hn = hn - ht * s + w * hs
        gx = hx - n * (htoi / s)
        if length > zero:
            gx = gx + (hn - n * wp.dot(n, hn)) / length
        return gx, hx * toi + ht + n * hs, he, hmu

    @wp.func
    def moved_adjoint(p: Vector, w: Vector, dt: Number, up: real, e: Number, mu: Number, hx: Vector, hv: Vector, table: Table):
        adj_x = hx
        adj_v = hv + scaled(hx, dt)
        adj_e = Number()
        adj_mu = Number()
        for q in range(count()):
            hit, d, n, length = first(column(p, q), column(w, q), dt[q], up, table)
            if hit > -2:
                gx, gv, ge, gmu = bounce_adjoint(column(w, q), n, d, length, dt[q], e[q], mu[q], column(hx, q), column(hv, q))
                adj_x = put(adj_x, q, gx)
                adj_v = put(adj_v, q, gv)
                adj_e[q] = ge
                adj_mu[q] = gmu
        return adj_x, adj_v, adj_e, adj_mu

    return moved, moved_adjoint
