"""A frame as kernels, forward and backward, composed of the functions of the terms.

- CPU: one thread per group computes all nodes and substeps in one launch, and each spring once. Lanes are the parallel direction.
- GPU (`threads`): one thread per node of each twin, one launch per substep. Each spring is gathered at both ends, without
  atomics.

Both sum the forces of a node in the same order.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any, NamedTuple

import warp as wp

from neuspring.physics import collision, motion, springs
from neuspring.physics.arrays import UNFUSED, structs
from neuspring.physics.lanes import lanes


class Kernels(NamedTuple):
    """Kernels of a frame for one scalar type and width."""

    forward: Any
    """A frame on one thread per group."""
    backward: Any
    """The adjoint of `forward`."""
    begin: Any
    """Controllers at the end of the first substep, one thread each."""
    substep: Any
    """A substep, one thread per point. With self-collision only its first half: forces and velocity."""
    collide: Any
    """The second half of a substep with self-collision: impulses and motion."""
    settle: Any
    """Adjoint of motion and velocity: from dL/d(x', v') to dL/d(x, v, force) of a substep."""
    pull: Any
    """Adjoint of the springs of a substep. Without self-collision, also `settle` of the previous substep."""
    hit: Any
    """Adjoint of the impulses."""
    slow: Any
    """Adjoint of the velocity update, after `hit`."""


@functools.cache
def kernels(real: Any, width: int, pushes: bool = True) -> Kernels:
    """Kernels for a scalar type, wp.float32 or wp.float64, and a number of lanes. `pushes`: some springs only push."""
    lane = lanes(real, width)
    Vector, Number, chosen, chosen_number = lane.Vector, lane.Number, lane.chosen, lane.chosen_number
    Model, State, Adjoint = structs(real, width)
    move_controller, updated, updated_adjoint = motion.velocity(real, width)
    moved, moved_adjoint = motion.position(real, width)
    collided, add_all_pairs, after_pairs, collided_adjoint, add_all_pairs_adjoint = collision.functions(real, width)
    add_row, add_row_adjoint, gathered, gathered_adjoint = springs.functions(real, width, pushes)

    @wp.func
    def advance(model: Model, state: State, step: int, i: int, g: int, moving: Vector):
        """Store x' and v' of node i. A twin that has reached the end of its frame stays in place."""
        slot = step % model.slots
        x, v = moved(state.x[slot, i, g], moving, model.substep[g], model.up, model.ground_e[g], model.ground_mu[g])
        if step >= model.fewest:
            x = chosen(step, model.counts[g], x, state.x[slot, i, g])
            v = chosen(step, model.counts[g], v, state.v[slot, i, g])
        target = (step + 1) % model.slots
        state.x[target, i, g] = x
        state.v[target, i, g] = v

    @wp.func
    def advance_adjoint(model: Model, state: State, adjoint: Adjoint, step: int, i: int, g: int):
        """Adjoint of `advance`: dL/d(x', v') -> dL/d(x) and dL/d(`moving`)."""
        adj_x, adj_v, adj_e, adj_mu = moved_adjoint(
            state.x[step, i, g],
            state.moving[step, i, g],
            model.substep[g],
            model.up,
            model.ground_e[g],
            model.ground_mu[g],
            adjoint.x[i, g],
            adjoint.v[i, g],
        )
        if step >= model.fewest:
            adj_x = chosen(step, model.counts[g], adj_x, adjoint.x[i, g])
            adj_v = chosen(step, model.counts[g], adj_v, Vector())
            adj_e = chosen_number(step, model.counts[g], adj_e, Number())
            adj_mu = chosen_number(step, model.counts[g], adj_mu, Number())
        adjoint.x[i, g] = adj_x
        adjoint.moving[i, g] = adj_v
        adjoint.ground_e[i, g] = adjoint.ground_e[i, g] + adj_e
        adjoint.ground_mu[i, g] = adjoint.ground_mu[i, g] + adj_mu

    @wp.func
    def update(model: Model, state: State, slot: int, i: int, g: int, force: Vector) -> Vector:
        """The velocity of node i after forces and drag."""
        return updated(state.v[slot, i, g], force, model.gravity, model.substep[g], model.decay[g], model.inverse_mass[i, g])

    @wp.func
    def update_adjoint(model: Model, state: State, adjoint: Adjoint, step: int, i: int, g: int):
        """Adjoint of `update`: dL/d(velocity after the forces) -> dL/d(v, force, decay)."""
        adj_v, adj_force, adj_decay = updated_adjoint(
            state.after[step, i, g], adjoint.after[i, g], model.substep[g], model.decay[g], model.inverse_mass[i, g]
        )
        if step >= model.fewest:
            adj_v = chosen(step, model.counts[g], adj_v, adjoint.v[i, g])
        adjoint.v[i, g] = adj_v
        adjoint.force[step % 2, i, g] = adj_force
        adjoint.decay[i, g] = adjoint.decay[i, g] + adj_decay

    def forward(model: Model, state: State):
        g = wp.tid()
        for step in range(model.first, model.substeps):
            slot = step % model.slots
            inner = step % model.history
            for c in range(model.controllers):  #  x_c = begin + (end - begin) (k + 1) / n
                move_controller(model, state, step, slot, c, g)
            for i in range(model.nodes):  #  (1-3)  F_i = sum over j of (Y (l / l0 - 1) + gamma (v_j - v_i) . d) d
                add_row(model, state, slot, i, g)
            for i in range(model.nodes):  #    (4)  v' = (v + dt (F / m + g)) delta
                after = update(model, state, slot, i, g, state.force[i, g])
                state.force[i, g] = Vector()
                state.after[inner, i, g] = after
                if model.collide == 0:  #      (4)  x' = x + dt v', reflected at the ground
                    advance(model, state, step, i, g, after)
            if model.collide != 0:
                for i in range(model.nodes):
                    state.moving[inner, i, g] = Vector()
                    state.met[inner, i, g] = Number()
                add_all_pairs(model, state, slot, inner, g)  # v' += mean impulse from the colliding partners
                for i in range(model.nodes):
                    moving = after_pairs(state, inner, i, g)
                    state.moving[inner, i, g] = moving
                    advance(model, state, step, i, g, moving)

    def backward(model: Model, state: State, adjoint: Adjoint):
        """The adjoints of `forward`, in reverse order."""
        g = wp.tid()
        for done in range(model.substeps):
            step = model.substeps - 1 - done
            for i in range(model.nodes):
                advance_adjoint(model, state, adjoint, step, i, g)
            if model.collide != 0:
                for i in range(model.nodes):
                    adjoint.after[i, g] = adjoint.moving[i, g]
                add_all_pairs_adjoint(model, state, adjoint, step, g)
            for i in range(model.nodes):
                update_adjoint(model, state, adjoint, step, i, g)
            for i in range(model.nodes):
                add_row_adjoint(model, state, adjoint, step, step % 2, i, g)

    def begin(model: Model, state: State):
        c, g = wp.tid()
        move_controller(model, state, 0, 0, c, g)

    @wp.func
    def settled(model: Model, state: State, adjoint: Adjoint, step: int, i: int, g: int):
        advance_adjoint(model, state, adjoint, step, i, g)
        if model.collide == 0:
            update_adjoint(model, state, adjoint, step, i, g)
        else:
            adjoint.after[i, g] = adjoint.moving[i, g]

    def substep(model: Model, state: State, step: int):
        i, g = wp.tid()
        slot = step % model.slots
        if i >= model.nodes:
            # The position of a controller in the next substep; this substep does not read it.
            move_controller(model, state, step + 1, (step + 1) % model.slots, i - model.nodes, g)
            return
        force = gathered(model, state, slot, i, g)
        after = update(model, state, slot, i, g, force)
        state.after[step % model.history, i, g] = after
        if model.collide == 0:
            advance(model, state, step, i, g, after)

    def collide(model: Model, state: State, step: int):
        i, g = wp.tid()
        inner = step % model.history
        moving = collided(model, state, step % model.slots, inner, i, g)
        state.moving[inner, i, g] = moving
        advance(model, state, step, i, g, moving)

    def of_node(adjoint_of_node: Any) -> Any:
        """Return a kernel that calls an adjoint for each node."""

        def kernel(model: Model, state: State, adjoint: Adjoint, step: int):
            i, g = wp.tid()
            adjoint_of_node(model, state, adjoint, step, i, g)

        return kernel

    def pull(model: Model, state: State, adjoint: Adjoint, step: int):
        i, g = wp.tid()
        gathered_adjoint(model, state, adjoint, step, step % 2, i, g)
        if model.collide == 0 and step > 0:
            settled(model, state, adjoint, step - 1, i, g)

    made = wp.kernel(**UNFUSED)
    settle, hit, slow = map(of_node, (settled, collided_adjoint, update_adjoint))
    return Kernels(*map(made, (forward, backward, begin, substep, collide, settle, pull, hit, slow)))
