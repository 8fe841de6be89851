"""One substep of the anchors: forces gathered over each anchor's own list, semi-implicit Euler, ground; and its adjoint.

With d = |x_j - x_i|, n = (x_j - x_i) / d, strain e = d / l - 1 and the rank r of neighbour j by distance at frame 0, anchor i feels

    spring   (s_i / l) eta_r (d - l) (1 + |e|)^p n       (zero where |d - l| < 1e-6 m)
    damping  (zeta / l) ((v_j - v_i) . n) n
    control  c (|q - x_i| / L - 1) (q - x_i) / |q - x_i|  from each controller q that it is linked to
    gravity  at unit mass

and no reaction is applied to j: a gather, not the symmetric spring of `neuspring.physics.springs`. After the step, points at or
below the ground are put on it, their velocity along z is zero and along the ground times phi.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any

import warp as wp

SLACK = 1e-6
"""Elongations below this exert no force, m."""
MIN_LENGTH = 1e-6
"""Lengths are floored here when a direction is formed, m."""


@functools.cache
def substep_kernels(real: Any) -> tuple[Any, Any]:
    """(substep, adjoint) kernels for the scalar type `real`, wp.float32 or wp.float64; launched over [N] anchors."""
    vec3 = wp.types.vector(3, real)
    slack, floor = wp.constant(real(SLACK)), wp.constant(real(MIN_LENGTH))
    zero, one = wp.constant(real(0.0)), wp.constant(real(1.0))

    def anchor_substep(
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        slot: int,
        begin: wp.array(dtype=vec3),
        end: wp.array(dtype=vec3),
        fraction: real,
        neighbours: wp.array2d(dtype=wp.int32),
        lengths: wp.array2d(dtype=real),
        stiffness: wp.array(dtype=real),
        soft: wp.array(dtype=real),
        scalars: wp.array(dtype=real),
        exponent: real,
        starts: wp.array(dtype=wp.int32),
        links: wp.array(dtype=wp.int32),
        link_lengths: wp.array(dtype=real),
        link_stiffness: real,
        substep: real,
        gravity: real,
        up: real,
        ground: int,
    ):
        i = wp.tid()
        at = x[slot, i]
        speed = v[slot, i]
        force = vec3(zero, zero, gravity)
        for r in range(neighbours.shape[1]):
            j = neighbours[i, r]
            rest = lengths[i, r]
            offset = x[slot, j] - at
            length = wp.length(offset)
            n = offset / wp.max(length, floor)
            stretch = length - rest
            pull = scalars[0] / rest * wp.dot(v[slot, j] - speed, n)
            if wp.abs(stretch) >= slack:
                pull += stiffness[i] / rest * soft[r] * stretch * wp.pow(one + wp.abs(stretch) / rest, exponent)
            force += n * pull
        for k in range(starts[i], starts[i + 1]):
            c = links[k]
            reach = begin[c] * (one - fraction) + end[c] * fraction - at
            distance = wp.length(reach)
            force += reach / wp.max(distance, floor) * (link_stiffness * (distance / link_lengths[k] - one))
        moved = speed + force * substep
        target = at + moved * substep
        if ground != 0 and up * target[2] <= zero:
            target = vec3(target[0], target[1], zero)
            moved = vec3(moved[0] * scalars[1], moved[1] * scalars[1], zero)
        x[slot + 1, i] = target
        v[slot + 1, i] = moved

    def anchor_substep_adjoint(
        x: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        slot: int,
        begin: wp.array(dtype=vec3),
        end: wp.array(dtype=vec3),
        fraction: real,
        neighbours: wp.array2d(dtype=wp.int32),
        lengths: wp.array2d(dtype=real),
        stiffness: wp.array(dtype=real),
        soft: wp.array(dtype=real),
        scalars: wp.array(dtype=real),
        exponent: real,
        starts: wp.array(dtype=wp.int32),
        links: wp.array(dtype=wp.int32),
        link_lengths: wp.array(dtype=real),
        link_stiffness: real,
        substep: real,
        gravity: real,
        up: real,
        ground: int,
        adj_x: wp.array2d(dtype=vec3),
        adj_v: wp.array2d(dtype=vec3),
        adj_stiffness: wp.array(dtype=real),
        adj_soft: wp.array(dtype=real),
        adj_scalars: wp.array(dtype=real),
    ):
        i = wp.tid()
        at = x[slot, i]
        speed = v[slot, i]
        to = adj_x[slot + 1, i]
        by = adj_v[slot + 1, i]
        # Only the ground puts a point at exactly 0.
        if ground != 0 and x[slot + 1, i][2] == zero:
            # Along the ground the step is x + h u: u is read from the positions, as phi may be 0.
            u = (x[slot + 1, i] - at) / substep
            wp.atomic_add(adj_scalars, 1, by[0] * u[0] + by[1] * u[1])
            to = vec3(to[0], to[1], zero)
            by = vec3(by[0] * scalars[1], by[1] * scalars[1], zero)
        by += to * substep
        c = by * substep
        damping = zero
        hard = zero
        for r in range(neighbours.shape[1]):
            j = neighbours[i, r]
            rest = lengths[i, r]
            offset = x[slot, j] - at
            length = wp.max(wp.length(offset), floor)
            n = offset / length
            stretch = length - rest
            relative = v[slot, j] - speed
            closing = wp.dot(relative, n)
            cn = wp.dot(c, n)
            dashpot = scalars[0] / rest
            pull = dashpot * closing
            slope = zero
            if wp.abs(stretch) >= slack:
                strain = wp.abs(stretch) / rest
                grown = wp.pow(one + strain, exponent)
                unit = stretch / rest * grown
                spring = stiffness[i] * soft[r]
                pull += spring * unit
                slope = spring / rest * grown * (one + exponent * strain / (one + strain))
                hard += cn * soft[r] * unit
                wp.atomic_add(adj_soft, r, cn * stiffness[i] * unit)
            damping += cn * closing / rest
            # The direction turns (c and the relative velocity, without their parts along n), the length stretches the spring.
            g = (c - n * cn) * (pull / length) + (relative - n * closing) * (dashpot * cn / length) + n * (cn * slope)
            w = n * (cn * dashpot)
            wp.atomic_add(adj_x, slot, j, g)
            wp.atomic_add(adj_v, slot, j, w)
            to -= g
            by -= w
        for k in range(starts[i], starts[i + 1]):
            q = links[k]
            reach = begin[q] * (one - fraction) + end[q] * fraction - at
            distance = wp.max(wp.length(reach), floor)
            m = reach / distance
            cm = wp.dot(c, m)
            turn = link_stiffness * (one / link_lengths[k] - one / distance)
            to -= (c - m * cm) * turn + m * (cm * link_stiffness / link_lengths[k])
        wp.atomic_add(adj_x, slot, i, to)
        wp.atomic_add(adj_v, slot, i, by)
        wp.atomic_add(adj_scalars, 0, damping)
        adj_stiffness[i] = adj_stiffness[i] + hard

    unique = wp.kernel(module="unique", enable_backward=False)
    return unique(anchor_substep), unique(anchor_substep_adjoint)
