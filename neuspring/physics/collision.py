"""Self-collision by impulses between near nodes (Jacobi), and its adjoint.

Node i takes the mean impulse over its listed partners j that are closer than the contact distance and approach, by the response of
motion.py, of which m_j / (m_i + m_j) is its share: a pair that meets nobody else keeps its momentum.

Partners are listed once per frame, from a hash grid with cells as wide as the contact distance, so that the cost grows with the
nodes. A list is in node order; where a node has more than `collision_capacity`, those with the lowest indices stay, and the others
do not meet it.
The twins of a group share a list: a bit per lane says whose partner a node is.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any, NamedTuple

import torch
import warp as wp

from neuspring.core.device import load
from neuspring.physics.arrays import UNFUSED, Buffers, structs
from neuspring.physics.lanes import lanes
from neuspring.physics.motion import APPROACH, MIN_TANGENT

GRID_CELLS = 64
"""Cells of the hash grid along each axis; farther cells share them."""


def allocate(b: Buffers) -> None:
    """Allocate the lists of partners and the velocities after collisions, with self-collision alone."""
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
    b.add_numbers(met=(b.history, b.nodes))
    groups = torch.arange(twins, **device).repeat_interleave(b.nodes)
    b.indices["grid_groups"] = groups
    b.views["grid_groups"] = wp.from_torch(groups, dtype=wp.int32)
    b.tensors["grid_points"] = torch.zeros((twins * b.nodes, 3), dtype=b.dtype, device=b.device)
    b.views["grid_points"] = wp.from_torch(b.tensors["grid_points"], dtype=wp.types.vector(3, b.real))
    b.views["grid"] = wp.HashGrid(GRID_CELLS, GRID_CELLS, GRID_CELLS, device=b.device, dtype=b.real)


def overflow(b: Buffers) -> torch.Tensor:
    """Candidates that did not fit the lists so far, of each twin [B]."""
    if not b.simulation.self_collision:
        return torch.zeros(b.twins, dtype=torch.int64)
    return b.indices["overflow"].sum(dim=0).reshape(-1)[: b.twins].cpu()


def find_candidates(b: Buffers, reach: float) -> None:
    """List the partners of every node at the start of the frame; `reach` is the largest contact distance, m."""
    place, find, agree = (load(kernel, b.device) for kernel in kernels(b.real, b.width))
    views, size = b.views, (b.nodes, b.groups)
    model, state, _ = b.arguments
    b.launch(place, size, model, state, views["grid_points"])
    views["grid"].build(views["grid_points"], reach, groups=views["grid_groups"])
    b.launch(find, size, model, state, views["grid"].id, views["overflow"])
    b.launch(agree, size, model, views["overflow"])


@functools.cache
def kernels(real: Any, width: int) -> tuple[Any, Any, Any]:
    """(place, find, agree): kernels for a scalar type, wp.float32 or wp.float64, and a number of lanes."""
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

    @wp.func
    def listed(model: Model, i: int, g: int, j: int) -> int:
        """The lanes in which j is a partner of node i."""
        for k in range(model.near_count[i, g]):
            if model.near[i, k, g] == j:
                return model.near_lanes[i, k, g]
        return 0

    def agree(model: Model, overflow: counts):
        """A node that was dropped by a partner drops it too: a pair is one for both. The order of threads makes no difference."""
        i, g = wp.tid()
        for k in range(model.near_count[i, g]):
            j = model.near[i, k, g]
            full = wp.int32(0)
            for q in range(width):
                full = full + overflow[j, g, q]
            if full > 0:
                model.near_lanes[i, k, g] = model.near_lanes[i, k, g] & listed(model, j, g, i)

    unique = wp.kernel(**UNFUSED)
    return unique(place), unique(find), unique(agree)


class Contacts(NamedTuple):
    """Calls of a frame. A thread per node gathers (`collided`); one thread for all adds each pair to both of its nodes."""

    collided: Any
    add_pairs: Any
    after_pairs: Any
    adjoint: Any


@functools.cache
def functions(real: Any, width: int) -> Contacts:
    """The functions for a scalar type, wp.float32 or wp.float64, and a number of lanes."""
    lane = lanes(real, width)
    Number, Vector = lane.Number, lane.Vector
    Model, State, Adjoint = structs(real, width)
    dot, root, scaled, divided = lane.dot, lane.root, lane.scaled, lane.divided
    zero, one = wp.constant(real(0.0)), wp.constant(real(1.0))
    approach, floor = wp.constant(real(APPROACH)), wp.constant(real(MIN_TANGENT))

    @wp.func
    def whole(value: real) -> Number:
        """The same in every lane."""
        result = Number()
        for q in range(width):
            result[q] = value
        return result

    @wp.func
    def closes(offset: Vector, relative: Vector) -> bool:
        """True where a pair comes closer in any lane. Almost half do not, and need no more than this."""
        return wp.min(dot(offset, relative)) < -approach

    @wp.func
    def meeting(offset: Vector, relative: Vector, mask: int, distance: Number) -> Number:
        """1 in the lanes in which a pair meets."""
        length = root(dot(offset, offset))
        closing = dot(offset, relative)
        meets = Number()
        for q in range(width):
            meets[q] = wp.where((mask >> q) & 1 == 1 and length[q] < distance[q] and closing[q] < -approach, one, zero)
        return meets

    @wp.func
    def part(own: Number, other: Number) -> Number:
        """m_j / (m_i + m_j) of the inverse masses of i and j."""
        return wp.cw_div(own, own + other)

    @wp.func
    def impulse(dx: Vector, u: Vector, e: Number, mu: Number) -> Vector:
        """Velocity that a node gains from a partner at dx that moves at u, before its share."""
        n = divided(dx, wp.max(root(dot(dx, dx)), whole(floor)))
        s = dot(u, n)
        ut = u - scaled(n, s)
        more = whole(one) + e
        lost = wp.cw_div(wp.cw_mul(wp.cw_mul(mu, more), wp.abs(s)), wp.max(root(dot(ut, ut)), whole(floor)))
        a = wp.max(Number(), whole(one) - lost)
        return scaled(ut, a - whole(one)) - scaled(n, wp.cw_mul(more, s))

    @wp.func
    def collided(model: Model, state: State, slot: int, inner: int, i: int, g: int) -> Vector:
        """Velocities of node i after the impulses of all its partners."""
        x = state.x[slot, i, g]
        v = state.after[inner, i, g]
        total = Vector()
        count = Number()
        distance = model.distance[g]
        light = model.inverse_mass[i, g]
        for k in range(model.near_count[i, g]):
            j = model.near[i, k, g]
            offset = state.x[slot, j, g] - x
            relative = state.after[inner, j, g] - v
            if closes(offset, relative):
                meets = meeting(offset, relative, model.near_lanes[i, k, g], distance)
                own = impulse(offset, relative, model.contact_e[g], model.contact_mu[g])
                push = scaled(own, part(light, model.inverse_mass[j, g]))
                total = total + scaled(push, meets)
                count = count + meets
        state.met[inner, i, g] = count
        return v - divided(total, wp.max(count, whole(one)))

    @wp.func
    def add_pairs(model: Model, state: State, slot: int, inner: int, i: int, g: int):
        """Add the impulses of node i and its later partners to `moving` and `met` of both: each pair once, the same sums."""
        x = state.x[slot, i, g]
        v = state.after[inner, i, g]
        total = state.moving[inner, i, g]
        count = state.met[inner, i, g]
        distance = model.distance[g]
        light = model.inverse_mass[i, g]
        for k in range(model.near_count[i, g]):
            j = model.near[i, k, g]
            if j > i:
                offset = state.x[slot, j, g] - x
                relative = state.after[inner, j, g] - v
                if closes(offset, relative):
                    meets = meeting(offset, relative, model.near_lanes[i, k, g], distance)
                    push = impulse(offset, relative, model.contact_e[g], model.contact_mu[g])
                    total = total + scaled(scaled(push, part(light, model.inverse_mass[j, g])), meets)
                    count = count + meets
                    back = scaled(scaled(push, part(model.inverse_mass[j, g], light)), meets)
                    state.moving[inner, j, g] = state.moving[inner, j, g] - back
                    state.met[inner, j, g] = state.met[inner, j, g] + meets
        state.moving[inner, i, g] = total
        state.met[inner, i, g] = count

    @wp.func
    def after_pairs(state: State, inner: int, i: int, g: int) -> Vector:
        """Velocities of node i after the impulses that `add_pairs` has added."""
        return state.after[inner, i, g] - divided(state.moving[inner, i, g], wp.max(state.met[inner, i, g], whole(one)))

    @wp.func
    def pair_adjoint(dx: Vector, u: Vector, e: Number, mu: Number, h: Vector):
        """Adjoints of dx, u, e and mu for h, that of the impulse; the node's share is in h."""
        ones = whole(one)
        inverse = wp.cw_div(ones, wp.max(root(dot(dx, dx)), whole(floor)))
        n = scaled(dx, inverse)
        s = dot(u, n)
        ut = u - scaled(n, s)
        t = root(dot(ut, ut))
        tf = wp.max(t, whole(floor))
        more = ones + e
        size = wp.abs(s)
        a = wp.max(Number(), ones - wp.cw_div(wp.cw_mul(wp.cw_mul(mu, more), size), tf))
        along = dot(h, n)
        ha = dot(h, ut)
        hs = -wp.cw_mul(a + e, along)
        hn = scaled(h, -wp.cw_mul(a + e, s))
        hu = scaled(h, a - ones)
        he = -wp.cw_mul(s, along)
        # Where friction does not stop the pair, and where it has a direction.
        slides = Number()
        turns = Number()
        for q in range(width):
            slides[q] = wp.where(a[q] > zero, one, zero)
            turns[q] = wp.where(a[q] > zero and t[q] > floor, one, zero)
        slope = wp.cw_div(wp.cw_mul(ha, slides), tf)
        hmu = -wp.cw_mul(wp.cw_mul(slope, more), size)
        he = he - wp.cw_mul(wp.cw_mul(slope, mu), size)
        force = wp.cw_mul(wp.cw_mul(slope, mu), more)
        hs = hs - wp.cw_mul(wp.sign(s), force)
        ht = scaled(ut, wp.cw_div(wp.cw_mul(wp.cw_mul(force, turns), size), wp.cw_mul(tf, wp.max(t, whole(floor)))))
        hu = hu + ht + scaled(n, hs - dot(ht, n))
        hs = hs - dot(ht, n)
        hn = hn - scaled(ht, s) + scaled(u, hs)
        return scaled(hn - scaled(n, dot(hn, n)), inverse), hu, he, hmu

    @wp.func
    def collided_adjoint(model: Model, state: State, adjoint: Adjoint, step: int, i: int, g: int):
        """Adjoint of `collided`, of node i and its later pairs: dL/d(velocities after impulses) -> dL/d(those before, x, e, mu)."""
        h = adjoint.moving[i, g]
        wp.atomic_add(adjoint.after, i, g, h)
        count = state.met[step, i, g]
        if wp.max(count) == zero:
            return
        x = state.x[step, i, g]
        v = state.after[step, i, g]
        own = divided(h, wp.max(count, whole(one)))
        e = adjoint.contact_e[i, g]
        mu = adjoint.contact_mu[i, g]
        distance = model.distance[g]
        light = model.inverse_mass[i, g]
        for k in range(model.near_count[i, g]):
            j = model.near[i, k, g]
            if j > i:
                offset = state.x[step, j, g] - x
                relative = state.after[step, j, g] - v
                if closes(offset, relative):
                    meets = meeting(offset, relative, model.near_lanes[i, k, g], distance)
                    other = divided(adjoint.moving[j, g], wp.max(state.met[step, j, g], whole(one)))
                    share = scaled(
                        scaled(other, part(model.inverse_mass[j, g], light)) - scaled(own, part(light, model.inverse_mass[j, g])),
                        meets,
                    )
                    hx, hu, he, hmu = pair_adjoint(offset, relative, model.contact_e[g], model.contact_mu[g], share)
                    wp.atomic_add(adjoint.x, j, g, hx)
                    wp.atomic_sub(adjoint.x, i, g, hx)
                    wp.atomic_add(adjoint.after, j, g, hu)
                    wp.atomic_sub(adjoint.after, i, g, hu)
                    e = e + he
                    mu = mu + hmu
        adjoint.contact_e[i, g] = e
        adjoint.contact_mu[i, g] = mu

    return Contacts(collided, add_pairs, after_pairs, collided_adjoint)
