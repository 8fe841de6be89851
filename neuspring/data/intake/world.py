"""Where the world is: z = 0 on the table, from the plane that cameras see."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from neuspring.core.errors import InputError
from neuspring.data.intake.plane import Plane, planes

SMALLEST = 0.1
"""Share of the pixels with depth below which a plane is no table."""
ROLL = 60.0
"""Degrees. The normal of a table leans from the upward direction of the image by less, that of a side wall or a ceiling by more."""
FRONTAL = 12.0
"""Degrees between the optical axis and the normal below which a table seen from straight above and a wall look alike."""
ROUGH = 0.02
"""m rms. A plane that fits worse is no table."""
HIGHEST = 4.0
"""m. A camera higher above the table has another unit of depth."""
LEVEL_ANGLE, APART = 10.0, 0.03
"""Degrees and m: planes with nearly the normal of the table, this far above or below it, are other level surfaces."""
MIDDLE = 1.0 / 3.0
"""Part of the image, in its center, that is the center of view."""


@dataclass(frozen=True, eq=False)
class Table:
    """The table that a camera sees."""

    plane: Plane
    remarks: tuple[str, ...] = ()
    """What the user should know about the choice."""


def find_table(
    where: object, points: np.ndarray, *, top_down: bool = False, at: np.ndarray | None = None, pose: np.ndarray | None = None
) -> Table:
    """The table among the planes in points [n, 3], m, in the coordinates of a camera.

    It is the largest plane whose normal points up in the image; with `at`, the one through this point [3]. With a `pose`, camera to
    world [4, 4] with z upright, up is that of the world. Raises InputError where there is none: the largest plane is a wall or a
    ceiling, or a plane that faces the camera without `top_down`, too small a part of the image, or not flat.
    """
    found = planes(points)
    if not found:
        remedy = "Film more of the table, or give --poses."
        raise InputError(where, "the table must be seen: no plane was found in depth", remedy=remedy)
    if at is not None:
        found = sorted(found, key=lambda plane: abs(plane.above(at)))[:1]
        if abs(found[0].above(at)) > 0.02:
            raise InputError(
                "--table-at", "this pixel must lie on a plane", f"one {abs(found[0].above(at)):.3f} m from the nearest"
            )
    reasons = [_objection(plane, top_down, pose) for plane in found]
    fitting = [plane for plane, reason in zip(found, reasons, strict=True) if not reason]
    if not fitting:
        remedy = "Film the table from above its edge, upright; or give the poses of the cameras (--poses, --board)."
        raise InputError(where, f"no plane can be the table. The largest: {found[0].text()}: {reasons[0]}", remedy=remedy)
    table, remarks = fitting[0], []
    if table is not found[0]:
        remarks.append(f"the largest plane is not taken for the table: {reasons[0]}")
    for other in fitting[1:]:
        height = float(np.median(table.above(other.points)))
        level = np.degrees(np.arccos(np.clip(other.normal @ table.normal, -1, 1))) < LEVEL_ANGLE
        if level and abs(height) > APART:
            side = "above" if height > 0 else "below"
            remarks.append(
                f"another level surface, {100 * abs(height):.0f} cm {side} it, has {other.share:.0%} of the pixels: if that is the "
                "table, name a pixel of it by --table-at"
            )
    return Table(table, tuple(remarks))


def _objection(plane: Plane, top_down: bool, pose: np.ndarray | None) -> str:
    """Why a plane is not the table; empty if it may be."""
    if plane.share < SMALLEST:
        return f"it has less than {SMALLEST:.0%} of the pixels with depth"
    if plane.rms > ROUGH:
        return f"it is not flat: more than {1e3 * ROUGH:g} mm rms"
    if plane.height > HIGHEST:
        return f"the camera would be more than {HIGHEST:g} m above it: is the unit of depth right?"
    if pose is not None:
        angle = float(np.degrees(np.arccos(np.clip(abs((pose[:3, :3] @ plane.normal)[2]), 0, 1))))
        return f"it is a wall: its normal is {angle:.0f} degrees from the vertical of the poses" if angle > ROLL else ""
    if 90.0 - plane.elevation < FRONTAL:
        facing = "it faces the camera: a wall, or a table seen from straight above; --top-down says that it is the table"
        return "" if top_down else facing
    roll = float(np.degrees(np.arctan2(abs(plane.normal[0]), -plane.normal[1])))
    if roll > ROLL:
        return f"it is a wall or a ceiling: its normal leans {roll:.0f} degrees from the upward direction of the image"
    return ""


def pose_on(table: Plane, points: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Camera to world [4, 4], m, of a camera that sees `table`: z along its normal, x to the right of the image.

    The origin lies on the table below the center of view: the median of the points [n, 3] within a third of the image around its
    center, in pixels over focal length [2].
    """
    up = table.normal
    y = np.cross(up, [1.0, 0.0, 0.0])
    y /= np.linalg.norm(y)
    axes = np.stack([np.cross(y, up), y, up])
    rays = points[:, :2] / points[:, 2:]
    middle = points[(np.abs(rays) < center).all(axis=1)]
    target = np.median(middle if len(middle) else table.points, axis=0)
    origin = target - table.above(target) * up
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, -axes @ origin
    return pose


def center_of(size: tuple[int, int], intrinsics: np.ndarray) -> np.ndarray:
    """Half the extent of the center of view, in pixels over focal length [2]."""
    return np.asarray(0.5 * MIDDLE * np.array(size) / np.diag(intrinsics)[:2])


def common_plane(tables: Mapping[str, Plane], poses: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, float]:
    """Normal [3], towards the cameras, a point [3] and rms, m, of the plane through the table's points that all cameras
    see, in the world."""
    points = np.concatenate([plane.points @ poses[name][:3, :3].T + poses[name][:3, 3] for name, plane in tables.items()])
    center = points.mean(axis=0)
    normal = np.linalg.svd((points - center).T @ (points - center))[0][:, -1]
    eyes = np.mean([poses[name][:3, 3] for name in tables], axis=0)
    normal = normal if normal @ (eyes - center) > 0 else -normal
    return normal, center, float(np.sqrt(np.mean(((points - center) @ normal) ** 2)))


def levelling(normal: np.ndarray, point: np.ndarray, up: float) -> np.ndarray:
    """The motion [4, 4] of the world that puts a plane at z = 0, its normal along `up` z: the least turn, about a level axis."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.align_vectors([[0.0, 0.0, up]], [normal])[0].as_matrix()
    motion[2, 3] = -(motion[:3, :3] @ point)[2]
    return motion
