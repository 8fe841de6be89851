"""Kernels that run one term of the simulator by itself, in float64, for tests of its adjoint."""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from neuspring.core.device import load, start_warp
from neuspring.physics import collision, springs
from neuspring.physics.arrays import structs
from neuspring.physics.lanes import lanes
from neuspring.physics.motion import position, velocity


@functools.cache
def kernels(width: int) -> SimpleNamespace:
    """Terms for one width and their adjoints, in a module of their own; impulses by a thread per node and by one for all pairs."""
    start_warp()
    real = wp.float64
    Model, State, Adjoint = structs(real, width)
    lane = lanes(real, width)
    vectors: Any = wp.array(dtype=lane.Vector)
    numbers: Any = wp.array(dtype=lane.Number)
    add_row, add_row_adjoint, gathered, gathered_adjoint = springs.functions(real, width)
    _, updated, updated_adjoint = velocity(real, width)
    moved, moved_adjoint = position(real, width)
    collided, add_pairs, after_pairs, collided_adjoint, add_pairs_adjoint = collision.functions(real, width)

    def rows(model: Model, state: State):
        g = wp.tid()
        for i in range(model.nodes):
            add_row(model, state, 0, i, g)

    def rows_adjoint(model: Model, state: State, adjoint: Adjoint):
        g = wp.tid()
        for i in range(model.nodes):
            add_row_adjoint(model, state, adjoint, 0, 0, i, g)

    def links(model: Model, state: State):
        i, g = wp.tid()
        state.force[i, g] = gathered(model, state, 0, i, g)

    def links_adjoint(model: Model, state: State, adjoint: Adjoint):
        i, g = wp.tid()
        gathered_adjoint(model, state, adjoint, 0, 0, i, g)

    def speed(v: vectors, force: vectors, gravity: vectors, dt: numbers, decay: numbers, light: numbers, after: vectors):
        i = wp.tid()
        after[i] = updated(v[i], force[i], gravity[0], dt[0], decay[0], light[i])

    def speed_adjoint(
        after: vectors,
        weight: vectors,
        dt: numbers,
        decay: numbers,
        light: numbers,
        adj_v: vectors,
        adj_force: vectors,
        adj_decay: numbers,
    ):
        i = wp.tid()
        own_v, own_force, own_decay = updated_adjoint(after[i], weight[i], dt[0], decay[0], light[i])
        adj_v[i] = own_v
        adj_force[i] = own_force
        adj_decay[i] = own_decay

    def motion(
        x: vectors,
        v: vectors,
        dt: numbers,
        up: wp.float64,
        e: numbers,
        mu: numbers,
        after_x: vectors,
        after_v: vectors,
    ):
        i = wp.tid()
        own_x, own_v = moved(x[i], v[i], dt[0], up, e[0], mu[0])
        after_x[i] = own_x
        after_v[i] = own_v

    def motion_adjoint(
        x: vectors,
        v: vectors,
        dt: numbers,
        up: wp.float64,
        e: numbers,
        mu: numbers,
        adj_x: vectors,
        adj_v: vectors,
        adj_e: numbers,
        adj_mu: numbers,
    ):
        i = wp.tid()
        own_x, own_v, own_e, own_mu = moved_adjoint(x[i], v[i], dt[0], up, e[0], mu[0], adj_x[i], adj_v[i])
        adj_x[i] = own_x
        adj_v[i] = own_v
        adj_e[i] = own_e
        adj_mu[i] = own_mu

    def collide(model: Model, state: State):
        i, g = wp.tid()
        state.moving[0, i, g] = collided(model, state, 0, 0, i, g)

    def collide_pairs(model: Model, state: State):
        g = wp.tid()
        for i in range(model.nodes):
            state.moving[0, i, g] = lane.Vector()
            state.met[0, i, g] = lane.Number()
        for i in range(model.nodes):
            add_pairs(model, state, 0, 0, i, g)
        for i in range(model.nodes):
            state.moving[0, i, g] = after_pairs(state, 0, i, g)

    def collide_adjoint(model: Model, state: State, adjoint: Adjoint):
        i, g = wp.tid()
        collided_adjoint(model, state, adjoint, 0, i, g)

    def collide_pairs_adjoint(model: Model, state: State, adjoint: Adjoint):
        g = wp.tid()
        for i in range(model.nodes):
            add_pairs_adjoint(model, state, adjoint, 0, i, g)

    made = wp.kernel(module=f"tests.support.terms.{width}", enable_backward=False)
    terms = (rows, rows_adjoint, links, links_adjoint, speed, speed_adjoint, motion, motion_adjoint)
    impulses = (collide, collide_pairs, collide_adjoint, collide_pairs_adjoint)
    return SimpleNamespace(**{term.__name__: made(term) for term in (*terms, *impulses)})


def launch(kernel: Any, size: int | tuple[int, int], *arguments: Any) -> None:
    """Run a kernel on the CPU."""
    wp.launch(load(kernel, "cpu"), size, list(arguments), device="cpu")


def vectors(values: np.ndarray) -> Any:
    """[W, n, 3] -> Warp array [n] of Vectors."""
    array = np.ascontiguousarray(np.asarray(values, np.float64).transpose(1, 2, 0))
    return wp.array(array, dtype=lanes(wp.float64, array.shape[-1]).Vector, device="cpu")


def numbers(values: np.ndarray) -> Any:
    """[W, n] -> Warp array [n] of Numbers, or [W] -> [1]."""
    array = np.asarray(values, np.float64).reshape(len(values), -1)
    return wp.array(np.ascontiguousarray(array.T), dtype=lanes(wp.float64, len(array)).Number, device="cpu")


def twins(array: Any) -> np.ndarray:
    """A Warp array of Vectors as [W, n, 3], or of Numbers as [W, n]."""
    values: np.ndarray = np.moveaxis(array.numpy(), -1, 0).copy()
    return values
