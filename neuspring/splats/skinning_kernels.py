"""Warp kernels of skinning: nearest points by a hash grid, the rotation of each node, and the motion of each splat."""

from __future__ import annotations

import warp as wp

DEGENERATE = 1e-5
"""A neighborhood whose second singular value is below this part of the first is a line: thinner than 0.3 % of its length."""
TINY = 1e-30
"""m^2: a neighborhood smaller than this is a point."""
CLOSE = 1e-6
"""m, added to distances in weights."""
DOUBLINGS = 60


@wp.kernel(enable_backward=False)
def nearest(
    grid: wp.uint64,
    points: wp.array[wp.vec3],
    queries: wp.array[wp.vec3],
    own: wp.bool,
    wanted: int,
    radius: float,
    neighbors: wp.array2d[int],
    distances: wp.array2d[float],
):
    """The `wanted` nearest points of each query, nearest first; with `own`, query i is point i and does not count itself.

    The search radius doubles until it holds enough points.
    """
    t = wp.tid()
    place = queries[t]
    reach = radius
    for _attempt in range(DOUBLINGS):
        count = wp.int32(0)
        seen = wp.hash_grid_query(grid, place, reach)
        for j in seen:
            if not (own and j == t):
                d = wp.length(points[j] - place)
                if d <= reach and (count < wanted or d < distances[t, wanted - 1]):
                    slot = wp.min(count, wanted - 1)
                    while slot > 0 and distances[t, slot - 1] > d:
                        distances[t, slot] = distances[t, slot - 1]
                        neighbors[t, slot] = neighbors[t, slot - 1]
                        slot -= 1
                    distances[t, slot] = d
                    neighbors[t, slot] = j
                    count = wp.min(count + 1, wanted)
        if count >= wanted:
            break
        reach = reach * 2.0


@wp.func
def shortest_turn(start: wp.vec3d, end: wp.vec3d):
    """The rotation by the least angle that takes unit vector `start` to `end`."""
    axis = wp.cross(start, end)
    cosine = wp.dot(start, end)
    identity = wp.identity(n=3, dtype=wp.float64)
    turn = identity
    if cosine > wp.float64(-0.999999999):
        cross = wp.skew(axis)
        turn = identity + cross + cross * cross * (wp.float64(1.0) / (wp.float64(1.0) + cosine))
    else:
        # Half a turn: about any axis that is perpendicular.
        other = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
        if wp.abs(start[0]) > wp.float64(0.9):
            other = wp.vec3d(wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
        around = wp.normalize(wp.cross(start, other))
        turn = wp.outer(around, around) * wp.float64(2.0) - identity
    return turn


@wp.kernel(enable_backward=False)
def turn_nodes(
    before: wp.array[wp.vec3],
    after: wp.array[wp.vec3],
    neighbors: wp.array2d[int],
    rotations: wp.array[wp.mat33],
    ranks: wp.array[int],
):
    """The rotation that best takes each node's offsets to its neighbors from `before` to `after`."""
    i = wp.tid()
    moment = wp.mat33d()
    for k in range(neighbors.shape[1]):
        j = neighbors[i, k]
        moment += wp.outer(wp.vec3d(after[j] - after[i]), wp.vec3d(before[j] - before[i]))
    u, s, v = wp.svd3(moment)
    turn = wp.identity(n=3, dtype=wp.float64)
    rank = wp.int32(0)
    if s[0] > wp.float64(TINY):
        if s[1] > wp.float64(DEGENERATE) * s[0]:
            rank = 2
            turn = u * wp.transpose(v)
        else:
            rank = 1
            turn = shortest_turn(wp.normalize(wp.transpose(v)[0]), wp.normalize(wp.transpose(u)[0]))
    rotations[i] = wp.mat33(turn)
    ranks[i] = rank


@wp.kernel(enable_backward=False)
def move_splats(
    before: wp.array[wp.vec3],
    after: wp.array[wp.vec3],
    rotations: wp.array[wp.mat33],
    bound: wp.array2d[int],
    means: wp.array[wp.vec3],
    quaternions: wp.array[wp.vec4],
    moved: wp.array[wp.vec3],
    turned: wp.array[wp.vec4],
):
    """Linear blend skinning of one splat by the nodes `bound` to it."""
    t = wp.tid()
    place = means[t]
    total = wp.float32(0.0)
    # Displacements, not places, are averaged: they keep their digits far from the origin.
    shift = wp.vec3(0.0)
    blend = wp.quat(0.0, 0.0, 0.0, 0.0)
    for k in range(bound.shape[1]):
        i = bound[t, k]
        arm = place - before[i]
        weight = 1.0 / (wp.length(arm) + CLOSE)
        total += weight
        shift += weight * (after[i] - before[i] + (rotations[i] * arm - arm))
        q = wp.quat_from_matrix(rotations[i])
        if q[3] < 0.0:
            q = -q
        blend += q * weight
    moved[t] = place + shift / total
    q = wp.normalize(blend)
    own = quaternions[t]
    r = q * wp.quat(own[1], own[2], own[3], own[0])
    turned[t] = wp.vec4(r[3], r[0], r[1], r[2])
