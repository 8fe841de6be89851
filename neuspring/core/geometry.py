"""Choices among points, rigid motions, and how lines run."""

from __future__ import annotations

import numpy as np


def farthest(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of at most `count` points [n, 3], each the farthest from those before; the first is point 0."""
    if not len(points):
        return np.zeros(0, dtype=int)
    chosen, distance = [0], np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def on_table(points: np.ndarray, up: float) -> np.ndarray:
    """Points [..., 3] with those below the table z = 0 moved up to it; `up` is +1 or -1."""
    lifted = np.array(points, dtype=float)
    lifted[..., 2] = up * np.maximum(up * lifted[..., 2], 0.0)
    return lifted


def rigid_inverse(pose: np.ndarray) -> np.ndarray:
    """The inverse of a rigid motion [4, 4]."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse
