"""Marks of the label `obstacle` -> boxes, balls and planes, measured by depth, in `obstacles` of capture.json.

Each mark is one thing. Its pixels with depth are points p in the world. Robust least squares (Cauchy) of the distance to its
surface fit each shape:

    plane  n . p - d
    ball   |p - c| - r
    box    signed distance to a box of any rotation, begun upright and from two perpendicular planes through the points

The residual is the distance within which nine tenths of the points lie. The first of the three whose residual is not more than
SIMPLER above the least one is taken. A plane becomes a slab: down to the table where it is level, else SLAB thick, behind what was
seen.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from pydantic import TypeAdapter
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from neuspring.core.errors import InputError
from neuspring.core.files import load_json, write_text
from neuspring.core.geometry import Obstacle
from neuspring.data.capture import CAPTURE, Capture
from neuspring.perception.marks.marks import Mark, Marks, drawn

FEWEST_OBSTACLE_POINTS, MOST_FITTED = 50, 600
"""Points that an obstacle needs, and that are fitted at most."""
TRIMMED = 0.03
"""Part of the points, at either end of an axis, that do not say how far a box reaches."""
FLYING = 0.01
"""m: a pixel whose depth differs more from the median around it shows neither side of a border."""
CROWD, ALONE = 8, 3.0
"""Rank of a neighbor, the point itself included, and the multiple of its usual distance from which a point shows no surface."""
SHARE_WITHIN = 0.9
"""Part of the points whose distance is the residual; the others may be flying pixels at borders."""
SIMPLER = 0.001
"""A simpler shape is taken where its residual is larger by no more than this, m."""
OUTLYING = 0.003
"""m: distance from which a point counts less."""
HOLD_SIDES = 0.05
"""Distance from the surface, m, that counts like a step of 1 of a box's sides."""
MOST_STEPS = 50
"""Steps of a fit: what is no box creeps for long."""
SLAB, LEVEL_NORMAL = 0.04, 0.97
"""m; and the vertical part of a normal from which a plane is level."""
LARGEST_BALL = 1.0
"""m."""


@dataclass(frozen=True)
class MeasuredObstacle:
    """A mark's shape."""

    kind: str
    """plane, ball or box."""
    obstacle: Obstacle
    residual: float
    """m."""
    points: int

    def text(self) -> str:
        """It in words."""
        one = self.obstacle
        sides = " x ".join(f"{200 * half:.1f}" for half in one.half_sizes)
        sizes = f"radius {100 * one.radius:.1f} cm" if self.kind == "ball" else f"{sides} cm"
        kind = "plane (as a slab)" if self.kind == "plane" else self.kind
        return f"{kind} of {sizes}, residual {1e3 * self.residual:.1f} mm ({SHARE_WITHIN:.0%} of {self.points} points)"


def fit(points: np.ndarray, up: float, eye: np.ndarray) -> MeasuredObstacle:
    """The shape of points [n, 3], m, that a camera at `eye` [3] saw; up is +1 or -1."""
    # Between two things fly single points.
    alone = cKDTree(points).query(points, k=CROWD)[0][:, -1]
    crowd = points[alone <= ALONE * np.median(alone)]
    some = crowd[np.linspace(0, len(crowd) - 1, min(len(crowd), MOST_FITTED)).astype(int)]
    found = [_plane(some, up, eye), _box(some, up)]
    if ball := _ball(some, eye):
        found.insert(1, ball)
    residuals = [float(np.quantile(np.abs(distance_of(points)), SHARE_WITHIN)) for _, _, distance_of in found]
    best = next(index for index, own in enumerate(residuals) if own <= min(residuals) + SIMPLER)
    kind, obstacle, _ = found[best]
    return MeasuredObstacle(kind, obstacle, residuals[best], len(points))


def _solved(distances: Any, start: np.ndarray) -> np.ndarray:
    return np.asarray(least_squares(distances, start, loss="cauchy", f_scale=OUTLYING, max_nfev=MOST_STEPS).x)


