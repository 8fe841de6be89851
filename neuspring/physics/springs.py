"""Spring and dashpot forces (the paper's equations 2 and 3), and their adjoint.

With d = (x_j - x_i) / l, l = |x_j - x_i|, strain s = l / l0 - 1 and closing speed w = (v_j - v_i) . d, spring e = (i, j) adds

    f_e = (Y s + gamma w) d        to node i, and -f_e to node j.

`Graph` lists the springs twice: as rows, each spring once at its lower end, for one thread that goes through all nodes in turn;
and as links, each spring at both ends, for a thread per node that shares nothing with others. A node's sum goes through its
partners in ascending order both ways, so both give the same numbers.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp

from neuspring.physics.arrays import Buffers, structs
from neuspring.physics.lanes import lanes


class Functions(NamedTuple):
    """Functions of this file for one scalar type and width."""

    force: Any
    """(offset, relative velocity, Y, 1 / l0, gamma) -> the force on the first end."""
    force_adjoint: Any
    """(the same, c) -> adjoints of c . f: of offset, of relative velocity, of Y, (1/Y) of 1 / l0, of gamma."""
    add_row: Any
    add_row_adjoint: Any
    gathered: Any
    gathered_adjoint: Any


class Graph(NamedTuple):
    """Springs of a solver in its own order: by lower end, then by upper end."""

    order: np.ndarray
    """Where each spring stands in the caller's list [S]."""
    rows: np.ndarray
    """First spring of each node's row [N + 1]."""
    partners: np.ndarray
    """Upper end of each spring [S]."""
    links: np.ndarray
    """First link of each node [N + 1]."""
    link_partners: np.ndarray
    """Other end of each link, ascending within a node."""
    link_springs: np.ndarray
    """The link's spring."""

    @classmethod
    def of(cls, pairs: np.ndarray, nodes: int) -> "Graph":
        """From springs [S, 2] between points; i >= nodes means controller i - nodes."""
        ends = np.sort(np.asarray(pairs, np.int32).reshape(-1, 2), axis=1)
        order = np.lexsort((ends[:, 1], ends[:, 0]))
        lower, upper = ends[order].T
        first, other, spring = np.concatenate([lower, upper]), np.concatenate([upper, lower]), np.tile(np.arange(len(order)), 2)
        linked = np.lexsort((other, first))
        linked = linked[first[linked] < nodes]
        places = np.arange(nodes + 1)
        return cls(
            order,
            np.searchsorted(lower, places),
            upper,
            np.searchsorted(first[linked], places),
            other[linked],
            spring[linked],
        )


