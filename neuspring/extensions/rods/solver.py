"""Discrete elastic rods (Bergou et al. 2008, 2010) in batch lanes: rods with equally many vertices advance together.

Each rod has one thread.

Forces are the gradients of the energies in README.md. A substep is implicit, so that it is stable for the stiffest cable. It uses
BDF2, or backward Euler in the first substep and after a contact:

    x1 = x* + g v1,   v1 = v* + g a(x1, v1),   x* = (4 x0 - x_) / 3,   v* = (4 v0 - v_) / 3,   g = 2 h / 3

The solution x1 = p + d is around the extrapolated p = 2 x0 - x_, where forces are evaluated once:

    (M (1 + g c) / g^2 + K) d = f(p) + M (v* / g - (1 + g c) (p - x*) / g^2).

c is the drag. Twist is quasi-static: the angles theta have no mass, and the moments about the tangents, including inner damping,
are in balance. So d also contains the changes of the angles, which are extrapolated like p. K is the Gauss-Newton matrix of
bending, damping, twist and stretching; the tension of the previous substep gives edges their lateral stiffness. K couples three
neighbors, so the system is banded and solved by Cholesky. Held vertices and the axes of clamps move linearly within a frame, and
the directors of clamps are the projected axes.
"""
# This module does not postpone annotations: Warp reads the evaluated types of the kernels below.

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
import warp as wp

from neuspring.core.artifacts import Simulation
from neuspring.core.device import load
from neuspring.extensions.rods.rod import Rod

TWIST_STEPS = 60
"""Maximum number of Newton steps of the twist in frame 0, which starts uniform."""
MAX_TURN = wp.float64(0.5)
"""Maximum change of an angle in a Newton step, rad."""
LEAST_PIVOT = wp.float64(1e-3)
"""Minimum pivot of the matrix of these steps, relative to its diagonal entry."""
TINY = wp.float64(1e-12)
BAND_WIDTH = 11
"""Entries of a row of the banded matrix, from the diagonal to the left. Row 4 i + r belongs to x_i, row 4 j + 3 to theta_j."""
JOINT = 11
"""Number of variables of a joint, in the order x_(i-1), theta_(i-1), x_i, theta_i, x_(i+1)."""
FREE_TURN_STIFFNESS = wp.float64(1e-9)
"""Stiffness against rotation about the tangent, as a fraction of GJ / l, for a rod without any other."""

real = wp.float64
vec3 = wp.vec3d
vec2 = wp.vec2d
mat33 = wp.mat33d
Row = wp.types.vector(length=11, dtype=wp.float64)
Scalars: Any = wp.array2d(dtype=real)
Vectors: Any = wp.array2d(dtype=vec3)
Pairs: Any = wp.array2d(dtype=vec2)
Paths: Any = wp.array3d(dtype=vec3)
Numbers: Any = wp.array(dtype=real)
Indices: Any = wp.array2d(dtype=wp.int32)


@wp.struct
class RodState:
    """Parameters and state of B rods."""

    lengths: Scalars
    mass: Scalars
    bending: Scalars
    twisting: Scalars
    curvature: Pairs
    slip: Pairs
    """Branches that slip [B, branches]; see `Rod.slip`."""
    slip_twist: Numbers
    by_angle: Numbers
    stretching: Numbers
    damping: Numbers
    drag: Numbers
    drag_quadratic: Numbers
    roll: Numbers
    axis: Vectors
    """Current direction whose projection gives the roll of each end [B, 2]."""
    held: Indices
    x: Vectors
    v: Vectors
    x_before: Vectors
    v_before: Vectors
    p: Vectors
    """Extrapolated positions."""
    t: Vectors
    u: Vectors
    """Reference directors, which are parallel-transported."""
    m1: Vectors
    m2: Vectors
    kb: Vectors
    """Curvature binormals; see `Rod.by_angle`."""
    theta: Scalars
    theta_before: Scalars
    w: wp.array3d(dtype=real)
    """Derivatives of k1, k2 and the twist of a joint [B, 3, 11]."""
    reference: Scalars
    """Twist of the reference directors at each joint."""
    tension: Scalars
    k: Pairs
    k_before: Pairs
    z: wp.array3d(dtype=vec3)
    """k1, k2 and the twist of each joint for which a branch has no moment [B, V, branches]."""
    history: wp.array(dtype=wp.int32)
    """Number of substeps since the last start or contact."""
    a: wp.array3d(dtype=real)
    """Banded matrix [B, 4 V, 11]: entry q of row i is A[i, i - q]."""
    b: Scalars
    lower: Scalars
    diagonal: Scalars
    rest: Scalars
    spring_edge: Indices
    """Edge on which each spring of a controller acts [B, S]."""
    spring_place: Vectors
    """Point on which each spring acts [B, S]: fraction along the edge, distances along m1 and m2, m."""
    leader: Indices
    """Controller that pulls each spring [B, S]."""
    law: Vectors
    """Stiffness, N/m, rest length, m, and dashpot, N s/m, of each spring [B, S]."""
    hands: Vectors
    """Controllers at the end of the substep."""
    clearance: Scalars
    """Height over the ground at which each vertex touches it, m; below -1: no ground."""
    elasticity: Numbers
    friction: Numbers


