"""Static obstacles (boxes and spheres that stand in the scene and do not move), choices among points, and how lines run."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from neuspring.core.errors import InputError

UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
NOT_TURNED = 1e-4
"""Largest difference between an entry of R R' and that of the unit matrix."""
Triple = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Obstacle:
    """A box or a sphere in the world."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}
    shape: Literal["box", "sphere"]
    center: Triple
    """m."""
    half_sizes: Triple = (0.0, 0.0, 0.0)
    """Half sizes of a box along its own axes, m."""
    rotation: tuple[Triple, Triple, Triple] = UPRIGHT
    """Rotation of a box from its own axes to the world: x_world = center + rotation x_own."""
    radius: float = 0.0
    """Radius of a sphere, m."""

    def __post_init__(self) -> None:
        for name in ("center", "half_sizes"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))
        object.__setattr__(self, "rotation", tuple(tuple(map(float, row)) for row in self.rotation))

    def wrong(self) -> tuple[str, str, object] | None:
        """(field, rule, value) of what is wrong with it; None if nothing is."""
        turn, sizes = np.array(self.rotation), np.array(self.half_sizes)
        if self.shape not in ("box", "sphere"):
            return "shape", "must be 'box' or 'sphere'", self.shape
        if np.shape(self.center) != (3,) or not np.isfinite(self.center).all():
            return "center", "three finite numbers are required, m", self.center
        if self.shape == "sphere":
            return None if 0 < self.radius < np.inf else ("radius", "a positive radius is required, m", self.radius)
        if sizes.shape != (3,) or not (np.isfinite(sizes).all() and (sizes > 0).all()):
            return "half_sizes", "three positive half sizes are required, m", self.half_sizes
        if turn.shape != (3, 3) or not np.isfinite(turn).all():
            return "rotation", "three rows of three finite numbers are required", self.rotation
        if np.abs(turn @ turn.T - np.eye(3)).max() > NOT_TURNED or np.linalg.det(turn) < 0:
            return "rotation", "must be a rotation: orthonormal rows, determinant +1", self.rotation
        return None

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Depth [P], m, of points [P, 3], m, inside; negative outside."""
        away = np.asarray(points, np.float64) - np.array(self.center)
        if self.shape == "sphere":
            return np.asarray(self.radius - np.linalg.norm(away, axis=1))
        return np.asarray((np.array(self.half_sizes) - np.abs(away @ np.array(self.rotation))).min(axis=1))

    def row(self) -> list[float]:
        """16 numbers for kernels: 0 for a box or 1 for a sphere, center, own axes one after the other, half sizes or radius."""
        axes = np.array(self.rotation).T.ravel().tolist()
        sizes = list(self.half_sizes) if self.shape == "box" else [self.radius] * 3
        return [float(self.shape == "sphere"), *self.center, *axes, *sizes]


def obstacles_of(values: Iterable[Obstacle | dict[str, Any]], where: str) -> tuple[Obstacle, ...]:
    """Obstacles, from themselves or from what JSON holds of them. Raises InputError naming `where` and the field."""
    found = tuple(value if isinstance(value, Obstacle) else Obstacle(**value) for value in values)
    for number, obstacle in enumerate(found):
        if wrong := obstacle.wrong():
            raise InputError(f"{where}.obstacles[{number}].{wrong[0]}", wrong[1], wrong[2])
    return found


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
