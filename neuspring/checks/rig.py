"""Cameras against the table z = 0 and against each other, by depth and by their poses."""

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
"""Share of the pixels with depth from which a plane may be the table."""
TILT, TABLE_OFF = 2.0, 0.01
"""Degrees and m within which the table is level and at z = 0. Ground contact of the simulation is at z = 0."""
FAR_OFF = 0.15
"""m (15 degrees) beyond which the table is elsewhere, and no twin can rest on it."""
FLAT_POINTS = 8000
"""Points in which the flatness of depth is measured."""
ABOVE_TABLE, ROOM_HEIGHT = 0.015, 0.8
"""m above z = 0: points that stand out of the table, and points that are the room."""
FREE, FEWEST_SHARED, DEPTH_STRIDE = 0.03, 150, 2
"""m: B looked through a point of A if it measured so much more; points that both must see; every so many pixels are compared."""


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras, and what they measured in a few frames."""

    cameras: Mapping[str, Camera]
    depths: Mapping[str, Sequence[np.ndarray]]
    """[H, W], m, without object and hands; none for a camera without depth."""
    first: Mapping[str, np.ndarray]
    """[H, W], m: all of one moment."""
    up: str

    @cached_property
    def tables(self) -> dict[str, tuple[float, float, str]]:
        """Tilt, degrees, and height above z = 0, m, of the plane of each camera that is nearest to z = 0; the plane in words."""
        sign, found = up_sign(self.up), {}
        for name, depths in self.depths.items():
            pose, stands = self.cameras[name].camera_to_world, list[tuple[float, float, str]]()
            for plane in planes(cloud(depths, self.cameras[name].intrinsics)):
                tilt = float(np.degrees(np.arccos(np.clip(sign * (pose[:3, :3] @ plane.normal)[2], -1, 1))))
                off = float(sign * (plane.points.mean(axis=0) @ pose[2, :3] + pose[2, 3]))
                stands += [(tilt, off, plane.text())] if plane.share >= SMALLEST_PLANE else []
            if stands:
                found[name] = min(stands, key=lambda one: one[0] / TILT + abs(one[1]) / TABLE_OFF)
        return found


def off_table(rig: Rig) -> Iterator[dict[str, Any]]:
    """Distance of each camera's table from z = 0, m; 1 degree of tilt counts as 1 cm where it is beyond TILT."""
    for name, (tilt, off, text) in rig.tables.items():
        value = max(abs(off), 0.01 * tilt if tilt > TILT else 0.0)
        told = {"where": f"camera {name}", "value": value, "level": "error" if value > FAR_OFF else "warning"}
        yield told | {"detail": f"{1e3 * off:.0f} mm above z = 0, tilted by {tilt:.1f} degrees; plane: {text}"}


def view_of_table(rig: Rig) -> Iterator[dict[str, Any]]:
    """Distance, m, at which the ray of each image's center meets the table z = 0; 0 where it does not, or from below."""
    for name, camera in rig.cameras.items():
        eye = camera.camera_to_world[:3, 3]
        center = np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])
        ray = camera.rays(center)
        above = up_sign(rig.up) * eye[2] > 0 and eye[2] * ray[2] < 0
        value = float(np.linalg.norm(ray) * -eye[2] / ray[2]) if above else 0.0
        yield {"where": f"camera {name}", "value": value, "detail": f"camera at z = {eye[2]:.2f} m, up {rig.up}"}


def off_center(rig: Rig) -> Iterator[dict[str, Any]]:
    """Distance of each principal point from the center of the image, as a fraction of its sides."""
    for name, camera in rig.cameras.items():
        away = np.abs(camera.intrinsics[:2, 2] / (camera.width - 1, camera.height - 1) - 0.5).max()
        fits = " x ".join(f"{2 * side + 1:.0f}" for side in camera.intrinsics[:2, 2])
        yield {"where": f"camera {name}", "value": float(away), "detail": f"it is the center of images of {fits}"}


def flatness(rig: Rig) -> Iterator[dict[str, Any]]:
    """Additional fraction of the pixels on one plane if depth is taken for the distance to the camera.

    Depth z along the axis of a distance r is z = r / |K^-1 [x, y, 1]|.
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
        yield {"where": f"camera {name}", "value": after - before, "detail": f"{before:.0%} of the pixels, and {after:.0%} then"}


def disagreement(rig: Rig) -> Iterator[dict[str, Any]]:
    """Share of the points of one camera that another one looked through, for every two cameras that share enough points."""
    for one, two in combinations(rig.first, 2):
        shares = [
            looked_through(rig.cameras[a], rig.first[a], rig.cameras[b], rig.first[b], rig.up) for a, b in ((one, two), (two, one))
        ]
        if known := [share for share in shares if share is not None]:
            yield {"where": f"cameras {one} and {two}", "value": max(known)}


def looked_through(a: Camera, depth_a: np.ndarray, b: Camera, depth_b: np.ndarray, up: str) -> float | None:
    """Share of the points of A above the table, in the view of B, that B looked through: B measured more depth there.

    Less depth is no contradiction: something may hide the point from B. A table that is moved along itself looks the same.
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
    # At an outline a pixel beside the point sees past it: B looked through the point if all pixels around it did.
    nearest = cv2.erode(np.where(depth_b > 0, depth_b, np.inf).astype(np.float32), np.ones((3, 3), np.uint8))[row, column]
    return float((nearest - expected > FREE)[valid].mean())