@wp.func
def transported(u: vec3, before: vec3, after: vec3):
    """A unit vector normal to `before`, rotated by the smallest rotation from `before` to `after`."""
    w = u - (wp.dot(after, u) / (real(1.0) + wp.dot(before, after) + TINY)) * (before + after)
    w = w - wp.dot(w, after) * after
    return wp.normalize(w)


@wp.func
def projected(d: vec3, t: vec3):
    """The unit vector of the component of d normal to t."""
    w = d - wp.dot(d, t) * t
    return wp.normalize(w)


@wp.func
def turn(a: vec3, b: vec3, t: vec3):
    """Angle from a to b about t."""
    return wp.atan2(wp.dot(wp.cross(a, b), t), wp.dot(a, b))


@wp.func
def edge_length(s: RodState, lane: int, j: int):
    """Length of edge j, m, at the positions p."""
    return wp.length(s.p[lane, j + 1] - s.p[lane, j])


@wp.func
def clamp_angle(s: RodState, lane: int, j: int, end: int):
    """Angle from the reference director of edge j to the axis of an end."""
    return turn(s.u[lane, j], projected(s.axis[lane, end], s.t[lane, j]), s.t[lane, j])


@wp.func
def near(angle: real, before: real):
    """The angle plus the multiple of 2 pi that makes it nearest to `before`."""
    circle = real(6.283185307179586)
    return angle - circle * wp.round((angle - before) / circle)


@wp.func
def set_directors(s: RodState, lane: int, edges: int):
    """Set material directors from reference directors and angles."""
    for j in range(edges):
        c = wp.cos(s.theta[lane, j])
        n = wp.sin(s.theta[lane, j])
        w = wp.cross(s.t[lane, j], s.u[lane, j])
        s.m1[lane, j] = c * s.u[lane, j] + n * w
        s.m2[lane, j] = c * w - n * s.u[lane, j]


@wp.func
def curvature(s: RodState, lane: int, i: int):
    """k1 and k2 of joint i; see `Rod`."""
    kb = s.kb[lane, i]
    k1 = real(0.5) * wp.dot(kb, s.m2[lane, i - 1] + s.m2[lane, i])
    k2 = real(-0.5) * wp.dot(kb, s.m1[lane, i - 1] + s.m1[lane, i])
    return vec2(k1, k2)


@wp.func
def joint_length(s: RodState, lane: int, i: int):
    """Half of the two edges of joint i, m."""
    return real(0.5) * (s.lengths[lane, i - 1] + s.lengths[lane, i])


@wp.func
def twist(s: RodState, lane: int, i: int):
    """Twist of joint i, rad."""
    return s.theta[lane, i] - s.theta[lane, i - 1] + s.reference[lane, i]


@wp.func
def kept(s: RodState, lane: int, i: int, branch: int, away: vec3):
    """Factors that reduce the curvature and twist of a branch to its slip limits."""
    most = s.slip[lane, branch][1] * joint_length(s, lane, i)
    bent = most / wp.max(wp.max(wp.length(vec2(away[0], away[1])), most), TINY)
    most = s.slip_twist[lane] * most
    return vec2(bent, most / wp.max(wp.max(wp.abs(away[2]), most), TINY))


@wp.func
def slid(e: vec2, move: vec2, most: real):
    """e = k - z with |e| <= `most`, after k moves straight by `move`: de = dk, at |e| = most without its component along e.

    During the slip, the tangent of half the angle between e and the direction of motion decreases by exp(-distance / most).
    """
    after = e + move
    if wp.length(after) <= most:
        return after
    way = wp.max(wp.length(move), TINY)
    u = move / way
    along = wp.dot(e, u)
    across = e - along * u
    begin = wp.sqrt(wp.max(most * most - wp.dot(across, across), real(0.0)))
    t = wp.tanh((way - begin + along) / wp.max(most, TINY))
    c = begin / wp.max(most, TINY)
    after = (most * (c + t) / (real(1.0) + c * t)) * u + (wp.sqrt(real(1.0) - t * t) / (real(1.0) + c * t)) * across
    return after


