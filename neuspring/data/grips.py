"""Grippers at the ends of a cable: rings of controller points that keep an end's direction and roll.

Motion capture has two held markers at either end. Points on one line leave the roll about it free. A gripper does not, so each held
marker m gets a ring of points

    m(t) + r (cos a_k n(t) + sin a_k d(t) x n(t)),    a_k = 2 pi (k + 1/2) / count.

d(t) is the unit direction of the end's two markers. n(t) is normal to it and parallel-transported: from frame to frame the
smallest rotation that turns d carries n along, so the ring follows every turn of the end and never spins about it. A spin that the
gripper did make is not in the data. Half a step of the angle keeps the points away from the body's own ring around the first and
the last marker.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from neuspring.core.errors import InputError


def clamps(held: np.ndarray, normals: np.ndarray, radius: float, count: int, nearest: float, where: str) -> np.ndarray:
    """Points [T, 4 * count, 3], m, of rings around held markers [T, 4, 3] (two at either end, in the order along the cable).

    `normals` [2, 3] give the roll of either end in frame 0: those of the body's first and last ring. Raises InputError, naming
    `where`, if the two markers of an end come nearer than `nearest`, m: they have no direction then.
    """
    parts = []
    for normal, end in zip(normals, (held[:, :2], held[:, 2:]), strict=True):
        along = end[:, 1] - end[:, 0]
        length = np.linalg.norm(along, axis=1, keepdims=True)
        if length.min() < nearest:
            rule = f"the two held markers of an end must stay {nearest} m apart (mocap.grip: clamp)"
            raise InputError(where, rule, f"{length.min():.2g} m in sample {int(length.argmin())}", "Use grip: markers.")
        directions = along / length
        transported = transport(directions, normal)
        across = np.cross(directions, transported)
        parts += [end[:, [k]] + circle(transported, across, radius, count) for k in (0, 1)]
    return np.concatenate(parts, axis=1)


def circle(normal: np.ndarray, across: np.ndarray, radius: float, count: int) -> np.ndarray:
    """Offsets [..., count, 3], m, of a clamp's points from its marker, with unit vectors [..., 3] normal to the cable."""
    angle = (2 * np.pi * (np.arange(count) + 0.5) / count)[:, None]
    offsets: np.ndarray = radius * (np.cos(angle) * normal[..., None, :] + np.sin(angle) * across[..., None, :])
    return offsets


def transport(directions: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Unit normals [T, 3] to unit directions [T, 3], by the smallest rotation from each direction to the next.

    The first is `normal` [3], projected. A vector n normal to d goes to n - (d' n) / (1 + d d') (d + d').
    """
    first = normal - (normal @ directions[0]) * directions[0]
    normals = np.empty_like(directions)
    normals[0] = first / np.linalg.norm(first)
    for t, (before, after) in enumerate(pairwise(directions)):
        turned = normals[t] - (after @ normals[t]) / (1.0 + before @ after) * (before + after)
        # Rounding would add up over thousands of samples.
        turned -= (turned @ after) * after
        normals[t + 1] = turned / np.linalg.norm(turned)
    return normals
