"""One substep of the anchors and its adjoint: forces gathered over each anchor's own list, semi-implicit Euler, ground.

With d = |x_j - x_i|, n = (x_j - x_i) / d, strain e = d / l - 1 and the rank r of neighbor j by distance in frame 0, anchor i feels

    spring   (s_i / l) eta_r (d - l) (1 + |e|)^p n       (zero where |d - l| < 1e-6 m)
    damping  (zeta / l) ((v_j - v_i) . n) n
    control  c (|q - x_i| / L - 1) (q - x_i) / |q - x_i|  from each controller q with a link to it
    gravity  at unit mass

Nothing reacts on j: this is a gather, not the symmetric spring of `neuspring.physics.springs`. After the step, anchors at or below
the ground are put on it. Their velocity along z becomes zero, that along the ground is multiplied by phi.
"""
# No postponed annotations here: Warp needs the evaluated types of the closures below.

import functools
from typing import Any, NamedTuple

import warp as wp

SLACK = 1e-6
"""Elongations below this exert no force, m."""
MIN_LENGTH = 1e-6
"""Lengths are floored here when a direction is formed, m."""


class Kernels(NamedTuple):
    """Kernels and their arguments for one scalar type. Kernels are launched over [N] anchors."""

    substep: Any
    adjoint: Any
    State: Any
    Model: Any


@functools.cache
def kernels(real: Any) -> Kernels:
    """Kernels for the scalar type `real`, wp.float32 or wp.float64."""
    vec3 = wp.types.vector(3, real)
    slack, floor = wp.constant(real(SLACK)), wp.constant(real(MIN_LENGTH))
    zero, one = wp.constant(real(0.0)), wp.constant(real(1.0))

    @wp.struct
    class State:
        x: wp.array2d(dtype=vec3)  # [substeps + 1, N]
        v: wp.array2d(dtype=vec3)
        stiffness: wp.array(dtype=real)  # [N]
        soft: wp.array(dtype=real)  # [K]
        scalars: wp.array(dtype=real)  # zeta, phi

    @wp.struct
    class Model:
        neighbors: wp.array2d(dtype=wp.int32)
        lengths: wp.array2d(dtype=real)
        link_starts: wp.array(dtype=wp.int32)
        links: wp.array(dtype=wp.int32)
        link_lengths: wp.array(dtype=real)
        begin: wp.array(dtype=vec3)  # controllers at the start of the frame
        end: wp.array(dtype=vec3)
        exponent: real
        link_stiffness: real
        substep: real
        gravity: real
        up: real
        ground: int

    def anchor_substep(slot: int, fraction: real, state: State, model: Model):
        i = wp.tid()
        at = state.x[slot, i]
        speed = state.v[slot, i]
        force = vec3(zero, zero, model.gravity)
        for r in range(model.neighbors.shape[1]):
            j = model.neighbors[i, r]
            rest = model.lengths[i, r]
            offset = state.x[slot, j] - at
            length = wp.length(offset)
            n = offset / wp.max(length, floor)
            stretch = length - rest
            pull = state.scalars[0] / rest * wp.dot(state.v[slot, j] - speed, n)
            if wp.abs(stretch) >= slack:
                pull += state.stiffness[i] / rest * state.soft[r] * stretch * wp.pow(one + wp.abs(stretch) / rest, model.exponent)
            force += n * pull
        for k in range(model.link_starts[i], model.link_starts[i + 1]):
            c = model.links[k]
            reach = model.begin[c] * (one - fraction) + model.end[c] * fraction - at
            distance = wp.length(reach)
            force += reach / wp.max(distance, floor) * (model.link_stiffness * (distance / model.link_lengths[k] - one))
        moved = speed + force * model.substep
        target = at + moved * model.substep
        if model.ground != 0 and model.up * target[2] <= zero:
            target = vec3(target[0], target[1], zero)
            moved = vec3(moved[0] * state.scalars[1], moved[1] * state.scalars[1], zero)
        state.x[slot + 1, i] = target
        state.v[slot + 1, i] = moved

    def anchor_substep_adjoint(slot: int, fraction: real, state: State, model: Model, adjoint: State):
        i = wp.tid()
        at = state.x[slot, i]
        speed = state.v[slot, i]
        to = adjoint.x[slot + 1, i]
        by = adjoint.v[slot + 1, i]
        # Only the ground puts a point at exactly 0.
        if model.ground != 0 and state.x[slot + 1, i][2] == zero:
            # Along the ground the step is x + h u: u is read from the positions, as phi may be 0.
            u = (state.x[slot + 1, i] - at) / model.substep
            wp.atomic_add(adjoint.scalars, 1, by[0] * u[0] + by[1] * u[1])
            to = vec3(to[0], to[1], zero)
            by = vec3(by[0] * state.scalars[1], by[1] * state.scalars[1], zero)
        by += to * model.substep
        c = by * model.substep
        damping = zero
        hard = zero
        for r in range(model.neighbors.shape[1]):
            j = model.neighbors[i, r]
            rest = model.lengths[i, r]
            offset = state.x[slot, j] - at
            length = wp.max(wp.length(offset), floor)
            n = offset / length
            stretch = length - rest
            relative = state.v[slot, j] - speed
            closing = wp.dot(relative, n)
            cn = wp.dot(c, n)
            dashpot = state.scalars[0] / rest
            pull = dashpot * closing
            slope = zero
            if wp.abs(stretch) >= slack:
                strain = wp.abs(stretch) / rest
                grown = wp.pow(one + strain, model.exponent)
                unit = stretch / rest * grown
                spring = state.stiffness[i] * state.soft[r]
                pull += spring * unit
                slope = spring / rest * grown * (one + model.exponent * strain / (one + strain))
                hard += cn * state.soft[r] * unit
                wp.atomic_add(adjoint.soft, r, cn * state.stiffness[i] * unit)
            damping += cn * closing / rest
            # The direction turns (c and the relative velocity, without their parts along n), the length stretches the spring.
            g = (c - n * cn) * (pull / length) + (relative - n * closing) * (dashpot * cn / length) + n * (cn * slope)
            w = n * (cn * dashpot)
            wp.atomic_add(adjoint.x, slot, j, g)
            wp.atomic_add(adjoint.v, slot, j, w)
            to -= g
            by -= w
        for k in range(model.link_starts[i], model.link_starts[i + 1]):
            q = model.links[k]
            reach = model.begin[q] * (one - fraction) + model.end[q] * fraction - at
            distance = wp.max(wp.length(reach), floor)
            m = reach / distance
            cm = wp.dot(c, m)
            turn = model.link_stiffness * (one / model.link_lengths[k] - one / distance)
            to -= (c - m * cm) * turn + m * (cm * model.link_stiffness / model.link_lengths[k])
        wp.atomic_add(adjoint.x, slot, i, to)
        wp.atomic_add(adjoint.v, slot, i, by)
        wp.atomic_add(adjoint.scalars, 0, damping)
        adjoint.stiffness[i] = adjoint.stiffness[i] + hard

    unique = wp.kernel(module="unique", enable_backward=False)
    return Kernels(unique(anchor_substep), unique(anchor_substep_adjoint), State, Model)
