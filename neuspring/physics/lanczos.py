"""The largest eigenvalue of the stiffness or damping matrix of a net of springs: Lanczos' method with thick restarts (Wu and
Simon 2000), which builds ARPACK's subspaces, so that values differ from ARPACK's by rounding alone.

A product with the matrix is a pass over the springs in a kernel; nothing is assembled.
"""
# No postponed annotations here: Warp reads the evaluated types of the kernel.

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from neuspring.core.device import load, start_warp
from neuspring.physics.arrays import UNFUSED

STEPS, KEPT = 20, 10
"""Vectors of the subspace, and those that a restart begins with."""
RESTARTS = 200
"""Most times that a subspace is built."""


def largest(
    springs: np.ndarray, direction: np.ndarray, scale: np.ndarray, each: Sequence[np.ndarray], tolerance: float
) -> list[tuple[float, int]]:
    """The largest eigenvalue of A = D B^T diag(w) B D for `each` w [S], and the point that moves most in its mode.

    springs [S, 2] of points P have unit vectors `direction` [S, 3]. Row e of B maps velocities of points to the rate of change of
    spring e's length; D = diag(`scale` [P]), 0 for points that do not move. The residual is at most `tolerance` times the value.
    Where it stays larger it is added to the value.
    """
    start_warp()
    kernel, moves = load(subspace, "cpu"), scale > 0
    basis, rest = np.zeros((STEPS + 1, len(scale), 3)), np.zeros((len(scale), 3))
    diagonal, beside, linked = np.zeros((3, STEPS))
    numbers = np.ascontiguousarray(springs, np.int32), direction, scale, basis, rest, diagonal, beside, linked
    kinds = wp.int32, wp.vec3d, wp.float64, wp.vec3d, wp.vec3d, wp.float64, wp.float64, wp.float64
    views: list[Any] = [wp.array(one, dtype=kind, copy=False, device="cpu") for one, kind in zip(numbers, kinds, strict=True)]

    def found(weights: np.ndarray) -> tuple[float, int]:
        arguments = wp.array(weights, dtype=wp.float64, copy=False, device="cpu"), *views
        # ARPACK begins with the product of A and a random vector.
        basis[STEPS - 1, moves], linked[:] = np.random.default_rng(0).standard_normal((moves.sum(), 3)), 0.0
        wp.launch(kernel, 1, [STEPS - 1, *arguments], device="cpu")
        basis[0] = diagonal[-1] * basis[STEPS - 1] + beside[-1] * basis[STEPS]
        basis[0] /= max(np.linalg.norm(basis[0]), np.finfo(float).tiny)
        known = 0
        for restart in range(RESTARTS):
            wp.launch(kernel, 1, [known, *arguments], device="cpu")
            projected = np.diag(diagonal)
            projected[range(known, STEPS - 1), range(known + 1, STEPS)] = beside[known:-1]
            projected[:known, known] = linked[:known]
            values, vectors = np.linalg.eigh(projected, UPLO="U")
            residual = beside[-1] * abs(vectors[-1, -1])
            if residual <= tolerance * values[-1]:
                residual = 0.0
                break
            if restart + 1 == RESTARTS:
                break
            known = KEPT
            basis[:known] = np.tensordot(vectors[:, -known:].T, basis[:STEPS], axes=1)
            basis[known] = basis[STEPS]
            diagonal[:known], linked[:known] = values[-known:], beside[-1] * vectors[-1, -known:]
        mode = np.tensordot(vectors[:, -1], basis[:STEPS], axes=1)
        return float(values[-1] + residual), int(np.argmax(np.linalg.norm(mode, axis=1)))

    return [found(weights) for weights in each]


@wp.kernel(**UNFUSED)
def subspace(
    known: int,
    weights: wp.array[wp.float64],
    springs: wp.array2d[wp.int32],
    direction: wp.array[wp.vec3d],
    scale: wp.array[wp.float64],
    basis: wp.array2d[wp.vec3d],
    rest: wp.array[wp.vec3d],
    diagonal: wp.array[wp.float64],
    beside: wp.array[wp.float64],
    linked: wp.array[wp.float64],
):
    """Vectors known + 1 .. STEPS of the basis, and the projected matrix: `linked` joins the first of them to the known ones."""
    for step in range(known, STEPS):
        for i in range(rest.shape[0]):
            rest[i] = wp.vec3d()
        for e in range(springs.shape[0]):
            a = springs[e, 0]
            b = springs[e, 1]
            d = direction[e]
            pull = weights[e] * wp.dot(d, scale[b] * basis[step, b] - scale[a] * basis[step, a]) * d
            rest[a] = rest[a] - scale[a] * pull
            rest[b] = rest[b] + scale[b] * pull
        along = wp.float64(0.0)
        for i in range(rest.shape[0]):
            along += wp.dot(basis[step, i], rest[i])
        square = wp.float64(0.0)
        for i in range(rest.shape[0]):
            left = rest[i] - along * basis[step, i]
            if step > known:
                left = left - beside[step - 1] * basis[step - 1, i]
            else:
                for k in range(known):
                    left = left - linked[k] * basis[k, i]
            rest[i] = left
            square += wp.dot(left, left)
        diagonal[step] = along
        beside[step] = wp.sqrt(square)
        for i in range(rest.shape[0]):
            if square > wp.float64(0.0):
                basis[step + 1, i] = rest[i] / beside[step]
            else:
                basis[step + 1, i] = wp.vec3d()
