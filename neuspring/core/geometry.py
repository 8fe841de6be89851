"""Point selection and rigid motions."""

from __future__ import annotations

import numpy as np


def farthest(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of at most `count` of the points [n, 3] by farthest-point sampling, starting with point 0."""
    if not len(points):
        return np.zeros(0, dtype=int)
    chosen, distance = [0], np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def on_table(points: np.ndarray, up: float) -> np.ndarray:
    """Points [..., 3] in which points below the table z = 0 are moved up to it; `up` is +1 or -1."""
    lifted = np.array(points, dtype=float)
    lifted[..., 2] = up * np.maximum(up * lifted[..., 2], 0.0)
    return lifted


SPREAD = 0.05
"""Distance between hands, m, above which a hanging object rotates only about the line through them."""


def lean(points: np.ndarray, hands: np.ndarray, up: float) -> np.ndarray:
    """Rotation vector [3], rad, that moves the center of points [n, 3] below the controllers [C, 3] from which they hang.

    The axis is horizontal; if the controllers extend over more than SPREAD, it is parallel to their main direction.
    """
    below = points.mean(axis=0) - hands.mean(axis=0)
    sideways = hands[:, :2] - hands[:, :2].mean(axis=0)
    axis = np.array([-below[1], below[0]])
    if np.ptp(sideways @ (along := np.linalg.svd(sideways)[2][0])) > SPREAD:
        axis = along
    axis = np.append(axis / max(np.linalg.norm(axis), np.finfo(float).tiny), 0.0)
    down = np.array([0.0, 0.0, -up])
    across = np.cross(down, axis)
    return np.asarray(axis * np.arctan2(below @ across, below @ down))


def rigid_inverse(pose: np.ndarray) -> np.ndarray:
    """The inverse of a rigid motion [4, 4]."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse
