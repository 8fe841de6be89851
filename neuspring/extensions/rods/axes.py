"""Directions of the world from which the roll of a line's ends is counted, in recordings of one object."""

from __future__ import annotations

import numpy as np

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