@wp.func
def solve_twist(s: RodState, lane: int, edges: int, first_held: bool, last_held: bool):
    """Set the angles of free edges to a minimum of the energy, from `theta` on, by tridiagonal Newton steps."""
    low = wp.where(first_held, 1, 0)
    high = wp.where(last_held, edges - 2, edges - 1)
    for _step in range(TWIST_STEPS):
        set_directors(s, lane, edges)
        for j in range(edges):
            s.lower[lane, j] = real(0.0)
            s.diagonal[lane, j] = TINY
            s.rest[lane, j] = real(0.0)
        for i in range(1, edges):
            joint = joint_length(s, lane, i)
            m = twist(s, lane, i)
            y = s.twisting[lane, i] / joint
            e = s.bending[lane, i] / joint
            k = curvature(s, lane, i) - s.curvature[lane, i]
            kb = s.kb[lane, i]
            # Derivatives of k1 and k2 with respect to the two angles.
            a1 = real(-0.5) * wp.dot(kb, s.m1[lane, i - 1])
            a2 = real(-0.5) * wp.dot(kb, s.m2[lane, i - 1])
            b1 = real(-0.5) * wp.dot(kb, s.m1[lane, i])
            b2 = real(-0.5) * wp.dot(kb, s.m2[lane, i])
            s.rest[lane, i - 1] = s.rest[lane, i - 1] - y * m + e * (k[0] * a1 + k[1] * a2)
            s.rest[lane, i] = s.rest[lane, i] + y * m + e * (k[0] * b1 + k[1] * b2)
            # The last terms have second derivatives, which are a2 and b2 for k1, -a1 and -b1 for k2.
            s.diagonal[lane, i - 1] = s.diagonal[lane, i - 1] + y + e * (a1 * a1 + a2 * a2 + k[0] * a2 - k[1] * a1)
            s.diagonal[lane, i] = s.diagonal[lane, i] + y + e * (b1 * b1 + b2 * b2 + k[0] * b2 - k[1] * b1)
            s.lower[lane, i] = e * (a1 * b1 + a2 * b2) - y
        for j in range(low, high + 1):
            pivot = s.diagonal[lane, j]
            if j > low:
                w = s.lower[lane, j] / s.diagonal[lane, j - 1]
                pivot = pivot - w * s.lower[lane, j]
                s.rest[lane, j] = s.rest[lane, j] - w * s.rest[lane, j - 1]
            # Positive pivots lead to a minimum instead of a saddle point.
            s.diagonal[lane, j] = wp.max(wp.abs(pivot), LEAST_PIVOT * wp.abs(s.diagonal[lane, j]) + TINY)
        z = real(0.0)
        largest = real(0.0)
        for back in range(high - low + 1):
            j = high - back
            r = s.rest[lane, j]
            if j < high:
                r = r - s.lower[lane, j + 1] * z
            z = r / s.diagonal[lane, j]
            step = wp.clamp(z, -MAX_TURN, MAX_TURN)
            largest = wp.max(largest, wp.abs(step))
            s.theta[lane, j] = s.theta[lane, j] - step
        if largest < real(1e-9):
            break
    set_directors(s, lane, edges)


@wp.func
def bow(cosine: real):
    """An angle over 2 tan of half the angle, and the derivative of its logarithm with respect to the cosine."""
    # A function of the squared tangent of half the angle; near 0 its series.
    x = wp.max(real(1.0) - cosine, real(0.0)) / (real(1.0) + cosine + TINY)
    factor = real(1.0) - x / real(3.0) + x * x / real(5.0)
    slope = real(-1.0) / real(3.0) + real(0.4) * x
    if x > real(1e-4):
        root = wp.sqrt(x)
        factor = wp.atan(root) / root
        slope = (real(1.0) / (real(1.0) + x) - factor) / (real(2.0) * x)
    return vec2(factor, real(-0.5) * slope * (real(1.0) + x) * (real(1.0) + x) / factor)


@wp.func
def set_geometry(s: RodState, lane: int, edges: int):
    """Set tangents, reference directors, their twist, and curvature binormals at the positions p."""
    for j in range(edges):
        t = wp.normalize(s.p[lane, j + 1] - s.p[lane, j])
        s.u[lane, j] = transported(s.u[lane, j], s.t[lane, j], t)
        s.t[lane, j] = t
    for i in range(1, edges):
        before = s.t[lane, i - 1]
        t = s.t[lane, i]
        w = transported(s.u[lane, i - 1], before, t)
        s.reference[lane, i] = near(turn(w, s.u[lane, i], t), s.reference[lane, i])
        cosine = wp.dot(before, t)
        kb = (real(2.0) / (real(1.0) + cosine + TINY)) * wp.cross(before, t)
        if s.by_angle[lane] > real(0.0):
            kb = bow(cosine)[0] * kb
        s.kb[lane, i] = kb


@wp.kernel(enable_backward=False)
def begin(s: RodState):
    """Set directors and twist of frame 0 at the positions x."""
    lane = wp.tid()
    edges = s.x.shape[1] - 1
    first_held = s.held[lane, 0] >= 0 and s.held[lane, 1] >= 0
    last_held = s.held[lane, edges] >= 0 and s.held[lane, edges - 1] >= 0
    total = real(0.0)
    for i in range(edges + 1):
        s.p[lane, i] = s.x[lane, i]
    for j in range(edges):
        s.t[lane, j] = wp.normalize(s.x[lane, j + 1] - s.x[lane, j])
        if j == 0:
            s.u[lane, j] = projected(s.axis[lane, 0], s.t[lane, j])
        else:
            s.u[lane, j] = transported(s.u[lane, j - 1], s.t[lane, j - 1], s.t[lane, j])
        s.reference[lane, j] = real(0.0)
        total += s.lengths[lane, j]
    end = real(0.0)
    if last_held:
        end = s.roll[lane] + clamp_angle(s, lane, edges - 1, 1)
    along = real(0.0)
    for j in range(edges):
        s.theta[lane, j] = end * along / (total - s.lengths[lane, edges - 1])
        along += s.lengths[lane, j]
    set_geometry(s, lane, edges)
    solve_twist(s, lane, edges, first_held, last_held)
    for i in range(1, edges):
        s.k[lane, i] = curvature(s, lane, i)
        s.k_before[lane, i] = s.k[lane, i]
        for branch in range(s.slip.shape[1]):
            s.z[lane, i, branch] = vec3(s.k[lane, i][0], s.k[lane, i][1], twist(s, lane, i))
    for j in range(edges):
        s.tension[lane, j] = real(0.0)
    s.history[lane] = 0


