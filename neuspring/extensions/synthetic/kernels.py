"""Warp kernels of synthetic scenes.

- Additions to the finite-element engine: driven nodes and fists, a Maxwell branch, Coulomb friction, damping of deformation. They
  add no stiffness; elasticity, bending, normal contact and integration are those of the engine.
- Queries of a mesh: the first hit of a ray, and the nearest point.
"""

from __future__ import annotations

import warp as wp


@wp.kernel(enable_backward=False)
def drive_nodes(
    step: wp.array[int],
    poses: wp.array2d[wp.transform],
    holder: wp.array[int],
    local: wp.array[wp.vec3],
    dt: float,
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
):
    """Set held nodes (inverse mass 0) to the pose of their hand, with its finite-difference velocity; the engine moves them."""
    i = wp.tid()
    hand = holder[i]
    if hand < 0:
        return
    here = wp.transform_point(poses[hand, step[0]], local[i])
    there = wp.transform_point(poses[hand, step[0] + 1], local[i])
    position[i] = here
    velocity[i] = (there - here) / dt


@wp.kernel(enable_backward=False)
def drive_bodies(
    step: wp.array[int],
    poses: wp.array2d[wp.transform],
    hand_of_body: wp.array[int],
    dt: float,
    pose: wp.array[wp.transform],
    twist: wp.array[wp.spatial_vector],
):
    """Set kinematic fists to the pose of their hand, with the linear and angular velocity that leads to the next step's pose."""
    body = wp.tid()
    here = poses[hand_of_body[body], step[0]]
    there = poses[hand_of_body[body], step[0] + 1]
    pose[body] = here
    turn = wp.transform_get_rotation(there) * wp.quat_inverse(wp.transform_get_rotation(here))
    side = wp.where(turn[3] < 0.0, -1.0, 1.0)
    spin = wp.vec3(turn[0], turn[1], turn[2]) * (2.0 * side / dt)
    twist[body] = wp.spatial_vector((wp.transform_get_translation(there) - wp.transform_get_translation(here)) / dt, spin)


@wp.kernel(enable_backward=False)
def advance(step: wp.array[int]):
    """Count one time step."""
    step[0] = step[0] + 1


@wp.kernel(enable_backward=False)
def maxwell(
    tetrahedra: wp.array2d[int],
    inverse_rest: wp.array[wp.mat33],
    volume: wp.array[float],
    mu: wp.array[float],
    lame: wp.array[float],
    decay: float,
    position: wp.array[wp.vec3],
    strain: wp.array[wp.mat33],
    stress: wp.array[wp.mat33],
    force: wp.array[wp.vec3],
):
    """Add forces of dS/dt = 2 mu dE/dt + lambda tr(dE/dt) I - S / tau, P = F S, with Green strain E.

    This damping does not affect rigid motion.
    """
    t = wp.tid()
    a = tetrahedra[t, 0]
    b = tetrahedra[t, 1]
    c = tetrahedra[t, 2]
    d = tetrahedra[t, 3]
    origin = position[a]
    gradient = wp.matrix_from_cols(position[b] - origin, position[c] - origin, position[d] - origin) * inverse_rest[t]
    green = (wp.transpose(gradient) * gradient - wp.identity(n=3, dtype=float)) * 0.5
    change = green - strain[t]
    now = stress[t] * decay + change * (2.0 * mu[t]) + wp.identity(n=3, dtype=float) * (lame[t] * wp.trace(change))
    strain[t] = green
    stress[t] = now
    h = (gradient * now) * wp.transpose(inverse_rest[t]) * volume[t]
    on = wp.transpose(h)
    wp.atomic_sub(force, b, on[0])
    wp.atomic_sub(force, c, on[1])
    wp.atomic_sub(force, d, on[2])
    wp.atomic_add(force, a, on[0] + on[1] + on[2])


