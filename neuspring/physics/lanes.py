"""Numbers and 3-vectors of several twins at once: the types of every kernel of the simulator.

A batch lane is one of W twins that share vector instructions. A `Number` contains one scalar per lane, a `Vector` three rows of
W: x, y, z. Vector instructions compute all lanes at once, and all loads are contiguous. W = 1 is a single twin. The order of sums
is the same for any W, so a twin's numbers do not depend on its batch.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any, NamedTuple

import warp as wp

MIN_SPRING_LENGTH = 1e-6
"""Smallest length in the division for a direction, m."""
LANE_WIDTH = 8
"""Number of twins that share vector instructions; 16 are not faster per twin (results/published/bench/NOTES.md)."""
ALONE = 2
"""Number of twins up to which blocks (blocks.py) are faster than lanes: one twin takes 0.42 of the time of eight in lanes."""


def width_for(twins: int) -> int:
    """Number of lanes for `twins` twins."""
    return LANE_WIDTH if twins > ALONE else 1


class Lanes(NamedTuple):
    """Types and functions for one scalar type and width."""

    real: Any
    width: int
    Number: Any
    """[W]."""
    Vector: Any
    """[3, W]."""
    dot: Any
    """(Vector, Vector) -> Number."""
    scaled: Any
    """(Vector, Number) -> Vector."""
    root: Any
    """Number -> its square root."""
    divided: Any
    """(Vector, Number) -> the Vector divided by the Number."""
    floored: Any
    """Number -> max(number, MIN_SPRING_LENGTH)."""
    column: Any
    """(Vector, lane) -> the vec3 of one lane."""
    put: Any
    """(Vector, lane, vec3) -> the Vector with one lane replaced."""
    chosen: Any
    """(step, counts, Vector, Vector) -> the first Vector in lanes that still move (step < count), else the second."""
    chosen_number: Any
    """`chosen` for Numbers."""
    plain: Any
    """Index -> the same index, marked as not negative. Warp checks the sign of other indices, a sixth of a spring's time."""


@functools.cache
def lanes(real: Any, width: int) -> Lanes:
    """Types and functions for wp.float32 or wp.float64, and a width."""
    Number = wp.types.vector(width, real)
    Vector = wp.types.matrix((3, width), real)
    vec3 = wp.types.vector(3, real)
    floor = real(MIN_SPRING_LENGTH)

    @wp.func
    def dot(a: Vector, b: Vector) -> Number:
        return wp.cw_mul(a[0], b[0]) + wp.cw_mul(a[1], b[1]) + wp.cw_mul(a[2], b[2])

    @wp.func
    def scaled(a: Vector, factor: Number) -> Vector:
        return wp.matrix_from_rows(wp.cw_mul(a[0], factor), wp.cw_mul(a[1], factor), wp.cw_mul(a[2], factor))

    @wp.func
    def root(a: Number) -> Number:
        result = Number()
        for lane in range(width):
            result[lane] = wp.sqrt(a[lane])
        return result

    @wp.func
    def divided(a: Vector, divisor: Number) -> Vector:
        return wp.matrix_from_rows(wp.cw_div(a[0], divisor), wp.cw_div(a[1], divisor), wp.cw_div(a[2], divisor))

    @wp.func
    def floored(a: Number) -> Number:
        result = Number()
        for lane in range(width):
            result[lane] = wp.max(a[lane], floor)
        return result

    @wp.func
    def column(a: Vector, lane: int) -> vec3:
        return vec3(a[0, lane], a[1, lane], a[2, lane])

    @wp.func
    def put(a: Vector, lane: int, value: vec3) -> Vector:
        a[0, lane] = value[0]
        a[1, lane] = value[1]
        a[2, lane] = value[2]
        return a

    @wp.func
    def chosen(step: int, counts: Number, moving: Vector, resting: Vector) -> Vector:
        for lane in range(width):
            if real(step) >= counts[lane]:
                moving[0, lane] = resting[0, lane]
                moving[1, lane] = resting[1, lane]
                moving[2, lane] = resting[2, lane]
        return moving

    @wp.func
    def chosen_number(step: int, counts: Number, moving: Number, resting: Number) -> Number:
        for lane in range(width):
            if real(step) >= counts[lane]:
                moving[lane] = resting[lane]
        return moving

    @wp.func
    def plain(index: int) -> int:
        return index & 0x7FFFFFFF

    return Lanes(real, width, Number, Vector, dot, scaled, root, divided, floored, column, put, chosen, chosen_number, plain)
