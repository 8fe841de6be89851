"""Hands: rigid meshes that follow key frames, hold what they grasp, or push. A hand's origin is where its fingers meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from neuspring.data.synthetic.implicit import Sdf, capsule, ellipsoid, smooth_union, sphere, surface

SKIN = (0.75, 0.5, 0.4)
"""Linear RGB."""
FIST_RADIUS = 0.032
KeyFrame = tuple[float, Sequence[float], Sequence[float]]
"""Time, s; position, m; rotation vector, rad."""


@dataclass(frozen=True)
class Hand:
    """A hand's motion and what it does. `grip` holds nodes within `reach` of its origin from frame 0 on; `fist` pushes."""

    keys: tuple[KeyFrame, ...]
    kind: Literal["grip", "fist"] = "grip"
    reach: float = 0.02
    """m."""
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """How the mesh stands in the hand's frame: rotation vector, rad. Physics does not see it."""

    def poses(self, times: np.ndarray) -> np.ndarray:
        """Position and quaternion (x, y, z, w) [n, 7] at `times`, s: minimum jerk from key to key."""
        at = np.array([key[0] for key in self.keys])
        positions = np.array([key[1] for key in self.keys], dtype=float)
        rotations = Rotation.from_rotvec([key[2] for key in self.keys])
        if len(at) == 1:
            return np.tile(np.concatenate([positions[0], rotations[0].as_quat()]), (len(times), 1))
        piece = np.clip(np.searchsorted(at, times, side="right") - 1, 0, len(at) - 2)
        fraction = minimum_jerk((times - at[piece]) / (at[piece + 1] - at[piece]))
        place = positions[piece] + (positions[piece + 1] - positions[piece]) * fraction[:, None]
        turned = Slerp(at, rotations)(np.clip(at[piece] + (at[piece + 1] - at[piece]) * fraction, at[0], at[-1]))
        return np.concatenate([place, turned.as_quat()], axis=1)

    def mesh(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        """Vertices in the hand's frame [V, 3], m, and faces [F, 3]."""
        if self.kind == "fist":
            reach = 1.2 * FIST_RADIUS
            return surface(sphere((0, 0, 0), FIST_RADIUS), (-reach,) * 3, (reach,) * 3, spacing)
        vertices, faces = surface(_grip(), (-0.12, -0.07, -0.02), (0.07, 0.07, 0.25), spacing)
        return Rotation.from_rotvec(self.turn).apply(vertices), faces


def minimum_jerk(fraction: np.ndarray) -> np.ndarray:
    """u^3 (10 - 15 u + 6 u^2), clipped to [0, 1]: starts and ends without velocity and acceleration."""
    u = np.clip(fraction, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u * u))


def place(vertices: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Vertices [n, V, 3] of a mesh [V, 3] at poses [n, 7]."""
    turned = np.stack([Rotation.from_quat(pose[3:]).apply(vertices) for pose in poses])
    return np.asarray(turned + poses[:, None, :3])


def _grip() -> Sdf:
    """Palm, wrist, four fingers and a thumb that close at the origin, coming from above."""
    parts = [ellipsoid((-0.01, 0, 0.075), (0.03, 0.042, 0.03)), capsule((-0.02, 0, 0.1), (-0.07, 0, 0.2), 0.027)]
    for y in (-0.03, -0.01, 0.01, 0.03):
        parts.append(capsule((0.012, y, 0.08), (0.035, 0.8 * y, 0.045), 0.0095))
        parts.append(capsule((0.035, 0.8 * y, 0.045), (0.02, 0.6 * y, 0.006), 0.0085))
    parts.append(capsule((-0.03, 0, 0.07), (-0.035, 0, 0.04), 0.011))
    parts.append(capsule((-0.035, 0, 0.04), (-0.018, 0, 0.006), 0.0095))
    return smooth_union(parts, 0.004)
