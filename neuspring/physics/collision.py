"""Self-collision by impulses between near nodes (Jacobi), and its adjoint.

Node i takes the mean impulse over its listed partners that are closer than the contact distance and approach, by the response of
contact.py. Partners are listed once per frame, from a hash grid with cells as wide as the contact distance, so that the cost
grows with the nodes. A list is in node order; those with the lowest indices stay where they are more than it holds. The twins of
a group share a list: a bit per lane says whose partner a node is.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any, NamedTuple

import torch
import warp as wp

from neuspring.physics import contact
from neuspring.physics.arrays import Buffers, structs
from neuspring.physics.lanes import lanes

CELLS = 64
"""Cells of the hash grid along each axis; farther cells share them."""
SHARED_ROOM = 2
"""A list of several twins holds this many times the partners that one twin may have."""


class Kernels(NamedTuple):
    """Kernels of this file for one scalar type and width."""

    place: Any
    find: Any


class Functions(NamedTuple):
    """Functions of this file for one scalar type and width."""

    collided: Any
    """(model, state, slot, inner slot, i, g) -> velocities of node i after the impulses."""
    collided_adjoint: Any


def allocate(b: Buffers) -> None:
    """Response and distance; with self-collision also the lists of partners and the velocities after collisions."""
    b.add_numbers(contact_e=None, contact_mu=None, distance=None, adj_contact_e=b.nodes, adj_contact_mu=b.nodes)
    if not b.simulation.self_collision:
        return
    capacity, twins = b.simulation.collision_capacity, b.groups * b.width
    room = min(capacity if b.width == 1 else SHARED_ROOM * capacity, b.nodes)
    device: dict[str, Any] = {"dtype": torch.int32, "device": b.device}
    tables = {name: torch.zeros((b.nodes, room, b.groups), **device) for name in ("near", "near_lanes")}
    tables |= {"near_count": torch.zeros((b.nodes, b.groups), **device)}
    tables |= {"overflow": torch.zeros((b.nodes, b.groups, b.width), **device)}
    b.indices |= tables
    b.views |= {name: wp.from_torch(tensor, dtype=wp.int32) for name, tensor in tables.items()}
    b.add_vectors(moving=(b.history, b.nodes), adj_moving=(b.nodes,))
    groups = torch.arange(twins, **device).repeat_interleave(b.nodes)
    b.indices["grid_groups"] = groups
    b.views["grid_groups"] = wp.from_torch(groups, dtype=wp.int32)
    b.tensors["grid_points"] = torch.zeros((twins * b.nodes, 3), dtype=b.dtype, device=b.device)
    b.views["grid_points"] = wp.from_torch(b.tensors["grid_points"], dtype=wp.types.vector(3, b.real))
    b.views["grid"] = wp.HashGrid(CELLS, CELLS, CELLS, device=b.device, dtype=b.real)


def overflow(b: Buffers) -> torch.Tensor:
    """Candidates that did not fit the lists so far, of each twin [B]."""
    if not b.simulation.self_collision:
        return torch.zeros(b.twins, dtype=torch.int64)
    return b.indices["overflow"].sum(dim=0).reshape(-1)[: b.twins].cpu()


def find_candidates(b: Buffers, reach: float) -> None:
    """List the partners of every node at the start of the frame; `reach` is the largest contact distance, m."""
    made, views, size = kernels(b.real, b.width), b.views, (b.nodes, b.groups)
    model, state, _ = b.arguments()
    b.launch(made.place, size, model, state, views["grid_points"])
    views["grid"].build(views["grid_points"], reach, groups=views["grid_groups"])
    b.launch(made.find, size, model, state, views["grid"].id, views["overflow"])


@functools.cache
def kernels(real: Any, width: int) -> Kernels:
    """Kernels for a scalar type, wp.float32 or wp.float64, and a number of lanes."""
    lane = lanes(real, width)
    Model, State, _ = structs(real, width)
    column = lane.column
    points: Any = wp.array(dtype=wp.types.vector(3, real))
    counts: Any = wp.array3d(dtype=int)

    def place(model: Model, state: State, grid_points: points):
        i, g = wp.tid()
        for q in range(width):
            grid_points[(g * width + q) * model.nodes + i] = column(state.x[0, i, g], q)

    def find(model: Model, state: State, grid: wp.uint64, overflow: counts):
        i, g = wp.tid()
        room = model.near.shape[1]
        count = wp.int32(0)
        for q in range(width):
            reach = model.distance[g][q]
            here = column(state.x[0, i, g], q)
            query = wp.hash_grid_query(grid, here, reach, g * width + q)
            candidate = wp.int32(0)
            while wp.hash_grid_query_next(query, candidate):
                j = candidate - (g * width + q) * model.nodes
                if j != i and wp.length(column(state.x[0, j, g], q) - here) < reach:
                    # Where j belongs in the sorted list.
                    p = count
                    while p > 0 and model.near[i, p - 1, g] > j:
                        p = p - 1
                    if p > 0 and model.near[i, p - 1, g] == j:
                        model.near_lanes[i, p - 1, g] = model.near_lanes[i, p - 1, g] | (1 << q)
                    else:
                        if count == room:
                            # The last of the list makes room, for every twin that has it.
                            lost = 1 << q
                            if p < room:
                                lost = model.near_lanes[i, room - 1, g]
                            for other in range(width):
                                overflow[i, g, other] = overflow[i, g, other] + ((lost >> other) & 1)
                        else:
                            count = count + 1
                        if p < room:
                            k = count - 1
                            while k > p:
                                model.near[i, k, g] = model.near[i, k - 1, g]
                                model.near_lanes[i, k, g] = model.near_lanes[i, k - 1, g]
                                k = k - 1
                            model.near[i, p, g] = j
                            model.near_lanes[i, p, g] = 1 << q
        # Each twin keeps as many as it would keep alone.
        for q in range(width):
            own = wp.int32(0)
            for k in range(count):
                if (model.near_lanes[i, k, g] >> q) & 1 == 1:
                    own = own + 1
                    if own > model.capacity:
                        model.near_lanes[i, k, g] = model.near_lanes[i, k, g] & ~(1 << q)
                        overflow[i, g, q] = overflow[i, g, q] + 1
        model.near_count[i, g] = count

    unique = wp.kernel(module="unique", enable_backward=False)
    return Kernels(unique(place), unique(find))


@functools.cache
def functions(real: Any, width: int) -> Functions:
    """Functions for a scalar type, wp.float32 or wp.float64, and a number of lanes."""
    lane = lanes(real, width)
    Number, Vector = lane.Number, lane.Vector
    Model, State, Adjoint = structs(real, width)
    dot, root, column, put = lane.dot, lane.root, lane.column, lane.put
    vec3 = wp.types.vector(3, real)
    zero, half, one = wp.constant(real(0.0)), wp.constant(real(0.5)), wp.constant(real(1.0))
    approach, floor = wp.constant(real(contact.APPROACH)), wp.constant(real(contact.MIN_TANGENT))

    @wp.func
    def hits(mask: int, q: int, length: real, closing: real, distance: real) -> bool:
        return (mask >> q) & 1 == 1 and length < distance and closing < -approach

    @wp.func
    def impulse(dx: vec3, u: vec3, length: real, e: real, mu: real) -> vec3:
        n = dx / wp.max(length, floor)
        s = wp.dot(u, n)
        ut = u - n * s
        a = wp.max(zero, one - mu * (one + e) * wp.abs(s) / wp.max(wp.length(ut), floor))
        return (ut * (a - one) - n * ((one + e) * s)) * half

    @wp.func
    def collided(model: Model, state: State, slot: int, inner: int, i: int, g: int) -> Vector:
        x = state.x[slot, i, g]
        v = state.after[inner, i, g]
        total = Vector()
        count = Number()
        for k in range(model.near_count[i, g]):
            j = model.near[i, k, g]
            mask = model.near_lanes[i, k, g]
            offset = state.x[slot, j, g] - x
            relative = state.after[inner, j, g] - v
            length = root(dot(offset, offset))
            closing = dot(offset, relative)
            for q in range(width):
                if hits(mask, q, length[q], closing[q], model.distance[g][q]):
                    push = impulse(column(offset, q), column(relative, q), length[q], model.contact_e[g][q], model.contact_mu[g][q])
                    total = put(total, q, column(total, q) + push)
                    count[q] = count[q] + one
        for q in range(width):
            if count[q] > zero:
                v = put(v, q, column(v, q) - column(total, q) / count[q])
        return v

    @wp.func
    def pair_adjoint(dx: vec3, u: vec3, length: real, e: real, mu: real, h: vec3):
        """Adjoints of dx, u, e and mu for h, that of the impulse; `half` is in h."""
        inverse = one / wp.max(length, floor)
        n = dx * inverse
        s = wp.dot(u, n)
        ut = u - n * s
        t = wp.length(ut)
        tf = wp.max(t, floor)
        a = wp.max(zero, one - mu * (one + e) * wp.abs(s) / tf)
        hn_along = wp.dot(h, n)
        ha = wp.dot(h, ut)
        hs = -(a + e) * hn_along
        hn = h * (-(a + e) * s)
        hu = h * (a - one)
        he = -s * hn_along
        hmu = zero
        if a > zero:
            hmu = -ha * (one + e) * wp.abs(s) / tf
            he = he - ha * mu * wp.abs(s) / tf
            hs = hs - wp.sign(s) * ha * mu * (one + e) / tf
            if t > floor:
                ht = ut * (ha * mu * (one + e) * wp.abs(s) / (tf * tf * t))
                hu = hu + ht
                hs = hs - wp.dot(ht, n)
                hn = hn - ht * s
        hu = hu + n * hs
        hn = hn + u * hs
        return (hn - n * wp.dot(hn, n)) * inverse, hu, he, hmu

    @wp.func
    def collided_adjoint(model: Model, state: State, adjoint: Adjoint, step: int, i: int, g: int):
        """From dL/d(velocities after the impulses) to those before, and to dL/d(x, e, mu)."""
        x = state.x[step, i, g]
        v = state.after[step, i, g]
        h = adjoint.moving[i, g]
        wp.atomic_add(adjoint.after, i, g, h)
        count = Number()
        for k in range(model.near_count[i, g]):
            j = model.near[i, k, g]
            mask = model.near_lanes[i, k, g]
            offset = state.x[step, j, g] - x
            length = root(dot(offset, offset))
            closing = dot(offset, state.after[step, j, g] - v)
            for q in range(width):
                if hits(mask, q, length[q], closing[q], model.distance[g][q]):
                    count[q] = count[q] + one
        for k in range(model.near_count[i, g]):
            j = model.near[i, k, g]
            mask = model.near_lanes[i, k, g]
            offset = state.x[step, j, g] - x
            relative = state.after[step, j, g] - v
            length = root(dot(offset, offset))
            closing = dot(offset, relative)
            for q in range(width):
                if hits(mask, q, length[q], closing[q], model.distance[g][q]):
                    share = column(h, q) * (-half / count[q])
                    hx, hu, he, hmu = pair_adjoint(
                        column(offset, q), column(relative, q), length[q], model.contact_e[g][q], model.contact_mu[g][q], share
                    )
                    change_x = put(Vector(), q, hx)
                    change_v = put(Vector(), q, hu)
                    wp.atomic_add(adjoint.x, j, g, change_x)
                    wp.atomic_sub(adjoint.x, i, g, change_x)
                    wp.atomic_add(adjoint.after, j, g, change_v)
                    wp.atomic_sub(adjoint.after, i, g, change_v)
                    e = adjoint.contact_e[i, g]
                    e[q] = e[q] + he
                    adjoint.contact_e[i, g] = e
                    mu = adjoint.contact_mu[i, g]
                    mu[q] = mu[q] + hmu
                    adjoint.contact_mu[i, g] = mu

    return Functions(collided, collided_adjoint)
