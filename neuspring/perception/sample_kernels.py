"""Warp kernel of the sampling step: points inside a closed mesh, by its winding number."""

from __future__ import annotations

import warp as wp


@wp.kernel(enable_backward=False)
def winding(mesh: wp.uint64, points: wp.array[wp.vec3], reach: float, inside: wp.array[bool]):
    """Whether each point lies inside the closed mesh; `reach` bounds the search, m."""
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], reach)
    inside[i] = query.result and query.sign < 0.0