@wp.func
def add_block(s: RodState, lane: int, i: int, j: int, block: mat33):
    """Add a block to the rows of vertex i and the columns of vertex j <= i."""
    for r in range(3):
        for c in range(3):
            q = 4 * (i - j) + r - c
            if q >= 0:
                s.a[lane, 4 * i + r, q] = s.a[lane, 4 * i + r, q] + block[r, c]


@wp.func
def add_force(s: RodState, lane: int, i: int, force: vec3):
    """Add a force to the right-hand side of vertex i."""
    for r in range(3):
        s.b[lane, 4 * i + r] = s.b[lane, 4 * i + r] + force[r]


@wp.func
def put(s: RodState, lane: int, row: int, column: int, value: vec3):
    """Store a derivative with respect to a position."""
    for r in range(3):
        s.w[lane, row, column + r] = value[r]


@wp.func
def slopes(s: RodState, lane: int, i: int, k: vec2):
    """Derivatives of k1, k2 and the twist of joint i, which has curvatures k, with respect to its variables."""
    before = s.t[lane, i - 1]
    after = s.t[lane, i]
    inverse = real(1.0) / (real(1.0) + wp.dot(before, after) + TINY)
    middle = inverse * (before + after)
    n1 = inverse * (s.m1[lane, i - 1] + s.m1[lane, i])
    n2 = inverse * (s.m2[lane, i - 1] + s.m2[lane, i])
    r0 = real(1.0) / edge_length(s, lane, i - 1)
    r1 = real(1.0) / edge_length(s, lane, i)
    kb = s.kb[lane, i]
    half = real(0.5)
    cosine = wp.dot(before, after)
    bowed = vec2(real(1.0), real(0.0))
    if s.by_angle[lane] > real(0.0):
        bowed = bow(cosine)
        n1 = bowed[0] * n1
        n2 = bowed[0] * n2
    # Derivatives with respect to the two edges.
    a1 = r0 * (wp.cross(after, n2) - k[0] * middle)
    b1 = r1 * (-k[0] * middle - wp.cross(before, n2))
    a2 = r0 * (-k[1] * middle - wp.cross(after, n1))
    b2 = r1 * (wp.cross(before, n1) - k[1] * middle)
    a3 = half * r0 * kb
    b3 = half * r1 * kb
    if s.by_angle[lane] > real(0.0):
        by_before = (bowed[1] * r0) * (after - cosine * before)
        by_after = (bowed[1] * r1) * (before - cosine * after)
        a1 = a1 + k[0] * by_before
        b1 = b1 + k[0] * by_after
        a2 = a2 + k[1] * by_before
        b2 = b2 + k[1] * by_after
        a3 = a3 / bowed[0]
        b3 = b3 / bowed[0]
    put(s, lane, 0, 0, -a1)
    put(s, lane, 0, 4, a1 - b1)
    put(s, lane, 0, 8, b1)
    put(s, lane, 1, 0, -a2)
    put(s, lane, 1, 4, a2 - b2)
    put(s, lane, 1, 8, b2)
    put(s, lane, 2, 0, -a3)
    put(s, lane, 2, 4, a3 - b3)
    put(s, lane, 2, 8, b3)
    s.w[lane, 0, 3] = -half * wp.dot(kb, s.m1[lane, i - 1])
    s.w[lane, 0, 7] = -half * wp.dot(kb, s.m1[lane, i])
    s.w[lane, 1, 3] = -half * wp.dot(kb, s.m2[lane, i - 1])
    s.w[lane, 1, 7] = -half * wp.dot(kb, s.m2[lane, i])
    s.w[lane, 2, 3] = real(-1.0)
    s.w[lane, 2, 7] = real(1.0)


