"""Choices among points."""

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