@wp.kernel(enable_backward=False)
def coulomb(
    count: wp.array[int],
    node: wp.array[int],
    shape: wp.array[int],
    on_body: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    shape_body: wp.array[int],
    friction: float,
    stiffness: float,
    body_pose: wp.array[wp.transform],
    body_twist: wp.array[wp.spatial_vector],
    radius: wp.array[float],
    inverse_mass: wp.array[float],
    before: wp.array[wp.vec3],
    dt: float,
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
):
    """Reduce the tangential velocity by at most mu f_n dt / m, f_n = k depth, which sticks without creep at any time step.

    The engine's own friction is viscous and unstable for stiff settings, and is switched off.
    """
    t = wp.tid()
    if t >= count[0]:
        return
    i = node[t]
    if inverse_mass[i] == 0.0:
        return
    body = shape_body[shape[t]]
    point = on_body[t]
    surface_velocity = wp.vec3()
    if body >= 0:
        point = wp.transform_point(body_pose[body], on_body[t])
        lever = point - wp.transform_get_translation(body_pose[body])
        surface_velocity = wp.spatial_top(body_twist[body]) + wp.cross(wp.spatial_bottom(body_twist[body]), lever)
    depth = radius[i] - wp.dot(normal[t], before[i] - point)
    if depth <= 0.0:
        return
    relative = velocity[i] - surface_velocity
    tangential = relative - normal[t] * wp.dot(normal[t], relative)
    speed = wp.length(tangential)
    if speed < 1.0e-9:
        return
    change = -tangential * (wp.min(speed, friction * stiffness * depth * inverse_mass[i] * dt) / speed)
    velocity[i] = velocity[i] + change
    position[i] = position[i] + change * dt


@wp.kernel(enable_backward=False)
def moments(position: wp.array[wp.vec3], velocity: wp.array[wp.vec3], mass: wp.array[float], sums: wp.array[float]):
    """Sum mass, first moments, momentum, angular momentum about the origin, and second moments (upper half of 3 x 3)."""
    i = wp.tid()
    m = mass[i]
    x = position[i]
    v = velocity[i]
    spin = wp.cross(x, v)
    wp.atomic_add(sums, 0, m)
    for k in range(3):
        wp.atomic_add(sums, 1 + k, m * x[k])
        wp.atomic_add(sums, 4 + k, m * v[k])
        wp.atomic_add(sums, 7 + k, m * spin[k])
        for other in range(k, 3):
            wp.atomic_add(sums, 10 + 3 * k + other, m * x[k] * x[other])


@wp.kernel(enable_backward=False)
def damp_deformation(
    position: wp.array[wp.vec3],
    inverse_mass: wp.array[float],
    sums: wp.array[float],
    rate: float,
    drag: float,
    dt: float,
    velocity: wp.array[wp.vec3],
):
    """v -= rate dt (v - v_rigid) + drag dt v, with the least-squares rigid motion v_rigid."""
    i = wp.tid()
    if inverse_mass[i] == 0.0:
        return
    m = sums[0]
    center = wp.vec3(sums[1], sums[2], sums[3]) / m
    mean = wp.vec3(sums[4], sums[5], sums[6]) / m
    spin = wp.vec3(sums[7], sums[8], sums[9]) - m * wp.cross(center, mean)
    xx = sums[10] - m * center[0] * center[0]
    xy = sums[11] - m * center[0] * center[1]
    xz = sums[12] - m * center[0] * center[2]
    yy = sums[14] - m * center[1] * center[1]
    yz = sums[15] - m * center[1] * center[2]
    zz = sums[18] - m * center[2] * center[2]
    # A straight rope has no moment of inertia about its axis.
    least = 1.0e-3 * (xx + yy + zz)
    inertia = wp.mat33(yy + zz + least, -xy, -xz, -xy, xx + zz + least, -yz, -xz, -yz, xx + yy + least)
    rigid = mean + wp.cross(wp.inverse(inertia) * spin, position[i] - center)
    velocity[i] = velocity[i] - (velocity[i] - rigid) * (rate * dt) - velocity[i] * (drag * dt)


@wp.kernel(enable_backward=False)
def first_hit(
    mesh: wp.uint64, origin: wp.vec3, rays: wp.array[wp.vec3], farthest: float, face: wp.array[int], weights: wp.array[wp.vec3]
):
    """The first triangle on a ray, -1 for none, and the weights of its corners."""
    i = wp.tid()
    hit = wp.mesh_query_ray(mesh, origin, rays[i], farthest)
    face[i] = -1
    if hit.result:
        face[i] = hit.face
        weights[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)


@wp.kernel(enable_backward=False)
def nearest(mesh: wp.uint64, points: wp.array[wp.vec3], farthest: float, face: wp.array[int], weights: wp.array[wp.vec3]):
    """The triangle nearest to each point, -1 for none, and the weights of its corners."""
    i = wp.tid()
    hit = wp.mesh_query_point_no_sign(mesh, points[i], farthest)
    face[i] = -1
    if hit.result:
        face[i] = hit.face
        weights[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