@wp.func
def assemble_bending(s: RodState, lane: int, edges: int, rate: real, older: real, oldest: real):
    """Add forces and moments of bending and twist, and their Gauss-Newton matrix. dk/dt = rate k - older k_ + oldest k__.

    A branch that slips uses its secant from z: this parabola is never below the branch's potential, so that a step does not
    overshoot. The tangent, which is 0 along the slip, chatters if modes are fast for a substep.
    """
    for i in range(1, edges):
        joint = joint_length(s, lane, i)
        e = s.bending[lane, i] / joint
        y = e * (real(1.0) + s.damping[lane] * rate)
        z = s.twisting[lane, i] / joint
        k = curvature(s, lane, i)
        change = rate * k - older * s.k[lane, i] + oldest * s.k_before[lane, i]
        moment = e * (k - s.curvature[lane, i] + s.damping[lane] * change)
        m = twist(s, lane, i)
        torque = z * m
        stiff = z
        for branch in range(s.slip.shape[1]):
            away = vec3(k[0], k[1], m) - s.z[lane, i, branch]
            part = s.slip[lane, branch][0] * kept(s, lane, i, branch, away)
            moment = moment + (e * part[0]) * vec2(away[0], away[1])
            y = y + e * part[0]
            torque = torque + z * part[1] * away[2]
            stiff = stiff + z * part[1]
        slopes(s, lane, i, k)
        first = 4 * (i - 1)
        for r in range(JOINT):
            w1 = s.w[lane, 0, r]
            w2 = s.w[lane, 1, r]
            w3 = s.w[lane, 2, r]
            s.b[lane, first + r] = s.b[lane, first + r] - moment[0] * w1 - moment[1] * w2 - torque * w3
            for c in range(r + 1):
                value = y * (w1 * s.w[lane, 0, c] + w2 * s.w[lane, 1, c]) + stiff * w3 * s.w[lane, 2, c]
                s.a[lane, first + r, r - c] = s.a[lane, first + r, r - c] + value
        for side in range(2):
            c = 3 + 4 * side
            # The second derivative of k1 with respect to an angle is the first of k2; that of k2 is minus the first of k1.
            second = moment[0] * s.w[lane, 1, c] - moment[1] * s.w[lane, 0, c]
            s.a[lane, first + c, 0] = s.a[lane, first + c, 0] + wp.max(second, real(0.0)) + FREE_TURN_STIFFNESS * z


@wp.func
def assemble_stretching(s: RodState, lane: int, edges: int):
    """Add forces and matrix of stretching; the tension of the previous substep gives the stiffness across edges."""
    unit = wp.identity(n=3, dtype=real)
    for j in range(edges):
        t = s.t[lane, j]
        length = edge_length(s, lane, j)
        y = s.stretching[lane] / s.lengths[lane, j]
        force = y * (length - s.lengths[lane, j])
        along = wp.outer(t, t)
        block = y * along + (wp.max(s.tension[lane, j], real(0.0)) / length) * (unit - along)
        add_force(s, lane, j, force * t)
        add_force(s, lane, j + 1, -force * t)
        add_block(s, lane, j, j, block)
        add_block(s, lane, j + 1, j + 1, block)
        add_block(s, lane, j + 1, j, -block)


@wp.func
def assemble_hands(s: RodState, lane: int, rate: real, more: real):
    """Add forces, moments and Gauss-Newton matrix of springs from controllers to points on edges; only tension is stiff across.

    A point at the fraction f of edge e, with an offset o that rotates with e, moves by
    J0 dx_j + (t x o) dtheta_j + J1 dx_(j+1), J0 = (1 - f) 1 + t o^T / |e|, J1 = f 1 - t o^T / |e|.
    """
    unit = wp.identity(n=3, dtype=real)
    for k in range(s.law.shape[1]):
        law = s.law[lane, k]
        if law[0] > real(0.0) or law[2] > real(0.0):
            j = s.spring_edge[lane, k]
            at = s.spring_place[lane, k]
            t = s.t[lane, j]
            o = at[1] * s.m1[lane, j] + at[2] * s.m2[lane, j]
            turned = wp.outer(t, o) / edge_length(s, lane, j)
            j0 = (real(1.0) - at[0]) * unit + turned
            j1 = at[0] * unit - turned
            arm = wp.cross(t, o)
            for r in range(3):
                for c in range(3):
                    s.w[lane, r, c] = j0[r, c]
                    s.w[lane, r, 4 + c] = j1[r, c]
                s.w[lane, r, 3] = arm[r]
            on_line = (real(1.0) - at[0]) * s.p[lane, j] + at[0] * s.p[lane, j + 1]
            away = s.hands[lane, s.leader[lane, k]] - on_line - o
            length = wp.max(wp.length(away), TINY)
            d = away / length
            pull = law[0] * (length - law[1])
            along = wp.outer(d, d)
            block = (law[0] + law[2] * rate) * along + (wp.max(pull, real(0.0)) / length) * (unit - along)
            v = j0 * velocity_at(s, lane, j, rate, more) + j1 * velocity_at(s, lane, j + 1, rate, more)
            force = (pull - law[2] * wp.dot(v, d)) * d
            first = 4 * j
            for r in range(7):
                column = vec3(s.w[lane, 0, r], s.w[lane, 1, r], s.w[lane, 2, r])
                s.b[lane, first + r] = s.b[lane, first + r] + wp.dot(column, force)
                column = block * column
                for c in range(r + 1):
                    value = column[0] * s.w[lane, 0, c] + column[1] * s.w[lane, 1, c] + column[2] * s.w[lane, 2, c]
                    s.a[lane, first + r, r - c] = s.a[lane, first + r, r - c] + value
            # The second derivative with respect to the angle, if it is positive.
            s.a[lane, first + 3, 0] = s.a[lane, first + 3, 0] + wp.max(pull * wp.dot(d, o), real(0.0))


@wp.func
def velocity_at(s: RodState, lane: int, i: int, rate: real, more: real):
    """Velocity of a vertex at the end of the substep, if it is then at p."""
    return rate * (s.p[lane, i] - (real(1.0) + more) * s.x[lane, i] + more * s.x_before[lane, i])


