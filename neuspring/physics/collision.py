"""Self-collision by impulses between near nodes (Jacobi), and its adjoint.

Node i takes the mean impulse over its listed partners j that are closer than the contact distance and approach, by the response of
motion.py, of which m_j / (m_i + m_j) is its share: a pair that meets nobody else keeps its momentum.

Partners are listed once per frame, from a hash grid with cells as wide as the contact distance, so that the cost grows with the
nodes. A list is in node order; where a twin has more than `collision_capacity`, those with the lowest indices stay.
The twins of a group share a list: a bit per lane says whose partner a node is.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any

import torch
import warp as wp

from neuspring.core.device import load
from neuspring.physics.arrays import UNFUSED, Buffers, structs
from neuspring.physics.lanes import lanes
from neuspring.physics.motion import APPROACH, MIN_TANGENT

CELLS = 64
"""Cells of the hash grid along each axis; farther cells share them."""


def allocate(b: Buffers) -> None:
    """With self-collision, the lists of partners and the velocities after collisions."""
    if not b.simulation.self_collision:
        return
    capacity, twins = b.simulation.collision_capacity, b.groups * b.width
    # Room for the partners of all lanes, so that no twin takes another's. On a CPU, memory that no list reaches costs nothing.
    room = min(b.width * capacity, b.nodes)
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
    place, find = (load(kernel, b.device) for kernel in kernels(b.real, b.width))
    views, size = b.views, (b.nodes, b.groups)
    model, state, _ = b.arguments
    b.launch(place, size, model, state, views["grid_points"])
    views["grid"].build(views["grid_points"], reach, groups=views["grid_groups"])
    b.launch(find, size, model, state, views["grid"].id, views["overflow"])


@functools.cache
def kernels(real: Any, width: int) -> tuple[Any, Any]:
    """(place, find): kernels for a scalar type, wp.float32 or wp.float64, and a number of lanes."""
    lane = lanes(real, width)
    Model, State, _ = structs(real, width)
    column = lane.column
    points: Any = wp.array(dtype=wp.types.vector(3, real))
    counts: Any = wp.array3d(dtype=int)

    @wp.func
    def inserted(model: Model, i: int, g: int, j: int, q: int, count: int) -> int:
        """Make j a partner of node i in lane q; the new length of the sorted list."""
        p = count
        while p > 0 and model.near[i, p - 1, g] > j:
            p = p - 1
        if p > 0 and model.near[i, p - 1, g] == j:
            model.near_lanes[i, p - 1, g] = model.near_lanes[i, p - 1, g] | (1 << q)
            return count
        k = count
        while k > p:
            model.near[i, k, g] = model.near[i, k - 1, g]
            model.near_lanes[i, k, g] = model.near_lanes[i, k - 1, g]
            k = k - 1
        model.near[i, p, g] = j
        model.near_lanes[i, p, g] = 1 << q
        return count + 1

    @wp.func
    def dropped(model: Model, i: int, g: int, k: int, q: int, count: int) -> int:
        """Take entry k from lane q, and out of the list where no other lane has it; the new length."""
        model.near_lanes[i, k, g] = model.near_lanes[i, k, g] & ~(1 << q)
        if model.near_lanes[i, k, g] != 0:
            return count
        for later in range(k + 1, count):
            model.near[i, later - 1, g] = model.near[i, later, g]
            model.near_lanes[i, later - 1, g] = model.near_lanes[i, later, g]
        return count - 1

    def place(model: Model, state: State, grid_points: points):
        i, g = wp.tid()
        for q in range(width):
            grid_points[(g * width + q) * model.nodes + i] = column(state.x[0, i, g], q)

    def find(model: Model, state: State, grid: wp.uint64, overflow: counts):
        i, g = wp.tid()
        count = wp.int32(0)
        for q in range(width):
            reach = model.distance[g][q]
            here = column(state.x[0, i, g], q)
            own = wp.int32(0)
            query = wp.hash_grid_query(grid, here, reach, g * width + q)
            candidate = wp.int32(0)
            while wp.hash_grid_query_next(query, candidate):
                j = candidate - (g * width + q) * model.nodes
                if j != i and wp.length(column(state.x[0, j, g], q) - here) < reach:
                    keep = True
                    if own == model.capacity:
                        # The twin's last partner makes room for one that comes before it.
                        overflow[i, g, q] = overflow[i, g, q] + 1
                        last = count - 1
                        while (model.near_lanes[i, last, g] >> q) & 1 == 0:
                            last = last - 1
                        keep = j < model.near[i, last, g]
                        if keep:
                            count = dropped(model, i, g, last, q, count)
                    else:
                        own = own + 1
                    if keep:
                        count = inserted(model, i, g, j, q, count)
        model.near_count[i, g] = count

    unique = wp.kernel(**UNFUSED)
    return unique(place), unique(find)


@functools.cache
def functions(real: Any, width: int) -> tuple[Any, Any]:
    """(collided, its adjoint) for a scalar type, wp.float32 or wp.float64, and a number of lanes."""
    lane = lanes(real, width)
    Number, Vector = lane.Number, lane.Vector
    Model, State, Adjoint = structs(real, width)
    dot, root, column, put = lane.dot, lane.root, lane.column, lane.put
    vec3 = wp.types.vector(3, real)
    zero, one = wp.constant(real(0.0)), wp.constant(real(1.0))
    approach, floor = wp.constant(real(APPROACH)), wp.constant(real(MIN_TANGENT))

    @wp.func
    def hits(mask: int, q: int, length: real, closing: real, distance: real) -> bool:
        return (mask >> q) & 1 == 1 and length < distance and closing < -approach

    @wp.func
    def part(model: Model, i: int, j: int, g: int, q: int) -> real:
        """m_j / (m_i + m_j)."""
        own = model.inverse_mass[i, g][q]
        return own / (own + model.inverse_mass[j, g][q])

    @wp.func
    def impulse(dx: vec3, u: vec3, length: real, e: real, mu: real, share: real) -> vec3:
        n = dx / wp.max(length, floor)
        s = wp.dot(u, n)
        ut = u - n * s
        a = wp.max(zero, one - mu * (one + e) * wp.abs(s) / wp.max(wp.length(ut), floor))
        return (ut * (a - one) - n * ((one + e) * s)) * share

    @wp.func
    def meeting(state: State, slot: int, inner: int, j: int, g: int, x: Vector, v: Vector):
        """Node j seen from a node at x with velocity v: offset, relative velocity, distance, distance times closing speed."""
        offset = state.x[slot, j, g] - x
        relative = state.after[inner, j, g] - v
        return offset, relative, root(dot(offset, offset)), dot(offset, relative)

    @wp.func
    def collided(model: Model, state: State, slot: int, inner: int, i: int, g: int) -> Vector:
        """Velocities of node i after the impulses."""
        x = state.x[slot, i, g]
        v = state.after[inner, i, g]
        total = Vector()
        count = Number()
        for k in range(model.near_count[i, g]):
            j = model.near[i, k, g]
            mask = model.near_lanes[i, k, g]
            offset, relative, length, closing = meeting(state, slot, inner, j, g, x, v)
            for q in range(width):
                if hits(mask, q, length[q], closing[q], model.distance[g][q]):
                    push = impulse(
                        column(offset, q),
                        column(relative, q),
                        length[q],
                        model.contact_e[g][q],
                        model.contact_mu[g][q],
                        part(model, i, j, g, q),
                    )
                    total = put(total, q, column(total, q) + push)
                    count[q] = count[q] + one
        for q in range(width):
            if count[q] > zero:
                v = put(v, q, column(v, q) - column(total, q) / count[q])
        return v

    @wp.func
    def pair_adjoint(dx: vec3, u: vec3, length: real, e: real, mu: real, h: vec3):
        """Adjoints of dx, u, e and mu for h, that of the impulse; the node's share is in h."""
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
            offset, relative, length, closing = meeting(state, step, step, j, g, x, v)
            for q in range(width):
                if hits(mask, q, length[q], closing[q], model.distance[g][q]):
                    count[q] = count[q] + one
        for k in range(model.near_count[i, g]):
            j = model.near[i, k, g]
            mask = model.near_lanes[i, k, g]
            offset, relative, length, closing = meeting(state, step, step, j, g, x, v)
            for q in range(width):
                if hits(mask, q, length[q], closing[q], model.distance[g][q]):
                    share = column(h, q) * (-part(model, i, j, g, q) / count[q])
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

    return collided, collided_adjoint
