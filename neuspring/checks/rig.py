"""Camera poses checked against the table z = 0 and against each other, with depth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import cv2
import numpy as np

from neuspring.core.artifacts import up_sign
from neuspring.data.camera import Camera
from neuspring.data.planes import cloud, planes

SMALLEST_PLANE = 0.08
"""A plane may be the table if it contains at least this fraction of the pixels with depth."""
TILT, TABLE_OFF = 2.0, 0.01
"""Accepted tilt of the table, degrees, and distance from z = 0, m. The simulated ground is at z = 0."""
FAR_OFF = 0.15
"""Distance from z = 0, m (or 15 degrees of tilt), above which `off_table` is an error, because no twin can rest on this table."""
FLAT_POINTS = 8000
"""Number of points for the flatness of depth."""
ABOVE_TABLE, ROOM_HEIGHT = 0.015, 0.8
"""Heights above z = 0, m, between which points belong to objects: below is the table, above is the room."""
FREE, FEWEST_SHARED, DEPTH_STRIDE = 0.03, 150, 2
"""Excess depth, m, with which B looks through a point of A; number of points that both must see; stride of compared pixels."""


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras and their depth in a few frames."""

    cameras: Mapping[str, Camera]
    depths: Mapping[str, Sequence[np.ndarray]]
    """Depth images [H, W], m, by camera, without object and hands; empty for a camera without depth."""
    first: Mapping[str, np.ndarray]
    """Depth of frame 0 [H, W], m, by camera."""
    up: str

    @cached_property
    def tables(self) -> dict[str, tuple[float, float, str]]:
        """Camera -> tilt, degrees, and height above z = 0, m, of its plane nearest to z = 0, and the plane as text."""
        sign, nearest = up_sign(self.up), {}
        for name, depths in self.depths.items():
            pose, candidates = self.cameras[name].camera_to_world, list[tuple[float, float, str]]()
            for plane in planes(cloud(depths, self.cameras[name].intrinsics)):
                tilt = float(np.degrees(np.arccos(np.clip(sign * (pose[:3, :3] @ plane.normal)[2], -1, 1))))
                off = float(sign * (plane.points.mean(axis=0) @ pose[2, :3] + pose[2, 3]))
                candidates += [(tilt, off, plane.text())] if plane.share >= SMALLEST_PLANE else []
            if candidates:
                nearest[name] = min(candidates, key=lambda plane: plane[0] / TILT + abs(plane[1]) / TABLE_OFF)
        return nearest


def off_table(rig: Rig) -> Iterator[dict[str, Any]]:
    """Distance of each camera's table from z = 0, m. A tilt above TILT counts as 1 cm per degree."""
    for name, (tilt, off, text) in rig.tables.items():
        value = max(abs(off), 0.01 * tilt if tilt > TILT else 0.0)
        words = {"where": f"camera {name}", "value": value, "level": "error" if value > FAR_OFF else "warning"}
        yield words | {"detail": f"{1e3 * off:.0f} mm above z = 0, tilted by {tilt:.1f} degrees; plane: {text}"}


def view_of_table(rig: Rig) -> Iterator[dict[str, Any]]:
    """Distance, m, along the ray of each image's center to the table z = 0; 0 if the ray misses it or comes from below."""
    for name, camera in rig.cameras.items():
        eye = camera.camera_to_world[:3, 3]
        center = np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])
        ray = camera.rays(center)
        above = up_sign(rig.up) * eye[2] > 0 and eye[2] * ray[2] < 0
        value = float(np.linalg.norm(ray) * -eye[2] / ray[2]) if above else 0.0
        yield {"where": f"camera {name}", "value": value, "detail": f"camera at z = {eye[2]:.2f} m, up {rig.up}"}


def off_center(rig: Rig) -> Iterator[dict[str, Any]]:
    """Distance of each principal point from the image center, as a fraction of the image's sides."""
    for name, camera in rig.cameras.items():
        away = np.abs(camera.intrinsics[:2, 2] / (camera.width - 1, camera.height - 1) - 0.5).max()
        size = " x ".join(f"{2 * side + 1:.0f}" for side in camera.intrinsics[:2, 2])
        yield {"where": f"camera {name}", "value": float(away), "detail": f"it is the center of {size} images"}


def flatness(rig: Rig) -> Iterator[dict[str, Any]]:
    """Additional fraction of pixels on one plane if depth is treated as the distance to the camera.

    A distance r has the depth z = r / |K^-1 [x, y, 1]| along the axis.
    """
    for name, depths in rig.depths.items():
        if not depths:
            continue
        matrix, shape = rig.cameras[name].intrinsics, depths[0].shape
        y, x = np.mgrid[: shape[0], : shape[1]]
        length = np.linalg.norm(np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(matrix).T, axis=-1)
        before, after = (
            max((plane.share for plane in planes(cloud(some, matrix, FLAT_POINTS), 1)), default=0.0)
            for some in (depths, [depth / length for depth in depths])
        )
        yield {"where": f"camera {name}", "value": after - before, "detail": f"{before:.0%} as depth, {after:.0%} as distance"}


def disagreement(rig: Rig) -> Iterator[dict[str, Any]]:
    """Fraction of one camera's points that the other looks through, for each pair of cameras with enough common points."""
    for one, two in combinations(rig.first, 2):
        shares = [
            looked_through(rig.cameras[a], rig.first[a], rig.cameras[b], rig.first[b], rig.up) for a, b in ((one, two), (two, one))
        ]
        if known := [share for share in shares if share is not None]:
            yield {"where": f"cameras {one} and {two}", "value": max(known)}


def looked_through(a: Camera, depth_a: np.ndarray, b: Camera, depth_b: np.ndarray, up: str) -> float | None:
    """Fraction of the points of A above the table, in view of B, that B looks through: B measures more depth there.

    Less depth is no contradiction, because another object may occlude the point. Points on the table are not compared, because a
    shift along the table would not change them. None: too few points.
    """
    sign = up_sign(up)
    y, x = np.nonzero(depth_a[::DEPTH_STRIDE, ::DEPTH_STRIDE] > 0)
    pixels = DEPTH_STRIDE * np.stack([x, y], axis=-1)
    points = a.lift(pixels.astype(float), depth_a[pixels[:, 1], pixels[:, 0]])
    points = points[(sign * points[:, 2] > ABOVE_TABLE) & (sign * points[:, 2] < ROOM_HEIGHT)]
    seen, distance = b.project(points)
    visible = (distance > 0.05) & b.sees(seen)
    column, row = np.round(seen[visible]).astype(int).T
    expected, valid = distance[visible], depth_b[row, column] > 0
    if valid.sum() < FEWEST_SHARED:
        return None
    # At outlines, pixels next to a point see past it. B looks through the point only if all surrounding pixels do.
    nearest = cv2.erode(np.where(depth_b > 0, depth_b, np.inf).astype(np.float32), np.ones((3, 3), np.uint8))[row, column]
    return float((nearest - expected > FREE)[valid].mean())