@wp.func
def touch_ground(s: RodState, lane: int, i: int, up: real):
    """Move a vertex below its clearance to it, and reflect it like a node (motion.py); the next substep is backward Euler."""
    x = s.x[lane, i]
    v = s.v[lane, i]
    if x[2] * up < s.clearance[lane, i] and v[2] * up < real(0.0):
        speed = wp.sqrt(v[0] * v[0] + v[1] * v[1])
        e = s.elasticity[lane]
        keep = wp.max(real(0.0), real(1.0) - s.friction[lane] * (real(1.0) + e) * wp.abs(v[2]) / wp.max(speed, TINY))
        s.x[lane, i] = vec3(x[0], x[1], up * s.clearance[lane, i])
        s.v[lane, i] = vec3(keep * v[0], keep * v[1], -e * v[2])
        s.history[lane] = 0


@wp.func
def set_known(s: RodState, lane: int, row: int, rows: int):
    """Fix an unknown: its equation becomes 1 d = 0."""
    for q in range(BAND_WIDTH):
        s.a[lane, row, q] = real(0.0)
        if row + q < rows:
            s.a[lane, row + q, q] = real(0.0)
    s.a[lane, row, 0] = real(1.0)
    s.b[lane, row] = real(0.0)


@wp.func
def solve(s: RodState, lane: int, rows: int):
    """Solve by banded Cholesky in place, with inverse diagonals; b gets the solution. A row is in registers, loops are unrolled."""
    for i in range(rows):
        row = Row()
        for q in range(11):
            row[q] = s.a[lane, i, q]
        square = row[0]
        value = s.b[lane, i]
        for left in range(10):
            q = 10 - left
            j = i - q
            if j >= 0:
                entry = row[q]
                for p in range(1, 11):
                    if q + p < 11:
                        entry = entry - row[q + p] * s.a[lane, j, p]
                entry = entry * s.a[lane, j, 0]
                row[q] = entry
                s.a[lane, i, q] = entry
                square = square - entry * entry
                value = value - entry * s.b[lane, j]
        inverse = real(1.0) / wp.sqrt(wp.max(square, TINY))
        s.a[lane, i, 0] = inverse
        s.b[lane, i] = value * inverse
    for back in range(rows):
        i = rows - 1 - back
        value = s.b[lane, i] * s.a[lane, i, 0]
        s.b[lane, i] = value
        for q in range(1, 11):
            if i >= q:
                s.b[lane, i - q] = s.b[lane, i - q] - s.a[lane, i, q] * value


