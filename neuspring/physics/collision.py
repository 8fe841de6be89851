"""Self-collision by impulses between near nodes (Jacobi), and its adjoint.

Node i takes the mean impulse over its listed partners that are closer than the contact distance and approach, by the response
of contact.py. Partners are listed once per frame, those with the lowest indices where they are more than the list holds.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any, NamedTuple

import warp as wp

from neuspring.physics import contact
from neuspring.physics.buffers import Buffers, array_types


class Kernels(NamedTuple):
    """Kernels of this file for one scalar type."""

    candidates: Any
    collide: Any
    collide_adjoint: Any


def allocate(b: Buffers) -> None:
    """Response and distance; with self-collision also the lists of partners and the velocities after collisions."""
    b.add(contact=(2,), distance=(1,), adj_contact_e=(b.nodes,), adj_contact_mu=(b.nodes,))
    if b.simulation.self_collision:
        b.add_integers(partners=(b.nodes, b.simulation.collision_capacity), count=(b.nodes,), overflow=(b.nodes,))
        b.add(moving=(b.history, b.nodes, 3), adj_after=(b.nodes, 3))


def find_candidates(b: Buffers) -> None:
    """List the partners of every node at the start of the frame, in node order.

    All pairs are looked at. A hash grid is slower for a few hundred nodes, and saves 7 % of a frame of 667 substeps at 2,000 nodes
    (one CPU thread, see the README).
    """
    model = (b.nodes, b.distance, b.simulation.collision_capacity)
    b.launch(kernels(b.real).candidates, b.nodes, *model, b.x, b.partners, b.count, b.overflow)


def collide(b: Buffers, step: int) -> None:
    """Velocities after the impulses."""
    model, state = (b.distance, b.contact, b.partners, b.count), (b.x, b.slot(step), b.after, b.inner_slot(step))
    b.launch(kernels(b.real).collide, b.nodes, *model, *state, b.moving)


def collide_adjoint(b: Buffers, step: int) -> None:
    """From dL/d(velocities after the impulses), in adj_v, to those before, in adj_after, and to dL/d(x, e, mu)."""
    b.adj_after.zero_()
    model, state = (b.distance, b.contact, b.partners, b.count), (b.x, b.slot(step), b.after, b.adj_v)
    b.launch(kernels(b.real).collide_adjoint, b.nodes, *model, *state, b.adj_after, b.adj_x, b.adj_contact_e, b.adj_contact_mu)


@functools.cache
def kernels(real: Any) -> Kernels:
    """Kernels for the scalar type `real`, wp.float32 or wp.float64."""
    vec3, numbers, vectors, states = array_types(real)
    integers: Any = wp.array(dtype=int)
    table: Any = wp.array2d(dtype=int)
    zero, half, one = wp.constant(real(0.0)), wp.constant(real(0.5)), wp.constant(real(1.0))
    approach, floor = wp.constant(real(contact.APPROACH)), wp.constant(real(contact.MIN_TANGENT))

    def find_candidates(
        nodes: int, distance: numbers, capacity: int, x: states, partners: table, count: integers, overflow: integers
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
        distance: numbers,
        response: numbers,
        partners: table,
        count: integers,
        x: states,
        slot: int,
        v: states,
        v_slot: int,
        after: states,
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
        distance: numbers,
        response: numbers,
        partners: table,
        count: integers,
        x: states,
        slot: int,
        v: states,
        adj_after: vectors,
        adj_v: vectors,
        adj_x: vectors,
        adj_e: numbers,
        adj_mu: numbers,
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

    unique = wp.kernel(module="unique", enable_backward=False)
    return Kernels(unique(find_candidates), unique(collide), unique(collide_adjoint))
