"""From where a picture is taken, and which part of it is shown: a camera of the capture, or one from any side."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from neuspring.core.artifacts import Up
from neuspring.core.errors import InputError
from neuspring.data.capture import Camera

SIDE = 1200
"""Pixels of the picture of a camera from any side; only a part of it is shown."""
OPENING = math.radians(20)
"""Its angle of view: a long lens, so that near and far parts have almost one scale."""
STEEPEST = 89.0
"""Degrees above or below the horizon; straight down no side of the picture is up."""
MARGIN = 0.04
"""Free space around what is shown, as a fraction of its larger side."""
FLATTEST, TALLEST = 0.35, 1.3
"""Least and greatest height of a panel, over its width."""


def broad_side(points: np.ndarray, up: Up) -> float:
    """The azimuth, degrees, that shows the broadest side of points [P, 3], m: it looks along their least horizontal spread."""
    flat = np.asarray(points, float)[:, :2]
    x, y = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2][-1] if len(flat) > 1 else (0.0, -1.0)
    # Of both ends of that line the one nearer to the front, the side of negative y, so that views of one scene agree.
    x, y = (x, y) if y < 0 else (-x, -y)
    return math.degrees(math.atan2(_sign(up) * y, x))


def seen_from(points: np.ndarray, up: Up, azimuth: float, elevation: float) -> Camera:
    """A camera named "view" that holds all points [P, 3], m.

    It stands at `azimuth` degrees around the vertical axis, counted from +x and counter-clockwise as seen from above, and at
    `elevation` degrees above the horizon. Raises InputError for angles that no camera can have.
    """
    if not math.isfinite(azimuth):
        raise InputError("--azimuth", "must be an angle in degrees", azimuth)
    if not abs(elevation) <= STEEPEST:
        raise InputError("--elevation", f"must be {-STEEPEST:g} to {STEEPEST:g} degrees", elevation)
    points, sign = np.asarray(points, float), _sign(up)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    a, e = math.radians(azimuth), math.radians(elevation)
    forward = -np.array([math.cos(e) * math.cos(a), sign * math.cos(e) * math.sin(a), sign * math.sin(e)])
    right = np.cross(forward, [0.0, 0.0, sign])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward], axis=1)
    local = (points - middle) @ axes
    # A point is inside where its offset to the side is at most its depth times the tangent of half the angle of view.
    slope = math.tan(OPENING / 2)
    away = float((np.abs(local[:, :2]).max(axis=1) / slope - local[:, 2]).max())
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, middle - max(1.05 * away, 0.05) * forward
    focal = 0.5 * SIDE / slope
    half = 0.5 * (SIDE - 1)
    return Camera("view", SIDE, SIDE, np.array([[focal, 0, half], [0, focal, half], [0, 0, 1]]), pose)


def _sign(up: Up) -> float:
    return 1.0 if up == "+z" else -1.0


def box_around(pixels: np.ndarray, camera: Camera, *, clip: bool) -> tuple[int, int, int, int]:
    """Left, top, right and bottom (behind the last) pixel of the part of a picture that shows pixels [P, 2], with a margin.

    A part that is too flat or too tall grows. `clip` keeps it inside of the picture, which a camera's photo has to fill.
    """
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    size = np.maximum(high - low, 1.0)
    size = size + 2 * MARGIN * size.max()
    size[1] = max(size[1], FLATTEST * size[0])
    size[0] = max(size[0], size[1] / TALLEST)
    whole = np.array([camera.width, camera.height], float)
    if clip:
        size = np.minimum(size, whole)
    start = 0.5 * (low + high) - 0.5 * size
    if clip:
        start = np.clip(start, 0, whole - size)
    left, top = np.floor(start).astype(int)
    right, bottom = np.ceil(start + size).astype(int)
    if clip:
        left, top, right, bottom = max(left, 0), max(top, 0), min(right, camera.width), min(bottom, camera.height)
    return int(left), int(top), int(right), int(bottom)


def part(camera: Camera, box: tuple[int, int, int, int]) -> Camera:
    """The camera of a part of its picture."""
    left, top, right, bottom = box
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2, 2] -= left, top
    return replace(camera, width=right - left, height=bottom - top, intrinsics=intrinsics)


def finer(camera: Camera, least: int) -> Camera:
    """The same view in more pixels, at least `least` wide; pixel centers stay at whole coordinates."""
    factor = max(math.ceil(least / camera.width), 1)
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2] *= factor
    # Half a pixel of the border belongs to the outer pixels, whatever their size.
    intrinsics[:2, 2] += 0.5 * (factor - 1)
    return replace(camera, width=factor * camera.width, height=factor * camera.height, intrinsics=intrinsics)