@wp.kernel(enable_backward=False)
def advance(
    s: RodState,
    held: Paths,
    axes: Paths,
    hands: Paths,
    ground: bool,
    still: bool,
    substeps: int,
    h: real,
    gravity: real,
    up: real,
    found: Paths,
    turned: Paths,
):
    """Simulate frames of each lane; `found` and `turned` get their final positions and directors. `still`: frames start at rest.

    Everything is one kernel: with a separate function for a frame, substeps take a fifth longer on a CPU.
    """
    lane = wp.tid()
    vertices = s.x.shape[1]
    edges = vertices - 1
    first_held = s.held[lane, 0] >= 0 and s.held[lane, 1] >= 0
    last_held = s.held[lane, edges] >= 0 and s.held[lane, edges - 1] >= 0
    for frame in range(found.shape[0]):
        if still:
            s.history[lane] = 0
            for i in range(vertices):
                s.v[lane, i] = vec3()
        for step in range(substeps):
            part = real(step + 1) / real(substeps)
            # BDF2, or backward Euler without a previous substep.
            g = h
            more = real(0.0)
            if s.history[lane] > 0:
                g = real(2.0) * h / real(3.0)
                more = real(1.0) / real(3.0)
            rate = real(1.0) / g
            older = (real(1.0) + more) * rate
            oldest = more * rate
            for i in range(vertices):
                if s.held[lane, i] >= 0:
                    s.p[lane, i] = (real(1.0) - part) * held[frame, lane, i] + part * held[frame + 1, lane, i]
                elif s.history[lane] > 0:
                    s.p[lane, i] = real(2.0) * s.x[lane, i] - s.x_before[lane, i]
                else:
                    s.p[lane, i] = s.x[lane, i] + h * s.v[lane, i]
            set_geometry(s, lane, edges)
            # Angles are extrapolated.
            for j in range(edges):
                before = s.theta_before[lane, j]
                s.theta_before[lane, j] = s.theta[lane, j]
                if s.history[lane] > 0:
                    s.theta[lane, j] = real(2.0) * s.theta[lane, j] - before
            for end in range(2):
                s.axis[lane, end] = axes[frame, lane, end] + part * (axes[frame + 1, lane, end] - axes[frame, lane, end])
            # The directors of clamps follow the axis, independent of the path of the tangents.
            if first_held:
                s.theta[lane, 0] = near(clamp_angle(s, lane, 0, 0), s.theta[lane, 0])
            if last_held:
                last = edges - 1
                s.theta[lane, last] = near(s.roll[lane] + clamp_angle(s, lane, last, 1), s.theta[lane, last])
            set_directors(s, lane, edges)
            for i in range(4 * vertices):
                s.b[lane, i] = real(0.0)
                for q in range(BAND_WIDTH):
                    s.a[lane, i, q] = real(0.0)
            assemble_bending(s, lane, edges, rate, older, oldest)
            assemble_stretching(s, lane, edges)
            for hand in range(s.hands.shape[1]):
                s.hands[lane, hand] = (real(1.0) - part) * hands[frame, lane, hand] + part * hands[frame + 1, lane, hand]
            assemble_hands(s, lane, rate, more)
            for i in range(vertices):
                if s.held[lane, i] >= 0:
                    for r in range(3):
                        set_known(s, lane, 4 * i + r, 4 * vertices)
                else:
                    m = s.mass[lane, i]
                    c = real(1.0) + g * (s.drag[lane] + s.drag_quadratic[lane] * wp.length(s.v[lane, i]))
                    x = (real(1.0) + more) * s.x[lane, i] - more * s.x_before[lane, i]
                    v = (real(1.0) + more) * s.v[lane, i] - more * s.v_before[lane, i]
                    force = m * (rate * v - (c * rate * rate) * (s.p[lane, i] - x))
                    add_force(s, lane, i, force + vec3(real(0.0), real(0.0), m * gravity))
                    for r in range(3):
                        s.a[lane, 4 * i + r, 0] = s.a[lane, 4 * i + r, 0] + m * c * rate * rate
            for j in range(vertices):
                if j == edges or (j == 0 and first_held) or (j == edges - 1 and last_held):
                    set_known(s, lane, 4 * j + 3, 4 * vertices)
            solve(s, lane, 4 * vertices)
            for i in range(vertices):
                d = vec3(s.b[lane, 4 * i], s.b[lane, 4 * i + 1], s.b[lane, 4 * i + 2])
                after = s.p[lane, i] + d
                x = (real(1.0) + more) * s.x[lane, i] - more * s.x_before[lane, i]
                v = rate * (after - x)
                if s.held[lane, i] >= 0:
                    v = (held[frame + 1, lane, i] - held[frame, lane, i]) / (h * real(substeps))
                s.x_before[lane, i] = s.x[lane, i]
                s.v_before[lane, i] = s.v[lane, i]
                s.x[lane, i] = after
                s.v[lane, i] = v
            for j in range(edges):
                d = s.x[lane, j + 1] - s.p[lane, j + 1] - s.x[lane, j] + s.p[lane, j]
                length = edge_length(s, lane, j) + wp.dot(s.t[lane, j], d)
                s.tension[lane, j] = s.stretching[lane] * (length / s.lengths[lane, j] - real(1.0))
            for i in range(1, edges):
                s.k_before[lane, i] = s.k[lane, i]
                k = curvature(s, lane, i)
                m = twist(s, lane, i)
                slopes(s, lane, i, k)
                for r in range(JOINT):
                    moved = s.b[lane, 4 * (i - 1) + r]
                    k = k + vec2(s.w[lane, 0, r] * moved, s.w[lane, 1, r] * moved)
                    m = m + s.w[lane, 2, r] * moved
                s.k[lane, i] = k
                for branch in range(s.slip.shape[1]):
                    away = vec3(k[0], k[1], m) - s.z[lane, i, branch]
                    left = kept(s, lane, i, branch, away)[1] * away[2]
                    move = k - s.k_before[lane, i]
                    bent = slid(vec2(away[0], away[1]) - move, move, s.slip[lane, branch][1] * joint_length(s, lane, i))
                    s.z[lane, i, branch] = vec3(k[0] - bent[0], k[1] - bent[1], m - left)
            for j in range(edges):
                s.theta[lane, j] = s.theta[lane, j] + wp.clamp(s.b[lane, 4 * j + 3], -MAX_TURN, MAX_TURN)
            s.history[lane] = s.history[lane] + 1
            if ground:
                for i in range(vertices):
                    if s.held[lane, i] < 0:
                        touch_ground(s, lane, i, up)
        for i in range(vertices):
            found[frame, lane, i] = s.x[lane, i]
            turned[frame, lane, i] = s.m1[lane, i]


@dataclass(frozen=True)
class RodHands:
    """Forces on B rods in addition to clamps: S springs of controllers, and the ground."""

    controllers: int
    leader: np.ndarray
    """The controller of each spring [B, S]."""
    clearance: np.ndarray
    """Height over the ground at which each vertex touches it [B, V], m."""
    elasticity: np.ndarray
    friction: np.ndarray


OF_RODS = [each.name for each in fields(Rod) if each.name in RodState.vars]
"""Parameters from `Rod`, with a leading axis [B]."""
OF_HANDS = ("spring_edge", "spring_place", "law", "hands")
"""State of springs, which may differ between solvers of the same rods."""
STATE = [name for name in RodState.vars if name not in (*OF_RODS, "drag", *OF_HANDS, *(each.name for each in fields(RodHands)))]
"""State that `RodSolver.follow` copies."""


