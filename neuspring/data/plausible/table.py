"""The table that each camera sees against z = 0 and `up`, and what explains a departure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neuspring.core.artifacts import up_sign
from neuspring.data.departure import Departure, broken, note, unusual
from neuspring.data.intake.lenses import rigid_inverse
from neuspring.data.intake.plane import Plane

SMALLEST = 0.08
"""Share of the pixels with depth from which a plane may be the table."""
TILT, OFF = 2.0, 0.01
"""Degrees and m within which the table is level and at z = 0. Ground contact of the simulation is at z = 0."""
TILTED, FAR_OFF = 15.0, 0.15
"""Degrees and m beyond which the table is elsewhere, and no twin can rest on it."""
EXPLAINED = (4.0, 0.03)
"""Degrees and m within which the table lies after a change that explains a departure; m also as a part of the camera's height."""
FACTORS = (0.1, 10.0, 0.001, 1000.0)
"""Wrong units of depth make the scene so many times as large."""
HIGHEST = 3.0
"""m. Cameras higher above the table have too coarse a picture of what lies on it, or another unit of depth."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenCV's axes of a camera to OpenGL's, where y is up and z points backward."""


@dataclass(frozen=True)
class Stand:
    """How a plane stands in the world."""

    tilt: float
    """Angle of its normal with up, degrees."""
    off: float
    """Height of its points above z = 0 along up, m."""

    @property
    def good(self) -> bool:
        """Whether it is z = 0."""
        return self.tilt < TILT and abs(self.off) < OFF

    def near(self, height: float) -> bool:
        """Whether it is so after a change; `height` is the camera's above the plane, m."""
        return self.tilt < EXPLAINED[0] and abs(self.off) < max(EXPLAINED[1], EXPLAINED[1] * height)


def stand(plane: Plane, pose: np.ndarray, up: float, factor: float = 1.0) -> Stand:
    """How `plane` stands in the world by `pose`, camera to world [4, 4], m, if depth is multiplied by `factor`."""
    cosine = up * (pose[:3, :3] @ plane.normal)[2]
    z = (factor * plane.points.mean(axis=0)) @ pose[2, :3] + pose[2, 3]
    return Stand(float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))), float(up * z))


def table_departures(
    path: Path, name: str, planes: Sequence[Plane], pose: np.ndarray, up: str, unit: float | None
) -> list[Departure]:
    """Departures of one camera's table from z = 0. `unit`, m per count, is None where depth is in meters by its type."""
    sign = up_sign(up)
    where = f"cameras.{name}.camera_to_world"
    candidates = [plane for plane in planes if plane.share >= SMALLEST]
    if not candidates:
        return [note(path, f"camera {name} sees no plane in depth: z = 0 and up are not checked against the table")]
    table = min(candidates, key=lambda plane: _cost(stand(plane, pose, sign)))
    standing = stand(table, pose, sign)
    if standing.good:
        found = [note(path, f"camera {name}: the table is {_text(standing)}; plane: {table.text()}")]
        if table.height > HIGHEST:
            rule = f"{where}: a camera should be at most {HIGHEST:g} m above the table"
            next_move = f"{table.height:.2f} m. Check depth_unit: ten times too large makes all of the scene so"
            found.append(unusual(path, "", rule, next_move))
        return found
    for plane in candidates:
        explained = _explained(path, name, plane, pose, up, unit)
        if explained:
            return [explained]
    moved = f"{_text(standing)}; plane: {table.text()}"
    if standing.tilt > TILTED or abs(standing.off) > FAR_OFF:
        remedy = "Calibrate again, or let `neuspring make-capture --level` put it there"
        return [broken(path, where, "the table that the camera sees must be z = 0", f"{moved}. {remedy}")]
    remedy = "`neuspring make-capture --level` puts the table at z = 0"
    return [unusual(path, where, "the table that the camera sees should be z = 0", f"{moved}. {remedy}")]


def _cost(standing: Stand) -> float:
    return standing.tilt / TILT + abs(standing.off) / OFF


def _text(standing: Stand) -> str:
    side = "above" if standing.off > 0 else "below"
    return f"{1e3 * abs(standing.off):.0f} mm {side} z = 0 and tilted by {standing.tilt:.1f} degrees"


def _explained(path: Path, name: str, plane: Plane, pose: np.ndarray, up: str, unit: float | None) -> Departure | None:
    """The one change that puts the table at z = 0, as an error; None if there is none."""
    sign = up_sign(up)
    where = f"cameras.{name}.camera_to_world"
    other = "-z" if up == "+z" else "+z"
    flipped = stand(plane, pose, -sign)
    if flipped.tilt < TILTED and abs(flipped.off) < FAR_OFF:
        height = 1e3 * sign * pose[2, 3]
        rule = f"must be the side of the table on which the cameras are: {other}"
        return broken(path, "up", rule, f"{up}, by which camera {name} is {abs(height):.0f} mm below the table")
    for factor in FACTORS:
        if stand(plane, pose, sign, 1 / factor).near(pose[2, 3]):
            what = "depth_unit" if unit is not None else f"depth of camera {name}"
            now = (
                f"{unit:g}, which makes it {factor:g} times as far. Plausible would be {unit / factor:g}"
                if unit
                else f"{factor:g} times"
            )
            return broken(path, what, f"the table must be as far from camera {name} as its pose says", now)
    variants: Mapping[str, np.ndarray] = {
        "a world-to-camera matrix. Invert it": rigid_inverse(pose),
        "a matrix for OpenGL's axes (y up, z backward). Change the signs of its second and third column": pose @ OPENGL,
        "a world-to-camera matrix for OpenGL's axes (y up, z backward). Invert it, then change the signs of its second and third "
        "column": rigid_inverse(pose) @ OPENGL,
    }
    for what, variant in variants.items():
        for direction in (sign, -sign):
            if stand(plane, variant, direction).near(plane.height):
                rule = "camera-to-world is required (x right, y down, z forward): with it the table is z = 0"
                also = "" if direction == sign else f", and set up to {other}"
                return broken(path, where, rule, f"what looks like {what}{also}")
    return None
