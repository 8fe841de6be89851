"""Warp kernels of the ray caster, which trace one pixel to the mesh, the table and the light."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp


def on_cpu(values: np.ndarray, kind: Any) -> Any:
    """A Warp array in CPU memory."""
    return wp.array(values, dtype=kind, device="cpu")


@wp.func
def grain(place: wp.vec3, frequency: float, contrast: float, state: wp.uint32):
    """Three octaves of noise; finer octaves would be smaller than a pixel and flicker."""
    coarse = 0.5 * wp.noise(state, place * frequency) + 0.35 * wp.noise(state, place * (2.1 * frequency))
    return 1.0 + contrast * (coarse + 0.3 * wp.noise(state, place * (4.3 * frequency)))


@wp.func
def table(place: wp.vec3, state: wp.uint32):
    """Color of the wooden table, with streaks along x."""
    streak = wp.noise(state, wp.vec3(place[0] * 6.0, place[1] * 45.0, 0.3))
    pore = wp.noise(state, wp.vec3(place[0] * 90.0, place[1] * 90.0, 0.7))
    return wp.vec3(0.62, 0.50, 0.38) * (1.0 + 0.22 * streak + 0.1 * pore)


@wp.func
def ray_of(x: int, y: int, offset: wp.vec2, focal: wp.vec2, center: wp.vec2):
    """Unit direction of a sample in camera axes, z forward."""
    u = (float(x) + offset[0] - center[0]) / focal[0]
    v = (float(y) + offset[1] - center[1]) / focal[1]
    return wp.normalize(wp.vec3(u, v, 1.0))


@wp.func
def to_table(origin: wp.vec3, ray: wp.vec3):
    """Distance along a ray to the table, z = 0; 1e9 if the ray does not descend."""
    distance = 1.0e9
    if ray[2] < -1.0e-6:
        distance = -origin[2] / ray[2]
    return distance


@wp.kernel(enable_backward=False)
def shade_table(
    pose: wp.transform, focal: wp.vec2, center: wp.vec2, offsets: wp.array[wp.vec2], farthest: float, shades: wp.array3d[wp.vec3]
):
    """Unlit color of the empty table in every sample; computed once, because camera and table do not move."""
    y, x, s = wp.tid()
    ray = wp.transform_vector(pose, ray_of(x, y, offsets[s], focal, center))
    origin = wp.transform_get_translation(pose)
    distance = to_table(origin, ray)
    if distance < farthest:
        shades[y, x, s] = table(origin + ray * distance, wp.uint32(7))


@wp.kernel(enable_backward=False)
def cast(
    mesh: wp.uint64,
    normals: wp.array[wp.vec3],
    rest: wp.array[wp.vec3],
    colors: wp.array[wp.vec3],
    indices: wp.array[int],
    labels: wp.array[int],
    grains: wp.array[wp.vec2],
    pose: wp.transform,
    focal: wp.vec2,
    center: wp.vec2,
    offsets: wp.array[wp.vec2],
    shades: wp.array3d[wp.vec3],
    light: wp.vec3,
    gamma: float,
    farthest: float,
    color: wp.array3d[wp.uint8],
    depth: wp.array2d[float],
    label: wp.array2d[wp.uint8],
    slope: wp.array2d[float],
):
    """One pixel: color is the mean over `offsets`; depth, label and slope are from the first. `shades` is from `shade_table`."""
    y, x = wp.tid()
    origin = wp.transform_get_translation(pose)
    state = wp.uint32(7)
    total = wp.vec3(0.0)
    for s in range(offsets.shape[0]):
        ray = ray_of(x, y, offsets[s], focal, center)
        axial = ray[2]
        ray = wp.transform_vector(pose, ray)
        table_at = to_table(origin, ray)
        hit = wp.mesh_query_ray(mesh, origin, ray, farthest)
        shade = wp.vec3(0.55, 0.58, 0.62)
        normal = wp.vec3(0.0, 0.0, 1.0)
        distance = 0.0
        seen = 0
        if hit.result and hit.t < table_at:
            a = indices[3 * hit.face]
            b = indices[3 * hit.face + 1]
            c = indices[3 * hit.face + 2]
            w = 1.0 - hit.u - hit.v
            normal = wp.normalize(normals[a] * hit.u + normals[b] * hit.v + normals[c] * w)
            if wp.dot(normal, ray) > 0.0:
                normal = -normal
            place = rest[a] * hit.u + rest[b] * hit.v + rest[c] * w
            base = colors[a] * hit.u + colors[b] * hit.v + colors[c] * w
            seen = labels[hit.face]
            texture = grains[seen]
            shade = base * grain(place, texture[0], texture[1], state)
            distance = hit.t
        elif table_at < farthest:
            shade = shades[y, x, s]
            distance = table_at
        if distance > 0.0:
            incoming = wp.max(wp.dot(normal, light), 0.0)
            if incoming > 0.0:
                blocked = wp.mesh_query_ray(mesh, origin + ray * distance + normal * 1.0e-3, light, 5.0)
                if blocked.result:
                    incoming = 0.0
            shade = shade * (0.35 + 0.15 * normal[2] + 0.75 * incoming)
        total += shade / float(offsets.shape[0])
        if s == 0:
            depth[y, x] = distance * axial
            label[y, x] = wp.uint8(seen)
            slope[y, x] = wp.abs(wp.dot(normal, ray))
    for k in range(3):
        color[y, x, k] = wp.uint8(wp.clamp(wp.pow(wp.max(total[k], 0.0), gamma) * 255.0 + 0.5, 0.0, 255.0))
