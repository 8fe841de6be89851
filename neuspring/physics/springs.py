"""Spring and dashpot forces (the paper's equations 2 and 3), and their adjoint.

With d = (x_j - x_i) / l, l = |x_j - x_i|, strain s = l / l0 - 1 and closing speed w = (v_j - v_i) . d, spring e = (i, j) adds

    f_e = (Y s + gamma w) d        to node i, and -f_e to node j.

A controller spring that only pushes has no force while it is longer than at rest. Its 1 / l0 is stored as a negative number.

`allocate` lists the springs twice:

- rows: each spring once, at its lower end, for a single thread
- links: each spring at both ends, for one thread per node, without shared writes

Both sum the forces of a node over its partners in ascending order, so both have the same numbers. Each scene has its own table of
springs.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from neuspring.physics import blocks
from neuspring.physics.arrays import BEHIND, Buffers, structs
from neuspring.physics.lanes import lanes


def allocate(b: Buffers, tables: Sequence[np.ndarray]) -> None:
    """Allocate tables of springs [S, 2] between points, one per scene; i >= nodes means controller i - nodes.

    Springs are sorted by lower end, then by upper end. Several tables must already be sorted.
    """
    rows, links = [_rows(b.nodes, pairs) for pairs in tables], [_links(b.nodes, pairs) for pairs in tables]
    starts, link_starts = (np.cumsum([0, *(len(one[-1]) for one in each)])[:-1] for each in (rows, links))
    most = max(len(order) for order, _, _ in rows)
    order = rows[0][0] if len(tables) == 1 else np.arange(most)
    b.add_integers(
        order=order,  # Index of each spring in the caller's list [S].
        ranks=np.argsort(order),  # Index here of each spring of the caller's list [S].
        # First spring of each node's row [N + 1], and upper end of each spring; tables are concatenated.
        rows=np.concatenate([first + start for (_, first, _), start in zip(rows, starts, strict=True)]),
        partners=np.concatenate([*(upper for _, _, upper in rows), np.zeros(BEHIND)]),
        # First link of each node; other end of each link, ascending within a node; spring of each link in its table.
        links=np.concatenate([first + start for (first, _, _), start in zip(links, link_starts, strict=True)]),
        link_partners=np.concatenate([other for _, other, _ in links]),
        link_springs=np.concatenate([spring for _, _, spring in links]),
        # For each group: offsets of its table in rows and links, and in springs.
        first_row=np.array(b.table_of_group) * (b.nodes + 1),
        first_spring=starts[b.table_of_group],
    )


def _sorted(pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ends = np.sort(np.asarray(pairs, np.int32).reshape(-1, 2), axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    return order, ends[order]


def _rows(nodes: int, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Order of the springs of a table, first spring of each row [N + 1], upper ends [S]."""
    order, ends = _sorted(pairs)
    return order, np.searchsorted(ends[:, 0], np.arange(nodes + 1)), ends[:, 1]


