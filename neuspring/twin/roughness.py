"""Roughness of a twin's stiffness: does it differ between springs side by side, or between parts of the body?

With z_e = ln Y_e and E_k(e) the k springs whose canonical midpoints are nearest to that of spring e,

    roughness = mean over e and n in E_k(e) of (z_e - z_n)^2 / 2,   over the variance of z

which is 1 where neighbors have nothing in common, and near 0 where stiffness is smooth.
"""

from __future__ import annotations

import numpy as np

SIDE_BY_SIDE = 8
"""Springs that a spring is compared with."""


def roughness(midpoints: np.ndarray, values: np.ndarray) -> float:
    """Roughness of values [S] at points [S, 3]. NaN where there are too few springs, or no variance."""
    variance = float(np.var(values)) if len(values) > 1 else 0.0
    if variance <= 0:
        return float("nan")
    others = neighbors(midpoints, SIDE_BY_SIDE)
    return float(np.square(values[:, None] - values[others]).mean() / (2 * variance))


def neighbors(points: np.ndarray, most: int) -> np.ndarray:
    """For each of the points [S, 3] its nearest others [S, K], K = min(most, S - 1)."""
    from scipy.spatial import cKDTree

    points = points.astype(np.float64)
    count = min(most, len(points) - 1)
    near = cKDTree(points).query(points, k=[*range(1, count + 2)])[1]
    # Points may coincide: one is not always the first of its own list.
    own = near == np.arange(len(points))[:, None]
    own[:, -1] |= ~own.any(axis=1)
    return np.asarray(near[~own].reshape(len(points), count))