def pack(values: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Parameters [S, 3] of springs: Y [N], 1 / l0 [1/m], gamma [N s/m]."""
    stiffness = values["stiffness"]
    return torch.stack([stiffness, 1.0 / values["rest_lengths"], values["dashpot"].expand_as(stiffness)], dim=-1)


def allocate(b: Buffers, pairs: np.ndarray) -> None:
    """Springs between `pairs` [S, 2] of points."""
    graph = Graph.of(pairs, b.nodes)
    b.add_integers(**{name: getattr(graph, name) for name in Graph._fields})
    b.add_numbers(stiffness=len(pairs), inverse_length=len(pairs), dashpot=len(pairs))
    b.add_numbers(adj_stiffness=len(pairs), adj_inverse_length=len(pairs), adj_dashpot=len(pairs))


def fill(b: Buffers, packed: torch.Tensor) -> None:
    """Take parameters [B, S, 3]."""
    ordered = packed[:, b.indices["order"]]
    for column, name in enumerate(("stiffness", "inverse_length", "dashpot")):
        b.set_numbers(name, ordered[..., column])


def gradient(b: Buffers) -> torch.Tensor:
    """dL/d(packed parameters) [B, S, 3]."""
    columns = [b.get_numbers(f"adj_{name}") for name in ("stiffness", "inverse_length", "dashpot")]
    # The kernels leave the factor Y of dL/d(1 / l0) to the end.
    columns[1] = columns[1] * b.get_numbers("stiffness")
    result = torch.empty((*columns[0].shape, 3), dtype=b.dtype, device=b.device)
    result[:, b.indices["order"]] = torch.stack(columns, dim=-1)
    return result


@functools.cache
def functions(real: Any, width: int) -> Functions:
    """Functions for a scalar type, wp.float32 or wp.float64, and a number of lanes."""
    lane = lanes(real, width)
    Number, Vector = lane.Number, lane.Vector
    Model, State, Adjoint = structs(real, width)
    dot, scaled, root, divided, floored = lane.dot, lane.scaled, lane.root, lane.divided, lane.floored
    one = wp.constant(Number(*[real(1.0)] * width))

    @wp.func
    def force(offset: Vector, relative: Vector, stiffness: Number, inverse_length: Number, dashpot: Number) -> Vector:
        length = root(dot(offset, offset))
        d = divided(offset, floored(length))
        strain = wp.cw_mul(length, inverse_length) - one
        return scaled(d, wp.cw_mul(stiffness, strain) + wp.cw_mul(dashpot, dot(relative, d)))

    @wp.func
    def force_adjoint(offset: Vector, relative: Vector, stiffness: Number, inverse_length: Number, dashpot: Number, c: Vector):
        length = root(dot(offset, offset))
        inverse = wp.cw_div(one, floored(length))
        d = scaled(offset, inverse)
        cd = dot(c, d)
        wd = dot(relative, d)
        strain = wp.cw_mul(length, inverse_length) - one
        # d(f.c)/d(offset): the direction turns (c and the relative velocity, without their parts along d), the length
        # stretches the spring (along d).
        turn = wp.cw_mul(wp.cw_mul(stiffness, strain) + wp.cw_mul(dashpot, wd), inverse)
        damped = wp.cw_mul(cd, dashpot)
        drift = wp.cw_mul(damped, inverse)
        along = wp.cw_mul(cd, wp.cw_mul(stiffness, inverse_length) - turn) - wp.cw_mul(wd, drift)
        adj_offset = scaled(c, turn) + scaled(relative, drift) + scaled(d, along)
        return adj_offset, scaled(d, damped), wp.cw_mul(cd, strain), wp.cw_mul(cd, length), wp.cw_mul(cd, wd)

    @wp.func
    def add_row(model: Model, state: State, slot: int, i: int, g: int):
        """Add the forces of node i's row to both ends."""
        x = state.x[slot, i, g]
        v = state.v[slot, i, g]
        total = state.force[i, g]
        for e in range(model.rows[i], model.rows[i + 1]):
            j = model.partners[e]
            f = force(
                state.x[slot, j, g] - x,
                state.v[slot, j, g] - v,
                model.stiffness[e, g],
                model.inverse_length[e, g],
                model.dashpot[e, g],
            )
            total = total + f
            state.force[j, g] = state.force[j, g] - f
        state.force[i, g] = total

    @wp.func
    def add_row_adjoint(model: Model, state: State, adjoint: Adjoint, slot: int, turn: int, i: int, g: int):
        """From dL/d(force) of node i's row to dL/d(x, v) of both ends and dL/d(parameters)."""
        x = state.x[slot, i, g]
        v = state.v[slot, i, g]
        adj_force = adjoint.force[turn, i, g]
        adj_x = adjoint.x[i, g]
        adj_v = adjoint.v[i, g]
        for e in range(model.rows[i], model.rows[i + 1]):
            j = model.partners[e]
            offset, relative, stiffness, inverse_length, dashpot = force_adjoint(
                state.x[slot, j, g] - x,
                state.v[slot, j, g] - v,
                model.stiffness[e, g],
                model.inverse_length[e, g],
                model.dashpot[e, g],
                adj_force - adjoint.force[turn, j, g],
            )
            adj_x = adj_x - offset
            adj_v = adj_v - relative
            adjoint.x[j, g] = adjoint.x[j, g] + offset
            adjoint.v[j, g] = adjoint.v[j, g] + relative
            adjoint.stiffness[e, g] = adjoint.stiffness[e, g] + stiffness
            adjoint.inverse_length[e, g] = adjoint.inverse_length[e, g] + inverse_length
            adjoint.dashpot[e, g] = adjoint.dashpot[e, g] + dashpot
        adjoint.x[i, g] = adj_x
        adjoint.v[i, g] = adj_v

    @wp.func
    def gathered(model: Model, state: State, slot: int, i: int, g: int) -> Vector:
        """The sum of the forces on node i."""
        x = state.x[slot, i, g]
        v = state.v[slot, i, g]
        total = Vector()
        for k in range(model.links[i], model.links[i + 1]):
            j = model.link_partners[k]
            e = model.link_springs[k]
            total = total + force(
                state.x[slot, j, g] - x,
                state.v[slot, j, g] - v,
                model.stiffness[e, g],
                model.inverse_length[e, g],
                model.dashpot[e, g],
            )
        return total

    @wp.func
    def gathered_adjoint(model: Model, state: State, adjoint: Adjoint, slot: int, turn: int, i: int, g: int):
        """From dL/d(force) of node i and its partners to dL/d(x, v) of node i, and to dL/d(parameters) at a spring's lower end."""
        x = state.x[slot, i, g]
        v = state.v[slot, i, g]
        adj_force = adjoint.force[turn, i, g]
        adj_x = adjoint.x[i, g]
        adj_v = adjoint.v[i, g]
        for k in range(model.links[i], model.links[i + 1]):
            j = model.link_partners[k]
            e = model.link_springs[k]
            offset, relative, stiffness, inverse_length, dashpot = force_adjoint(
                state.x[slot, j, g] - x,
                state.v[slot, j, g] - v,
                model.stiffness[e, g],
                model.inverse_length[e, g],
                model.dashpot[e, g],
                adj_force - adjoint.force[turn, j, g],
            )
            adj_x = adj_x - offset
            adj_v = adj_v - relative
            if i < j:
                adjoint.stiffness[e, g] = adjoint.stiffness[e, g] + stiffness
                adjoint.inverse_length[e, g] = adjoint.inverse_length[e, g] + inverse_length
                adjoint.dashpot[e, g] = adjoint.dashpot[e, g] + dashpot
        adjoint.x[i, g] = adj_x
        adjoint.v[i, g] = adj_v

    return Functions(force, force_adjoint, add_row, add_row_adjoint, gathered, gathered_adjoint)