class RodSolver:
    """Simulates frames of rods in batch lanes. Tensors are float64 and have a leading axis [B]."""

    def __init__(
        self,
        rods: Sequence[Rod],
        drags: Sequence[float],
        simulation: Simulation,
        device: str = "cpu",
        hands: RodHands | None = None,
    ) -> None:
        """Create a solver of rods with equally many vertices, each with its linear drag, 1/s."""
        self.rods, self.simulation, self.device, self.hands = rods, simulation, device, hands
        count, vertices = len(rods), len(rods[0].mass)
        self.count, self.vertices = count, vertices
        springs, controllers = (hands.leader.shape[1], hands.controllers) if hands else (0, 0)
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("spring_edge", "spring_place", "law", "leader"), (count, springs))
        shapes |= dict.fromkeys(("history", "elasticity", "friction"), (count,))
        shapes |= {"hands": (count, controllers), "z": (count, vertices, len(rods[0].slip))}
        shapes |= {"a": (count, 4 * vertices, 11), "w": (count, 3, 11), "b": (count, 4 * vertices)}
        values = {name: np.array([getattr(rod, name) for rod in rods]) for name in OF_RODS}
        # Each end has an axis.
        values |= {"axis": np.repeat(values["axis"][:, None], 2, axis=1), "drag": np.array(drags, np.float64)}
        self._state = RodState()
        for name, variable in RodState.vars.items():
            given, kind = values.get(name, getattr(hands, name, None)), variable.type.dtype
            if given is None:
                array = wp.zeros(shapes.get(name, (count, vertices)), dtype=kind, device=device)
            else:
                array = wp.array(np.ascontiguousarray(given), dtype=kind, device=device)
            setattr(self._state, name, array)
        self._ends = wp.to_torch(self._state.hands)[None]

    def bind(self, edge: torch.Tensor, place: torch.Tensor) -> None:
        """Set where the springs of controllers act: on edges [B, S], at (f, a, b) [B, S, 3] as in `Rod.place`."""
        self._put(self._state.spring_edge, edge)
        self._put(self._state.spring_place, place)

    def pull(self, law: torch.Tensor, hands: torch.Tensor) -> None:
        """Set the springs of the next frames: stiffness, N/m, rest length, m, and dashpot, N s/m [B, S, 3].

        A spring without stiffness and dashpot does not act. Controllers move linearly between rows of hands [F + 1, B, C, 3], m.
        """
        self._put(self._state.law, law)
        self._ends = hands

    def follow(self, other: "RodSolver") -> None:
        """Copy the state of another solver of the same rods."""
        for name in STATE:
            wp.copy(getattr(self._state, name), getattr(other._state, name))

    def start(self, x: torch.Tensor, v: torch.Tensor, axis: torch.Tensor | None = None) -> None:
        """Set the state of frame 0: positions [B, V, 3], m, velocities [B, V, 3], m/s, and optional axes of clamps [B, 2, 3]."""
        for name, values in (("x", x), ("v", v), ("axis", axis)):
            if values is not None:
                self._put(getattr(self._state, name), values)
        wp.launch(load(begin, self.device), dim=self.count, inputs=[self._state], device=self.device)

    def frames(
        self, held: torch.Tensor, axis: torch.Tensor | None = None, *, still: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Simulate F frames; returns positions [F, B, V, 3], m, and m1 of edges [F, B, E, 3] at the end of each frame.

        Held vertices move linearly between rows of held [F + 1, B, V, 3], axes of clamps between rows of axis [F + 1, B, 2, 3];
        without rows the axes do not move. With `still` each frame starts at rest, so that it is a step towards equilibrium.
        """
        simulation, count = self.simulation, len(held) - 1
        axes = wp.to_torch(self._state.axis).clone().expand(count + 1, -1, -1, -1) if axis is None else axis
        paths = [self._vectors(values) for values in (held, axes, self._ends.expand(count + 1, -1, -1, -1))]
        found = [wp.empty((count, self.count, self.vertices), dtype=vec3, device=self.device) for _ in range(2)]
        gravity = -simulation.up_sign * simulation.gravity
        ground, up = simulation.ground and self.hands is not None, simulation.up_sign
        inputs = [self._state, *paths, ground, still, simulation.substeps, simulation.substep, gravity, up, *found]
        wp.launch(load(advance, self.device), dim=self.count, inputs=inputs, device=self.device)
        x, m1 = (wp.to_torch(values) for values in found)
        return x, m1[:, :, :-1]

    def frame(self, held_from: torch.Tensor, held_to: torch.Tensor) -> None:
        """Simulate one frame; see `frames`."""
        self.frames(torch.stack([held_from, held_to]))

    def _vectors(self, values: torch.Tensor) -> Any:
        return wp.from_torch(values.to(device=self.device, dtype=torch.float64).contiguous(), dtype=vec3)

    def _put(self, array: Any, values: torch.Tensor) -> None:
        wp.to_torch(array).copy_(values)

    @property
    def x(self) -> torch.Tensor:
        """Positions [B, V, 3], m."""
        return wp.to_torch(self._state.x)

    @property
    def v(self) -> torch.Tensor:
        """Velocities [B, V, 3], m/s."""
        return wp.to_torch(self._state.v)

    def directors(self) -> torch.Tensor:
        """m1 of each edge [B, E, 3]."""
        return wp.to_torch(self._state.m1)[:, :-1]

    @property
    def curvatures(self) -> torch.Tensor:
        """k1 and k2 of each joint [B, V, 2]."""
        return wp.to_torch(self._state.k)
