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


PARALLEL = 0.99
"""Cosine to a direction from which a projection normal to it is not worth the name."""
SAME_WORLD = float(np.radians(90))
"""Largest angle between the headings of a cable in recordings of one world. DEFORM's have 60 degrees at most, 8 to 18 as a rule."""
SIDESTEPS = np.radians([0, 30, -30, 60, -60])
"""Turns about the vertical, of which two directions at most rule out four."""


def heading(line: np.ndarray) -> np.ndarray:
    """The horizontal unit direction [3] in which a line [V, 3] extends most, from its first end to its last."""
    plan = line[:, :2] - line[:, :2].mean(axis=0)
    along = np.linalg.svd(plan, full_matrices=False)[2][0]
    ahead = np.linspace(-1, 1, len(line)) @ plan @ along
    return np.append(along if ahead >= 0 else -along, 0.0)


def turned(axis: np.ndarray, angle: float) -> np.ndarray:
    """A direction [3] turned about the vertical, rad."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([cosine * axis[0] - sine * axis[1], sine * axis[0] + cosine * axis[1], axis[2]])


def angle_between(here: np.ndarray, there: np.ndarray) -> float:
    """Turn about the vertical from one horizontal direction [3] to another, rad."""
    return float(np.arctan2(here[0] * there[1] - here[1] * there[0], here @ there))


def axis_on(axis: np.ndarray, ahead: np.ndarray, line: np.ndarray, steady: float = SAME_WORLD) -> np.ndarray:
    """A horizontal `axis` [3] that goes with lines of heading `ahead` [3], on another line [V, 3]. There its ends' roll starts.

    Grippers keep to the world, whatever way the cable heads between them. One that heads elsewhere by more than `steady`, rad, was
    recorded in another world, onto which the headings turn the axis. An axis along the first or the last edge steps aside.
    """
    turn = angle_between(ahead, heading(line))
    start = turned(axis, turn) if abs(turn) > steady else axis
    ends = np.diff(line, axis=0)[[0, -1]]
    ends /= np.linalg.norm(ends, axis=1, keepdims=True)
    others = (turned(start, angle) if angle else start for angle in SIDESTEPS)
    return next((one for one in others if np.abs(ends @ one).max() <= PARALLEL * np.linalg.norm(one)), start)