def _reach(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends [3] of evenly spread places [n, 3], without the outermost ones."""
    low, high = np.quantile(places, [TRIMMED, 1 - TRIMMED], axis=0)
    beyond = TRIMMED / (1 - 2 * TRIMMED) * (high - low)
    return low - beyond, high + beyond


def _plane(points: np.ndarray, up: float, eye: np.ndarray) -> tuple[str, Obstacle, Any]:
    """The plane, as a slab whose face is as large as the points need."""
    normal, middle = _facing(points, eye)
    solved = _solved(lambda v: (points - middle) @ (normal + v[:3]) / np.linalg.norm(normal + v[:3]) - v[3], np.zeros(4))
    normal = (normal + solved[:3]) / np.linalg.norm(normal + solved[:3])
    middle = middle + solved[3] * normal
    axes = np.column_stack([*_plan_axes(points - middle, normal), normal])
    low, high = _reach((points - middle) @ axes)
    level = up * normal[2] > LEVEL_NORMAL and up * middle[2] > OUTLYING
    thick = up * middle[2] if level else SLAB
    center = middle + axes[:, :2] @ (low + high)[:2] / 2 - normal * thick / 2
    half = np.array([*np.maximum((high - low)[:2] / 2, OUTLYING), thick / 2])
    return "plane", _obstacle(center, half, axes), lambda p: (p - middle) @ normal


def _ball(points: np.ndarray, eye: np.ndarray) -> tuple[str, Obstacle, Any] | None:
    """The ball; None where the points bend away from the camera, or hardly at all."""
    # |p|^2 = 2 c . p + (r^2 - |c|^2) is linear in c and the rest.
    middle = points.mean(axis=0)
    own = points - middle
    solved = np.linalg.lstsq(np.column_stack([2 * own, np.ones(len(own))]), (own**2).sum(axis=1), rcond=None)[0]
    start = np.append(solved[:3], np.sqrt(max(solved[3] + solved[:3] @ solved[:3], 1e-6)))
    if start[3] > LARGEST_BALL:
        return None
    *center, radius = _solved(lambda v: np.linalg.norm(own - v[:3], axis=1) - v[3], start)
    center, radius = np.array(center) + middle, abs(float(radius))
    if radius > LARGEST_BALL or np.linalg.norm(center - eye) < np.linalg.norm(middle - eye):
        return None
    obstacle = Obstacle(shape="sphere", center=_rounded(center), radius=round(radius, 4))
    return "ball", obstacle, lambda p: np.linalg.norm(p - center, axis=1) - radius


def _box(points: np.ndarray, up: float) -> tuple[str, Obstacle, Any]:
    """The box of the least residual, from both beginnings; sides that were not seen stay where the points end, or on the table."""
    own = points
    # Points off the first box may have made it too large: they do not count for the second one.
    for _ in range(2):
        solved = [_box_from(own, axes) for axes in (_upright(own), _perpendicular(own))]
        best = min(solved, key=lambda one: float(np.quantile(np.abs(box_distance(points, *one)), SHARE_WITHIN)))
        own = points[np.abs(box_distance(points, *best)) < FLYING]
    center, half, turn = best
    return "box", _obstacle(*_to_table(center, half, turn, up), turn), lambda p: box_distance(p, *best)


def _box_from(points: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Center, half sizes and axes of the box of least squares, begun with `axes` [3, 3] as large as the points are."""
    low, high = _reach(points @ axes)

    def box(v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Turned by the rotation vector v[:3], moved by v[3:6], grown by v[6:]."""
        half = np.maximum((high - low) / 2 + v[6:], OUTLYING)
        return axes @ (low + high) / 2 + v[3:6], half, axes @ Rotation.from_rotvec(v[:3]).as_matrix()

    # A side that no point shows stays where it is.
    return box(_solved(lambda v: np.append(box_distance(points, *box(v)), HOLD_SIDES * v), np.zeros(9)))


def box_distance(points: np.ndarray, center: np.ndarray, half: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Signed distance [n], m, of points [n, 3] to the surface of a box with half sizes [3] and own axes in columns [3, 3]."""
    beyond = np.abs((points - center) @ turn) - half
    return np.asarray(np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0))


def _facing(points: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normal [3] of the plane through points, towards the eye, and their middle [3]."""
    middle = np.median(points, axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    return np.asarray(normal * (1.0 if (eye - middle) @ normal > 0 else -1.0)), np.asarray(middle)


def _plan_axes(points: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axes of the smallest rectangle about points, normal to `normal`; with it they are right-handed."""
    first = np.cross(normal, (0.0, 0.0, 1.0) if abs(normal[2]) < LEVEL_NORMAL else (1.0, 0.0, 0.0))
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    angle = np.radians(cv2.minAreaRect((points @ np.column_stack([first, second])).astype(np.float32))[2])
    turned = np.cos(angle) * first + np.sin(angle) * second
    return turned, np.cross(normal, turned)


def _upright(points: np.ndarray) -> np.ndarray:
    """Axes [3, 3] of a box that stands upright."""
    normal = np.array([0.0, 0.0, 1.0])
    return np.column_stack([*_plan_axes(points, normal), normal])


def _perpendicular(points: np.ndarray) -> np.ndarray:
    """Axes [3, 3] by the plane that most points lie on, and the one across it that most of the others do (sampled, seeded)."""
    rng = np.random.default_rng(0)
    corners = points[rng.integers(len(points), size=(300, 3))]
    first, on = _most(points, np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), corners[:, 0])
    rest = points[~on]
    if len(rest) < FEWEST_OBSTACLE_POINTS // 2:
        return np.column_stack([*_plan_axes(points, first), first])
    ends = rest[rng.integers(len(rest), size=(200, 2))]
    second, _ = _most(rest, np.cross(first, ends[:, 1] - ends[:, 0]), ends[:, 0])
    return np.column_stack([first, second, np.cross(first, second)])


def _most(points: np.ndarray, normals: np.ndarray, through: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normal of the plane on which most points lie, of those with normals [k, 3] through [k, 3]; and which these are."""
    units = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    on = np.abs(np.einsum("nkc,kc->nk", points[:, None] - through, units)) < OUTLYING
    best = int(np.where(np.linalg.norm(normals, axis=1) > 1e-9, on.sum(axis=0), -1).argmax())
    return units[best], on[:, best]


def _to_table(center: np.ndarray, half: np.ndarray, turn: np.ndarray, up: float) -> tuple[np.ndarray, np.ndarray]:
    """Center and half sizes of a box with a level side, whose unseen lower part goes down to the table."""
    level = int(np.abs(turn[2]).argmax())
    top = up * center[2] + half[level]
    if abs(turn[2, level]) < LEVEL_NORMAL or top < OUTLYING:
        return center, half
    # The vertical axis alone moves: a box that leans a little keeps its other sides.
    sunk = half[level] - top / 2
    half = np.where(np.arange(3) == level, top / 2, half)
    return center + up * sunk * turn[:, level] * np.sign(turn[2, level]), half


def _rounded(values: np.ndarray) -> Any:
    return tuple(np.round(values, 4).tolist())


def _obstacle(center: np.ndarray, half: np.ndarray, axes: np.ndarray) -> Obstacle:
    turn = axes * (1.0, 1.0, np.sign(np.linalg.det(axes)))
    rotation: Any = tuple(map(tuple, np.round(turn, 6).tolist()))
    return Obstacle(shape="box", center=_rounded(center), half_sizes=_rounded(half), rotation=rotation)


def measure_obstacles(capture: Capture, marks: Marks) -> list[MeasuredObstacle]:
    """The shapes of all marks of obstacles. Raises InputError without marks, depth, or points enough."""
    named = [(camera, mark) for camera, own in marks.cameras.items() for mark in own if mark.label == "obstacle"]
    if not named:
        raise InputError("marks", "an obstacle must be marked", "none", "Draw a polygon around each thing that stands still.")
    if not capture.has_depth:
        raise InputError(
            f"{capture.folder}, depth", "obstacles are measured by depth", "none", "Write them into capture.json by hand."
        )
    found = []
    for camera, mark in named:
        points = _points(capture, camera, mark)
        if len(points) < FEWEST_OBSTACLE_POINTS:
            where = f"camera {camera}, frame {mark.frame}, obstacle"
            rule = f"{FEWEST_OBSTACLE_POINTS} of its pixels must have depth"
            raise InputError(where, rule, len(points), "Mark more of it, or a frame in which it has depth.")
        found.append(fit(points, capture.description.up_sign, capture.cameras[camera].camera_to_world[:3, 3]))
    return found


def _points(capture: Capture, camera: str, mark: Mark) -> np.ndarray:
    view, depth = capture.cameras[camera], capture.depth(camera, mark.frame)
    smooth = np.abs(depth - cv2.medianBlur(depth.astype(np.float32), 5)) < FLYING
    y, x = np.nonzero(drawn(mark, depth.shape, 1.0) & (depth > 0) & smooth)
    return np.asarray(view.lift(np.stack([x, y], axis=1).astype(float), depth[y, x]))


def write_obstacles(capture: Capture, found: Sequence[MeasuredObstacle]) -> str:
    """Add measured obstacles to capture.json, and say what was written.

    One that is there already, its center in the new one or the other way round, is replaced.
    """
    path = capture.folder / CAPTURE
    values, new = load_json(path), [one.obstacle for one in found]
    kept = []
    for entry in values.get("obstacles", []):
        old = TypeAdapter(Obstacle).validate_python(entry)
        same = (one.depth(np.array([old.center]))[0] > 0 or old.depth(np.array([one.center]))[0] > 0 for one in new)
        kept += [] if any(same) else [entry]
    values["obstacles"] = kept + [_plain(one) for one in new]
    write_text(path, json.dumps(values, indent=1) + "\n")
    return f"Wrote to {CAPTURE}: " + "; ".join(one.text() for one in found) + (f". {len(kept)} others stay." if kept else ".")


def _plain(one: Obstacle) -> dict[str, Any]:
    if one.shape == "sphere":
        return {"shape": "sphere", "center": one.center, "radius": one.radius}
    return {"shape": "box", "center": one.center, "half_sizes": one.half_sizes, "rotation": one.rotation}
