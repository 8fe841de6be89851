"""The largest eigenvalue of the stiffness or damping matrix of a spring network, by Lanczos' method.

A kernel computes products with the matrix in a pass over the springs, without assembling the matrix.
"""
# No postponed annotations here: Warp reads the evaluated types of the kernel.

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from neuspring.core.device import load, start_warp
from neuspring.physics.arrays import UNFUSED

STEPS, MOST = 10, 200
"""Number of vectors by which the subspace grows between two convergence checks, and its largest size."""


def largest(
    springs: np.ndarray, direction: np.ndarray, scale: np.ndarray, each: Sequence[np.ndarray], tolerance: float
) -> list[tuple[float, int]]:
    """The largest eigenvalue of A = D B^T diag(w) B D for `each` w [S], and the point that moves most in its mode.

    - springs: [S, 2], indices of P points
    - direction: unit vectors of the springs [S, 3]. Row e of B maps velocities of points to the rate of change of spring e's
      length
    - scale: [P], D = diag(scale); 0 for fixed points
    - tolerance: largest residual, relative to the eigenvalue. A residual that stays larger is added to the eigenvalue
    """
    from scipy.linalg import eigh_tridiagonal

    start_warp()
    kernel, moves = load(subspace, "cpu"), scale > 0
    basis, rest = np.zeros((MOST + 1, len(scale), 3)), np.zeros((len(scale), 3))
    diagonal, beside = np.zeros((2, MOST))
    numbers = np.ascontiguousarray(springs, np.int32), direction, scale, basis, rest, diagonal, beside
    kinds = wp.int32, wp.vec3d, wp.float64, wp.vec3d, wp.vec3d, wp.float64, wp.float64
    views: list[Any] = [wp.array(one, dtype=kind, copy=False, device="cpu") for one, kind in zip(numbers, kinds, strict=True)]

    def found(weights: np.ndarray) -> tuple[float, int]:
        of_springs: Any = wp.array(weights, dtype=wp.float64, copy=False, device="cpu")
        basis[0, moves] = np.random.default_rng(0).standard_normal((moves.sum(), 3))
        basis[0] /= max(np.linalg.norm(basis[0]), np.finfo(float).tiny)
        for size in range(STEPS, MOST + 1, STEPS):
            wp.launch(kernel, 1, [size - STEPS, size, of_springs, *views], device="cpu")
            values, vectors = eigh_tridiagonal(diagonal[:size], beside[: size - 1])
            residual = beside[size - 1] * abs(vectors[-1, -1])
            if residual <= tolerance * values[-1]:
                residual = 0.0
                break
        mode = np.tensordot(vectors[:, -1], basis[:size], axes=1)
        return float(values[-1] + residual), int(np.argmax(np.linalg.norm(mode, axis=1)))

    return [found(weights) for weights in each]


@wp.kernel(**UNFUSED)
def subspace(
    known: int,
    size: int,
    weights: wp.array[wp.float64],
    springs: wp.array2d[wp.int32],
    direction: wp.array[wp.vec3d],
    scale: wp.array[wp.float64],
    basis: wp.array2d[wp.vec3d],
    rest: wp.array[wp.vec3d],
    diagonal: wp.array[wp.float64],
    beside: wp.array[wp.float64],
):
    """Compute vectors known + 1 .. size of the basis, and the tridiagonal projection of the matrix."""
    for step in range(known, size):
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
            if step > 0:
                left = left - beside[step - 1] * basis[step - 1, i]
            rest[i] = left
            square += wp.dot(left, left)
        diagonal[step] = along
        beside[step] = wp.sqrt(square)
        for i in range(rest.shape[0]):
            basis[step + 1, i] = wp.where(square > wp.float64(0.0), rest[i] / beside[step], wp.vec3d())