def _links(nodes: int, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First link of each node [N + 1], other end and spring of each link."""
    order, ends = _sorted(pairs)
    first, other, spring = ends.T.reshape(-1), ends[:, ::-1].T.reshape(-1), np.tile(np.arange(len(order)), 2)
    linked = np.lexsort((other, first))
    linked = linked[first[linked] < nodes]
    return np.searchsorted(first[linked], np.arange(nodes + 1)), other[linked], spring[linked]


@functools.cache
def functions(real: Any, width: int, pushes: bool) -> tuple[Any, Any, Any, Any]:
    """(add_row, its adjoint, gathered, its adjoint) for a scalar type, wp.float32 or wp.float64, and a number of lanes.

    `pushes`: some springs only push. The check costs a fifth of the time in lanes.
    """
    lane = lanes(real, width)
    Number, Vector = lane.Number, lane.Vector
    Model, State, Adjoint = structs(real, width)
    dot, scaled, root, divided, floored = lane.dot, lane.scaled, lane.root, lane.divided, lane.floored
    plain = lane.plain
    one = Number(*[real(1.0)] * width)
    half = Number(*[real(0.5)] * width)

    @wp.func
    def acts(strain: Number, p: Vector) -> Number:
        """Return 0 for a spring that only pushes and is longer than at rest, otherwise 1."""
        return wp.cw_mul(half, one + wp.sign(-wp.min(strain, -p[1])))

    @wp.func
    def pull(model: Model, state: State, slot: int, e: int, j: int, g: int, x: Vector, v: Vector) -> Vector:
        """Return the force of spring e on its end at x with velocity v; j is the other end."""
        offset = state.x[slot, j, g] - x
        relative = state.v[slot, j, g] - v
        p = model.springs[e, g]  # Rows: Y, 1 / l0, gamma.
        length = root(dot(offset, offset))
        d = divided(offset, floored(length))
        strain = wp.cw_mul(length, wp.abs(p[1])) - one
        size = wp.cw_mul(p[0], strain) + wp.cw_mul(p[2], dot(relative, d))
        if pushes:
            size = wp.cw_mul(size, acts(strain, p))
        return scaled(d, size)

    @wp.func
    def pull_adjoint(model: Model, state: State, slot: int, e: int, j: int, g: int, x: Vector, v: Vector, adj_force: Vector):
        """Return the adjoints of offset, relative velocity and parameters (second row divided by Y)."""
        offset = state.x[slot, j, g] - x
        relative = state.v[slot, j, g] - v
        p = model.springs[e, g]
        # d = offset / l is substituted, so that d is not computed.
        length = root(dot(offset, offset))
        inverse = wp.cw_div(one, floored(length))
        shorter = wp.abs(p[1])
        strain = wp.cw_mul(length, shorter) - one
        c = adj_force
        if pushes:
            c = scaled(c, acts(strain, p))
        cd = wp.cw_mul(dot(c, offset), inverse)
        wd = wp.cw_mul(dot(relative, offset), inverse)
        # d(f.c)/d(offset): a rotation of d acts on the components of c and relative velocity normal to d; a change of length
        # acts along d.
        turn = wp.cw_mul(wp.cw_mul(p[0], strain) + wp.cw_mul(p[2], wd), inverse)
        drift = wp.cw_mul(wp.cw_mul(cd, p[2]), inverse)
        along = wp.cw_mul(cd, wp.cw_mul(p[0], shorter) - turn) - wp.cw_mul(wd, drift)
        adj_offset = scaled(c, turn) + scaled(relative, drift) + scaled(offset, wp.cw_mul(along, inverse))
        return adj_offset, scaled(offset, drift), scaled(wp.matrix_from_rows(strain, wp.cw_mul(length, wp.sign(p[1])), wd), cd)

    @wp.func
    def add_row(model: Model, state: State, slot: int, i: int, g: int):
        """Add the forces of node i's row to both ends."""
        x = state.x[slot, i, g]
        v = state.v[slot, i, g]
        total = state.force[i, g]
        row = plain(model.first_row[g] + i)
        first = model.first_spring[g]
        for each in range(model.rows[row], model.rows[row + 1]):
            e = plain(each - first)
            j = plain(model.partners[plain(each)])
            f = pull(model, state, slot, e, j, g, x, v)
            total = total + f
            state.force[j, g] = state.force[j, g] - f
        state.force[i, g] = total

    @wp.func
    def add_row_adjoint(model: Model, state: State, adjoint: Adjoint, slot: int, turn: int, i: int, g: int):
        """Adjoint of `add_row`: dL/d(force) of node i's row -> dL/d(x, v) of both ends and dL/d(parameters)."""
        x = state.x[slot, i, g]
        v = state.v[slot, i, g]
        adj_force = adjoint.force[turn, i, g]
        adj_x = adjoint.x[i, g]
        adj_v = adjoint.v[i, g]
        row = plain(model.first_row[g] + i)
        first = model.first_spring[g]
        for each in range(model.rows[row], model.rows[row + 1]):
            e = plain(each - first)
            j = plain(model.partners[plain(each)])
            c = adj_force - adjoint.force[turn, j, g]
            offset, relative, parameters = pull_adjoint(model, state, slot, e, j, g, x, v, c)
            adj_x = adj_x - offset
            adj_v = adj_v - relative
            adjoint.x[j, g] = adjoint.x[j, g] + offset
            adjoint.v[j, g] = adjoint.v[j, g] + relative
            adjoint.springs[e, g] = adjoint.springs[e, g] + parameters
        adjoint.x[i, g] = adj_x
        adjoint.v[i, g] = adj_v

    @wp.func
    def gathered(model: Model, state: State, slot: int, i: int, g: int) -> Vector:
        """Return the sum of the forces on node i."""
        x = state.x[slot, i, g]
        v = state.v[slot, i, g]
        total = Vector()
        row = plain(model.first_row[g] + i)
        for each in range(model.links[row], model.links[row + 1]):
            k = plain(each)
            j = plain(model.link_partners[k])
            e = plain(model.link_springs[k])
            total = total + pull(model, state, slot, e, j, g, x, v)
        return total

    @wp.func
    def gathered_adjoint(model: Model, state: State, adjoint: Adjoint, slot: int, turn: int, i: int, g: int):
        """Adjoint of `gathered`: dL/d(force) of node i and partners -> dL/d(x, v) of node i, dL/d(parameters) at lower ends."""
        x = state.x[slot, i, g]
        v = state.v[slot, i, g]
        adj_force = adjoint.force[turn, i, g]
        adj_x = adjoint.x[i, g]
        adj_v = adjoint.v[i, g]
        row = plain(model.first_row[g] + i)
        for each in range(model.links[row], model.links[row + 1]):
            k = plain(each)
            j = plain(model.link_partners[k])
            e = plain(model.link_springs[k])
            c = adj_force - adjoint.force[turn, j, g]
            offset, relative, parameters = pull_adjoint(model, state, slot, e, j, g, x, v, c)
            adj_x = adj_x - offset
            adj_v = adj_v - relative
            if i < j:
                adjoint.springs[e, g] = adjoint.springs[e, g] + parameters
        adjoint.x[i, g] = adj_x
        adjoint.v[i, g] = adj_v

    if width == 1:
        add_row, add_row_adjoint, _, _ = blocks.functions(real)
    return add_row, add_row_adjoint, gathered, gathered_adjoint
