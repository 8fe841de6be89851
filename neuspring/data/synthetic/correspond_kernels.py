"""Warp kernels that find a point of a mesh: along a ray, or nearest to a place."""

from __future__ import annotations

import warp as wp


@wp.kernel(enable_backward=False)
def first_hit(
    mesh: wp.uint64,
    origin: wp.vec3,
    rays: wp.array[wp.vec3],
    farthest: float,
    face: wp.array[int],
    weights: wp.array[wp.vec3],
):
    """The triangle that a ray meets first, -1 for none, and the weights of its corners."""
    i = wp.tid()
    hit = wp.mesh_query_ray(mesh, origin, rays[i], farthest)
    face[i] = -1
    if hit.result:
        face[i] = hit.face
        weights[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)


@wp.kernel(enable_backward=False)
def nearest(
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    farthest: float,
    face: wp.array[int],
    weights: wp.array[wp.vec3],
):
    """The triangle that holds the point of the mesh nearest to each place, and the weights of its corners."""
    i = wp.tid()
    hit = wp.mesh_query_point_no_sign(mesh, points[i], farthest)
    face[i] = -1
    if hit.result:
        face[i] = hit.face
        weights[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
