"""Self-collision by impulses between near nodes (Jacobi), and its adjoint.

Node i receives the mean impulse over its listed partners j that are closer than the contact distance and approach. motion.py
defines the response. The share of node i is m_j / (m_i + m_j), so a pair without other partners conserves momentum.

Partners are listed once per frame, from a hash grid with cells as wide as the contact distance, so the cost is proportional to
the number of nodes. Lists are sorted by node. If a node has more than `collision_capacity` partners, those with the lowest
indices stay.

The twins of a group share a list; one bit per lane states in which twins a pair is listed. For a single thread, each pair is
listed once, in the row of its lower node. With one thread per node, each pair is listed at both nodes.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any

import torch
import warp as wp

from neuspring.core.device import load
from neuspring.physics import blocks
from neuspring.physics.arrays import BEHIND, UNFUSED, Buffers, structs
from neuspring.physics.lanes import lanes
from neuspring.physics.motion import APPROACH, MIN_TANGENT

GRID_CELLS = 64
"""Cells of the hash grid along each axis; cells farther away wrap around."""
FIRST_PAIRS = 4
"""Initial capacity in pairs per node; a frame with more pairs doubles it."""
MOST_APART = 0.5
"""Largest distance of nodes from those of the first twin, in contact distances and without a common shift, up to which the twins
of a group share a neighbor search. At 0.5, a neighborhood contains eight times as many nodes."""
MARGIN = 1e-3
"""Margin for rounding, as a fraction of the contact distance."""


def allocate(b: Buffers) -> None:
    """Allocate the lists of partners and the velocities after collisions. Without self-collision, nothing is allocated."""
    if not b.simulation.self_collision:
        return
    twins = b.groups * b.width
    device = {"dtype": torch.int32, "device": b.device}
    b.set_table("overflow", (b.nodes, b.groups, b.width))
    if b.threads:
        # A thread belongs to one twin, so lists are not shared between lanes.
        for name in ("near", "near_lanes"):
            b.set_table(name, (b.nodes, min(b.simulation.collision_capacity, b.nodes), b.groups))
        b.set_table("near_count", (b.nodes, b.groups))
    else:
        b.set_table("pair_rows", (b.groups, b.nodes + 1))
        b.add_numbers(lower=b.nodes)
        _make_room(b, FIRST_PAIRS * b.nodes)
    b.add_numbers(bits=1 << b.width)
    bits = (torch.arange(1 << b.width)[:, None] >> torch.arange(b.width)) & 1
    b.tensors["bits"].copy_(bits[:, None])
    b.add_vectors(moving=(b.history, b.nodes), adj_moving=(b.nodes,))
    b.add_numbers(met=(b.history, b.nodes))
    groups = torch.arange(twins, **device).repeat_interleave(b.nodes)
    b.indices["grid_groups"] = groups
    b.views["grid_groups"] = wp.from_torch(groups, dtype=wp.int32)
    b.tensors["grid_points"] = torch.zeros((twins * b.nodes, 3), dtype=b.dtype, device=b.device)
    b.views["grid_points"] = wp.from_torch(b.tensors["grid_points"], dtype=wp.types.vector(3, b.real))
    b.views["grid"] = wp.HashGrid(GRID_CELLS, GRID_CELLS, GRID_CELLS, device=b.device, dtype=b.real)


def overflow(b: Buffers) -> torch.Tensor:
    """Candidates of each twin that exceeded the lists so far [B]."""
    if not b.simulation.self_collision:
        return torch.zeros(b.twins, dtype=torch.int64)
    return b.of_twins(b.indices["overflow"].sum(dim=0).reshape(-1)).cpu()


def _make_room(b: Buffers, pairs: int) -> None:
    for name, numbers in {"pair_other": 1, "pair_lanes": 1, "closing": 2}.items():
        b.set_table(name, (b.groups, numbers * (pairs + BEHIND)))


def find_candidates(b: Buffers, reach: float) -> None:
    """List the partners of every node at the start of the frame; `reach` is the largest contact distance, m."""
    place, find, agree, find_pairs = (load(kernel, b.device) for kernel in kernels(b.real, b.width))
    views, size = b.views, (b.nodes, b.groups)
    model, state, _ = b.arguments
    spread = _apart(b)
    looks = 1 if spread <= MOST_APART * reach else b.width
    # Nodes that are near in any lane are at most this much farther apart in the first lane.
    wider = 2 * spread + MARGIN * reach if looks < b.width else 0.0
    b.launch(place, size, model, state, looks, views["grid_points"])
    count = b.groups * looks * b.nodes
    views["grid"].build(views["grid_points"][:count], reach + wider, groups=views["grid_groups"][:count])
    if b.threads:
        b.launch(find, size, model, state, views["grid"].id, views["overflow"])
        b.launch(agree, size, model, views["overflow"])
        return
    listed, known = b.indices["pair_rows"][:, -1], b.indices["overflow"].clone()
    while True:
        b.launch(find_pairs, b.groups, b.arguments[0], state, views["grid"].id, looks, wider, views["lower"], views["overflow"])
        if (listed >= 0).all():
            return
        b.indices["overflow"].copy_(known)
        _make_room(b, 2 * b.indices["pair_other"].shape[1])


def _apart(b: Buffers) -> float:
    """The largest distance of a node in any lane from the same node in the first lane, without a common shift, m."""
    if b.width == 1:
        return 0.0
    ways = b.tensors["x"][0, : b.nodes]
    ways = ways - ways[..., :1]
    return float((ways - ways.mean(dim=0)).norm(dim=2).max())


@functools.cache
def kernels(real: Any, width: int) -> tuple[Any, Any, Any, Any]:
    """(place, find, agree, find_pairs): kernels for a scalar type, wp.float32 or wp.float64, and a number of lanes."""
    lane = lanes(real, width)
    Number, Vector = lane.Number, lane.Vector
    Model, State, _ = structs(real, width)
    column, dot, root = lane.column, lane.dot, lane.root
    numbers: Any = wp.array2d(dtype=Number)
    zero, one = real(0.0), real(1.0)
    points: Any = wp.array(dtype=wp.types.vector(3, real))
    counts: Any = wp.array3d(dtype=int)

    def place(model: Model, state: State, looks: int, grid_points: points):
        i, g = wp.tid()
        for q in range(looks):
            grid_points[(g * looks + q) * model.nodes + i] = column(state.x[0, i, g], q)

    def find(model: Model, state: State, grid: wp.uint64, overflow: counts):
        """List the partners of a node, sorted; one thread per node, one lane."""
        i, g = wp.tid()
        count = wp.int32(0)
        here = column(state.x[0, i, g], 0)
        query = wp.hash_grid_query(grid, here, model.distance[g][0], g)
        candidate = wp.int32(0)
        while wp.hash_grid_query_next(query, candidate):
            j = candidate - g * model.nodes
            if j != i and wp.length(column(state.x[0, j, g], 0) - here) < model.distance[g][0]:
                keep = True
                if count == model.capacity:
                    # A candidate before the last partner replaces it.
                    overflow[i, g, 0] = overflow[i, g, 0] + 1
                    keep = j < model.near[i, count - 1, g]
                    count = wp.where(keep, count - 1, count)
                if keep:
                    k = count
                    while k > 0 and model.near[i, wp.max(k - 1, 0), g] > j:
                        model.near[i, k, g] = model.near[i, k - 1, g]
                        k = k - 1
                    model.near[i, k, g] = j
                    model.near_lanes[i, count, g] = 1
                    count = count + 1
        model.near_count[i, g] = count

    @wp.func
    def listed(model: Model, i: int, g: int, j: int) -> int:
        """Return the lanes in which j is a partner of node i, else 0."""
        for k in range(model.near_count[i, g]):
            if model.near[i, k, g] == j:
                return model.near_lanes[i, k, g]
        return 0

    def agree(model: Model, overflow: counts):
        """Remove pairs that the list of one of their nodes dropped. The order of threads does not matter."""
        i, g = wp.tid()
        for k in range(model.near_count[i, g]):
            j = model.near[i, k, g]
            if overflow[j, g, 0] > 0:
                model.near_lanes[i, k, g] = model.near_lanes[i, k, g] & listed(model, j, g, i)

    @wp.func
    def within(offset: Vector, distance: Number, own: Number) -> Number:
        """Return 1 in lanes in which a pair is near and `own` is 1."""
        length = root(dot(offset, offset))
        near = Number()
        for q in range(width):
            near[q] = wp.where(length[q] < distance[q], own[q], zero)
        return near

    @wp.func
    def paired(model: Model, g: int, first: int, count: int, j: int, mask: int) -> int:
        """Add partner j, in the lanes of a mask, to the sorted row that begins at `first`; return the new length of the row."""
        p = count
        while p > 0 and model.pair_other[g, first + p - 1] > j:
            p = p - 1
        if p > 0 and model.pair_other[g, first + p - 1] == j:
            model.pair_lanes[g, first + p - 1] = model.pair_lanes[g, first + p - 1] | mask
            return count
        k = first + count
        while k > first + p:
            model.pair_other[g, k] = model.pair_other[g, k - 1]
            model.pair_lanes[g, k] = model.pair_lanes[g, k - 1]
            k = k - 1
        model.pair_other[g, k] = j
        model.pair_lanes[g, k] = mask
        return count + 1

    @wp.func
    def parted(model: Model, g: int, first: int, count: int, q: int) -> int:
        """Remove the last partner in lane q from the row that begins at `first`; return the new length of the row."""
        k = first + count - 1
        while (model.pair_lanes[g, k] >> q) & 1 == 0:
            k = k - 1
        model.pair_lanes[g, k] = model.pair_lanes[g, k] & ~(1 << q)
        if model.pair_lanes[g, k] != 0:
            return count
        for later in range(k + 1, first + count):
            model.pair_other[g, later - 1] = model.pair_other[g, later]
            model.pair_lanes[g, later - 1] = model.pair_lanes[g, later]
        return count - 1

    def find_pairs(model: Model, state: State, grid: wp.uint64, looks: int, wider: real, lower: numbers, overflow: counts):
        """List the rows of a group: search around each node in each lane, or in a wider radius in the first lane for all lanes.

        Sets the end of the last row to -1 if the capacity is too small. `lower` counts partners with lower indices. As rows
        ascend, it is the rank of the current node among the partners of the other node.
        """
        g = wp.tid()
        room = model.pair_other.shape[1] - BEHIND
        distance = model.distance[g]
        capacity = real(model.capacity)
        first = wp.int32(0)
        for i in range(model.nodes):
            lower[i, g] = Number()
        for i in range(model.nodes):
            model.pair_rows[g, i] = first
            count = wp.int32(0)
            x = state.x[0, i, g]
            before = lower[i, g]
            more = Number()
            own = Number()
            for look in range(looks):
                reach = wp.where(looks == 1, wp.max(distance), distance[look]) + wider
                here = column(x, look)
                lanes_seen = wp.where(looks == 1, (1 << width) - 1, 1 << look)
                query = wp.hash_grid_query(grid, here, reach, g * looks + look)
                candidate = wp.int32(0)
                while wp.hash_grid_query_next(query, candidate):
                    j = candidate - (g * looks + look) * model.nodes
                    if j > i and wp.length(column(state.x[0, j, g], look) - here) < reach:
                        near = within(state.x[0, j, g] - x, distance, model.bits[lanes_seen, g])
                        rank = lower[j, g]
                        lower[j, g] = rank + near
                        more = more + near
                        mask = wp.int32(0)
                        for q in range(width):
                            fits = near[q] > zero and rank[q] < capacity and before[q] < capacity
                            mask = mask | wp.where(fits, 1 << q, 0)
                        if mask != 0:
                            if first + count == room:
                                model.pair_rows[g, model.nodes] = -1
                                return
                            count = paired(model, g, first, count, j, mask)
                            own = own + model.bits[mask, g]
                            if wp.max(before + own) > capacity:
                                for q in range(width):
                                    if (mask >> q) & 1 == 1 and before[q] + own[q] > capacity:
                                        count = parted(model, g, first, count, q)
                                        own[q] = own[q] - one
            for q in range(width):
                overflow[i, g, q] = overflow[i, g, q] + wp.max(int(before[q] + more[q]) - model.capacity, 0)
            first = first + count
        model.pair_rows[g, model.nodes] = first

    unique = wp.kernel(**UNFUSED)
    return unique(place), unique(find), unique(agree), unique(find_pairs)


@functools.cache
def functions(real: Any, width: int) -> tuple[Any, Any, Any, Any, Any]:
    """(collided, add_all_pairs, after_pairs, adjoints of the first two) for a scalar type, wp.float32 or wp.float64, and lanes.

    With one thread per node, `collided` gathers impulses. A single thread adds each pair to both of its nodes (`add_all_pairs`).
    """
    lane = lanes(real, width)
    Number, Vector, plain = lane.Number, lane.Vector, lane.plain
    Model, State, Adjoint = structs(real, width)
    dot, root, scaled, divided = lane.dot, lane.root, lane.scaled, lane.divided
    zero, one = real(0.0), real(1.0)
    approach, floor = real(APPROACH), real(MIN_TANGENT)
    half = Number(*[real(0.5)] * width)

    @wp.func
    def whole(value: real) -> Number:
        """Return the same value in every lane."""
        result = Number()
        for q in range(width):
            result[q] = value
        return result

    @wp.func
    def closes(offset: Vector, relative: Vector) -> bool:
        """Return True if a pair approaches in any lane. Almost half of the pairs do not, and need no further work."""
        return wp.min(dot(offset, relative)) < -approach

    @wp.func
    def meeting(offset: Vector, relative: Vector, own: Number, distance: Number) -> Number:
        """Return 1 in lanes in which a listed pair (`own` is 1) collides."""
        length = root(dot(offset, offset))
        closing = dot(offset, relative)
        meets = Number()
        for q in range(width):
            meets[q] = wp.where(length[q] < distance[q] and closing[q] < -approach, own[q], zero)
        return meets

    @wp.func
    def part(model: Model, own: Number, other: Number) -> Number:
        """Return m_j / (m_i + m_j) from the inverse masses of i and j."""
        if model.alike != 0:
            return half
        return wp.cw_div(own, own + other)

    @wp.func
    def impulse(dx: Vector, u: Vector, e: Number, mu: Number) -> Vector:
        """Impulse of a partner at dx that moves at u, as a velocity, before multiplication by the share of the node."""
        n = divided(dx, wp.max(root(dot(dx, dx)), whole(floor)))
        s = dot(u, n)
        ut = u - scaled(n, s)
        more = whole(one) + e
        lost = wp.cw_div(wp.cw_mul(wp.cw_mul(mu, more), wp.abs(s)), wp.max(root(dot(ut, ut)), whole(floor)))
        a = wp.max(Number(), whole(one) - lost)
        return scaled(ut, a - whole(one)) - scaled(n, wp.cw_mul(more, s))

    @wp.func
    def collided(model: Model, state: State, slot: int, inner: int, i: int, g: int) -> Vector:
        """Velocity of node i after the impulses of all its partners."""
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
                meets = meeting(offset, relative, model.bits[model.near_lanes[i, k, g], g], distance)
                own = impulse(offset, relative, model.contact_e[g], model.contact_mu[g])
                push = scaled(own, part(model, light, model.inverse_mass[j, g]))
                total = total + scaled(push, meets)
                count = count + meets
        state.met[inner, i, g] = count
        return v - divided(total, wp.max(count, whole(one)))

    @wp.func
    def add_pairs(model: Model, state: State, slot: int, inner: int, i: int, g: int):
        """Add the impulses of node i and its later partners to `moving` and `met` of both nodes, each pair once."""
        x = state.x[slot, i, g]
        v = state.after[inner, i, g]
        total = state.moving[inner, i, g]
        count = state.met[inner, i, g]
        distance = model.distance[g]
        light = model.inverse_mass[i, g]
        for place in range(model.pair_rows[g, i], model.pair_rows[g, i + 1]):
            k = plain(place)
            j = plain(model.pair_other[g, k])
            offset = state.x[slot, j, g] - x
            relative = state.after[inner, j, g] - v
            meets = meeting(offset, relative, model.bits[model.pair_lanes[g, k], g], distance)
            push = impulse(offset, relative, model.contact_e[g], model.contact_mu[g])
            total = total + scaled(scaled(push, part(model, light, model.inverse_mass[j, g])), meets)
            count = count + meets
            back = scaled(scaled(push, part(model, model.inverse_mass[j, g], light)), meets)
            state.moving[inner, j, g] = state.moving[inner, j, g] - back
            state.met[inner, j, g] = state.met[inner, j, g] + meets
        state.moving[inner, i, g] = total
        state.met[inner, i, g] = count

    @wp.func
    def add_all_pairs(model: Model, state: State, slot: int, inner: int, g: int):
        """Call `add_pairs` for all nodes."""
        for i in range(model.nodes):
            add_pairs(model, state, slot, inner, i, g)

    @wp.func
    def after_pairs(state: State, inner: int, i: int, g: int) -> Vector:
        """Velocity of node i after the impulses of `add_pairs`."""
        return state.after[inner, i, g] - divided(state.moving[inner, i, g], wp.max(state.met[inner, i, g], whole(one)))

    @wp.func
    def pair_adjoint(dx: Vector, u: Vector, e: Number, mu: Number, h: Vector):
        """Adjoints of dx, u, e and mu, from the adjoint h of the impulse; h includes the share of the node."""
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
        # slides: friction does not stop the pair. turns: the tangential velocity also has a direction.
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
    def mean_adjoint(state: State, adjoint: Adjoint, step: int, i: int, g: int) -> Vector:
        """The adjoint of the mean impulse of node i."""
        return divided(adjoint.moving[i, g], wp.max(state.met[step, i, g], whole(one)))

    @wp.func
    def add_adjoint(model: Model, state: State, adjoint: Adjoint, step: int, i: int, g: int, j: int, mask: int, own: Vector):
        """Add the adjoints of a pair to those of x, velocities, e and mu. `own` is the adjoint of the mean impulse of node i."""
        offset = state.x[step, j, g] - state.x[step, i, g]
        relative = state.after[step, j, g] - state.after[step, i, g]
        light = model.inverse_mass[i, g]
        beside = model.inverse_mass[j, g]
        meets = meeting(offset, relative, model.bits[mask, g], model.distance[g])
        other = mean_adjoint(state, adjoint, step, j, g)
        share = scaled(other, part(model, beside, light)) - scaled(own, part(model, light, beside))
        hx, hu, he, hmu = pair_adjoint(offset, relative, model.contact_e[g], model.contact_mu[g], scaled(share, meets))
        wp.atomic_add(adjoint.x, j, g, hx)
        wp.atomic_sub(adjoint.x, i, g, hx)
        wp.atomic_add(adjoint.after, j, g, hu)
        wp.atomic_sub(adjoint.after, i, g, hu)
        adjoint.contact_e[i, g] = adjoint.contact_e[i, g] + he
        adjoint.contact_mu[i, g] = adjoint.contact_mu[i, g] + hmu

    @wp.func
    def collided_adjoint(model: Model, state: State, adjoint: Adjoint, step: int, i: int, g: int):
        """Adjoint of `collided` for node i and its later partners: dL/d(velocities after impulses) -> dL/d(velocities before, x,
        e, mu).

        `adjoint.after` starts as a copy of `adjoint.moving`.
        """
        if wp.max(state.met[step, i, g]) == zero:
            return
        x = state.x[step, i, g]
        v = state.after[step, i, g]
        own = mean_adjoint(state, adjoint, step, i, g)
        for k in range(model.near_count[i, g]):
            j = model.near[i, k, g]
            if j > i and closes(state.x[step, j, g] - x, state.after[step, j, g] - v):
                add_adjoint(model, state, adjoint, step, i, g, j, model.near_lanes[i, k, g], own)

    @wp.func
    def add_pairs_adjoint(model: Model, state: State, adjoint: Adjoint, step: int, i: int, g: int):
        """`collided_adjoint` for a single thread."""
        if wp.max(state.met[step, i, g]) == zero:
            return
        own = mean_adjoint(state, adjoint, step, i, g)
        for place in range(model.pair_rows[g, i], model.pair_rows[g, i + 1]):
            k = plain(place)
            add_adjoint(model, state, adjoint, step, i, g, plain(model.pair_other[g, k]), model.pair_lanes[g, k], own)

    @wp.func
    def add_all_pairs_adjoint(model: Model, state: State, adjoint: Adjoint, step: int, g: int):
        for i in range(model.nodes):
            add_pairs_adjoint(model, state, adjoint, step, i, g)

    if width == 1:
        _, _, add_all_pairs, add_all_pairs_adjoint = blocks.functions(real)
    return collided, add_all_pairs, after_pairs, collided_adjoint, add_all_pairs_adjoint
