"""Kernels of the search's losses, on lanes (trials.py)."""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any, NamedTuple

import warp as wp

from neuspring.physics.lanes import lanes
from neuspring.twin.rollout import FAR


class Kernels(NamedTuple):
    """Kernels of this file for one width."""

    nearest: Any
    """Squared distance of each visible point to the nearest surface node."""
    tracked: Any
    """Smooth-L1 between each tracked point and its node, summed over axes."""
    smooth: Any
    """Smooth-L1 between consecutive velocity changes of each node, summed over axes."""
    total: Any
    """Add a weighted sum to each twin's cost."""
    look: Any
    """Note the first frame in which a twin is out of the scene."""


@functools.cache
def kernels(width: int) -> Kernels:
    """Kernels in float32 for a number of lanes."""
    lane = lanes(wp.float32, width)
    Number, Vector, dot = lane.Number, lane.Vector, lane.dot
    Total = wp.types.vector(width, wp.float64)
    of_twin: Any = wp.array(dtype=Number)
    totals: Any = wp.array(dtype=Total)
    numbers: Any = wp.array2d(dtype=Number)
    vectors: Any = wp.array2d(dtype=Vector)
    slots: Any = wp.array3d(dtype=Vector)
    targets: Any = wp.array2d(dtype=wp.vec3)
    flags: Any = wp.array2d(dtype=wp.int32)
    far, huge = wp.constant(wp.float32(FAR)), wp.constant(Number(*[3e38] * width))
    half, one = wp.constant(0.5), wp.constant(1.0)

    @wp.func
    def everywhere(p: wp.vec3) -> Vector:
        x = Number()
        y = Number()
        z = Number()
        for q in range(width):
            x[q] = p[0]
            y[q] = p[1]
            z[q] = p[2]
        return wp.matrix_from_rows(x, y, z)

    @wp.func
    def smooth_l1(a: Number) -> Number:
        """0.5 a^2 below 1, |a| - 0.5 beyond."""
        result = Number()
        for q in range(width):
            size = wp.abs(a[q])
            result[q] = wp.where(size < one, half * a[q] * a[q], size - half)
        return result

    def nearest(x: slots, slot: int, surface: int, points: targets, visible: flags, frame: int, result: numbers):
        p, g = wp.tid()
        least = Number()
        if visible[frame, p] != 0:
            place = everywhere(points[frame, p])
            least = huge
            for j in range(surface):
                offset = x[slot, j, g] - place
                distance = dot(offset, offset)
                for q in range(width):
                    least[q] = wp.min(least[q], distance[q])
        result[p, g] = least

    def tracked(x: slots, slot: int, points: targets, valid: flags, frame: int, result: numbers):
        p, g = wp.tid()
        total = Number()
        if valid[frame - 1, p] != 0:
            offset = x[slot, p, g] - everywhere(points[frame, p])
            total = smooth_l1(offset[0]) + smooth_l1(offset[1]) + smooth_l1(offset[2])
        result[p, g] = total

    def smooth(v: slots, slot: int, frame: int, before: vectors, change: vectors, result: numbers):
        i, g = wp.tid()
        now = v[slot, i, g] - before[i, g]
        total = Number()
        if frame > 1:
            jerk = now - change[i, g]
            total = smooth_l1(jerk[0]) + smooth_l1(jerk[1]) + smooth_l1(jerk[2])
        before[i, g] = v[slot, i, g]
        change[i, g] = now
        result[i, g] = total

    def total(values: numbers, size: int, weight: wp.float64, result: totals):
        g = wp.tid()
        sum = Total()
        for k in range(size):
            for q in range(width):
                sum[q] = sum[q] + wp.float64(values[k, g][q])
        result[g] = result[g] + sum * weight

    def look(x: slots, slot: int, nodes: int, frame: float, gone: of_twin):
        g = wp.tid()
        largest = Number()
        for i in range(nodes):
            for q in range(width):
                for row in range(3):
                    # Not a number is not near either.
                    if not (wp.abs(x[slot, i, g][row, q]) < far):
                        largest[q] = one
        for q in range(width):
            if largest[q] > 0.0 and gone[g][q] == 0.0:
                seen = gone[g]
                seen[q] = frame
                gone[g] = seen

    unique = wp.kernel(module="unique", enable_backward=False)
    return Kernels(*map(unique, (nearest, tracked, smooth, total, look)))
