"""A camera's pose against the table, which must be z = 0 with `up` on the side of the cameras.

With depth the table is a plane that the camera sees; where it is elsewhere, what explains it is looked for: a wrong unit, an
inverse pose, other axes. With color alone the table is z = 0 as the pose says, and the camera must look at it from above.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from neuspring.core.artifacts import up_sign
from neuspring.core.checks import Check
from neuspring.core.geometry import rigid_inverse
from neuspring.data.camera import FAR, NEAR, ROLL, Camera, Plane
from neuspring.data.capture import OBJECT

SMALLEST_PLANE = 0.08
"""Share of the pixels with depth from which a plane may be the table."""
TILT, TABLE_OFF = 2.0, 0.01
"""Degrees and m within which the table is level and at z = 0. Ground contact of the simulation is at z = 0."""
TILTED, FAR_OFF = 15.0, 0.15
"""Degrees and m beyond which the table is elsewhere, and no twin can rest on it."""
EXPLAINED = (4.0, 0.03)
"""Degrees and m within which the table lies after a change that explains a finding; m also as a part of the camera's height."""
WRONG_UNITS = (0.1, 10.0, 0.001, 1000.0)
"""Wrong units of depth make the scene so many times as large."""
HIGHEST_CAMERA = 3.0
"""m. Cameras higher above the table have too coarse a picture of what lies on it, or another unit of depth."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenCV's axes of a camera to OpenGL's, where y is up and z points backward."""
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From a world with y up to one with z up."""
STRAIGHT_ABOVE = 20.0
"""Degrees from straight above, within which a camera has no upper side."""
POSE = "Look at camera_to_world: the table must be z = 0 in meters, and the camera's z points forward."


@dataclass(frozen=True)
class Stand:
    """Tilt and height of a plane in the world."""

    tilt: float
    """Angle of its normal with up, degrees."""
    off: float
    """Height of its points above z = 0 along up, m."""

    def near(self, height: float) -> bool:
        """True where it is z = 0 after a change that explains a finding; `height` is the camera's above the plane, m."""
        return self.tilt < EXPLAINED[0] and abs(self.off) < max(EXPLAINED[1], EXPLAINED[1] * height)


def stand(plane: Plane, pose: np.ndarray, up: float, factor: float = 1.0) -> Stand:
    """Tilt and height of `plane` in the world by `pose`, camera to world [4, 4], m, if depth is multiplied by `factor`."""
    cosine = up * (pose[:3, :3] @ plane.normal)[2]
    z = (factor * plane.points.mean(axis=0)) @ pose[2, :3] + pose[2, 3]
    return Stand(float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))), float(up * z))


def variants(pose: np.ndarray) -> dict[str, np.ndarray]:
    """Kinds of matrix that a pose [4, 4] may be instead, with the next move, and the pose that is meant then."""
    return {
        "a world-to-camera matrix. Invert it": rigid_inverse(pose),
        "a matrix for OpenGL's axes (y up, z backward). Change the signs of its second and third column": pose @ OPENGL,
        "a world-to-camera matrix for OpenGL's axes (y up, z backward). Invert it, then change the signs of its second and third "
        "column": rigid_inverse(pose) @ OPENGL,
        f"a pose in a world with y up. Multiply it from the left by {Y_UP.astype(int).tolist()}": Y_UP @ pose,
        "a pose in a world with y up, for OpenGL's axes. Change the signs of its second and third column, then multiply it from "
        f"the left by {Y_UP.astype(int).tolist()}": Y_UP @ pose @ OPENGL,
    }


def other_side(up: str) -> str:
    """The opposite of `up`."""
    return "-z" if up == "+z" else "+z"


@dataclass(frozen=True, eq=False)
class TableSeen:
    """The planes that a camera with depth sees."""

    name: str
    planes: Sequence[Plane]
    pose: np.ndarray
    """Camera to world [4, 4], m."""
    up: str
    unit: float | None
    """m per count; None where depth is in meters by its type."""

    @cached_property
    def candidates(self) -> list[Plane]:
        """Planes that are large enough."""
        return [plane for plane in self.planes if plane.share >= SMALLEST_PLANE]

    @cached_property
    def table(self) -> tuple[Plane, Stand]:
        """The plane that stands best, and how."""
        stands = [(plane, stand(plane, self.pose, up_sign(self.up))) for plane in self.candidates]
        return min(stands, key=lambda one: one[1].tilt / TILT + abs(one[1].off) / TABLE_OFF)

    @cached_property
    def right(self) -> bool:
        """True where it is level and at z = 0."""
        return bool(self.candidates) and self.table[1].tilt < TILT and abs(self.table[1].off) < TABLE_OFF

    @cached_property
    def explained(self) -> dict[str, Any] | None:
        """The one change that puts the table at z = 0; None if there is none, or none is needed."""
        found = (one for plane in self.candidates for one in [self._explained(plane)] if one)
        return None if self.right else next(found, None)

    def _explained(self, plane: Plane) -> dict[str, Any] | None:
        sign, pose, other = up_sign(self.up), self.pose, other_side(self.up)
        flipped = stand(plane, pose, -sign)
        if flipped.tilt < TILTED and abs(flipped.off) < FAR_OFF:
            rule = f"must be the side of the table on which the cameras are: {other}"
            below = f"{self.up}, by which camera {self.name} is {abs(1e3 * sign * pose[2, 3]):.0f} mm below the table"
            return {"key": "up", "rule": rule, "received": below}
        for factor in WRONG_UNITS:
            if stand(plane, pose, sign, 1 / factor).near(pose[2, 3]):
                rule, key = f"the table must be as far from camera {self.name} as its pose says", f"depth of camera {self.name}"
                if self.unit is None:
                    return {"key": key, "rule": rule, "received": f"{factor:g} times"}
                text = f"{self.unit:g}, which makes it {factor:g} times as far. Plausible would be {self.unit / factor:g}"
                return {"key": "depth_unit", "rule": rule, "received": text}
        for what, variant in variants(pose).items():
            for direction in (sign, -sign):
                if stand(plane, variant, direction).near(plane.height):
                    rule = "camera-to-world is required (x right, y down, z forward): with it the table is z = 0"
                    also = "" if direction == sign else f", and set up to {other}"
                    key = f"cameras.{self.name}.camera_to_world"
                    return {"key": key, "rule": rule, "received": f"what looks like {what}{also}"}
        return None

    @property
    def text(self) -> str:
        """Its place, in words."""
        table, standing = self.table
        side = "above" if standing.off > 0 else "below"
        return f"{1e3 * abs(standing.off):.0f} mm {side} z = 0 and tilted by {standing.tilt:.1f} degrees; plane: {table.text()}"


def unexplained(seen: TableSeen) -> dict[str, Any] | None:
    """Height of a table that is elsewhere, m, and nothing explains it."""
    if not seen.candidates or seen.right or seen.explained:
        return None
    standing = seen.table[1]
    if standing.tilt > TILTED or abs(standing.off) > FAR_OFF:
        remedy = "Calibrate again, or let `neuspring make-capture --level` put it there"
        return {"value": standing.off, "level": "error", "must": "must", "next": remedy}
    return {"value": standing.off, "must": "should", "next": "`neuspring make-capture --level` puts the table at z = 0"}


@dataclass(frozen=True, eq=False)
class CameraAlone:
    """A camera without depth; the table is z = 0."""

    camera: Camera
    up: str
    source: str = ""
    """The source of its pose."""

    @property
    def key(self) -> str:
        """The key of its pose."""
        return f"cameras.{self.camera.name}.camera_to_world{f' ({self.source})' if self.source else ''}"

    @property
    def height(self) -> float:
        """Height of the camera above z = 0, m."""
        return abs(float(self.camera.camera_to_world[2, 3]))

    @cached_property
    def away(self) -> float:
        """Distance, m, of the table in the center of the image; NaN where it is not there."""
        center = np.array([[(self.camera.width - 1) / 2, (self.camera.height - 1) / 2]])
        return float(np.linalg.norm(on_table(self.camera, center)[0] - self.camera.camera_to_world[:3, 3]))

    @cached_property
    def wrong(self) -> tuple[str, str, bool] | None:
        """The fault of the view of the table, the value, and whether a camera may be so all the same; None: nothing."""
        sign, height = up_sign(self.up), float(self.camera.camera_to_world[2, 3])
        if height * sign <= 0:
            rule = "the camera must be above the table z = 0, on the side of it that is up"
            return rule, f"its center at z = {height:.3f} m, and up {self.up}", False
        if not NEAR <= self.away <= FAR:
            rule = f"the table z = 0 must be {NEAR:g} to {FAR:g} m away in the center of the image"
            return rule, f"{self.away:.3g} m" if np.isfinite(self.away) else "a view past it", False
        x, y, _ = sign * self.camera.camera_to_world[2, :3]
        roll = float(np.degrees(np.arctan2(abs(x), -y)))
        if roll > ROLL and np.hypot(x, y) > np.sin(np.radians(STRAIGHT_ABOVE)):
            return "up should point up in the image", f"a camera that is turned by {roll:.0f} degrees about its axis", True
        return None


def on_table(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """World points [n, 3], m, at which the rays of pixels (x, y) [n, 2] meet z = 0; NaN for rays that never do."""
    eye = camera.camera_to_world[:3, 3]
    rays = camera.lift(pixels.astype(float), np.ones(len(pixels))) - eye
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -eye[2] / rays[:, 2]
    return np.asarray(eye + np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)[:, None] * rays)


def object_on_table(camera: Camera, mask: np.ndarray) -> np.ndarray:
    """Places at which the object's pixels of a mask [H, W] meet the table [n, 3], m; NaN beyond the horizon."""
    y, x = np.nonzero(mask == OBJECT)
    return on_table(camera, np.stack([x, y], axis=1))


def wrong_view(view: CameraAlone) -> dict[str, Any] | None:
    """The fault of the view of the table, and the poses that would be right."""
    if view.wrong is None:
        return None
    rule, received, possible = view.wrong
    alike = [
        f"{what}{'' if up == view.up else ', and set up to ' + up}"
        for what, pose in variants(view.camera.camera_to_world).items()
        for up in (view.up, other_side(view.up))
        if not replace(view, camera=replace(view.camera, camera_to_world=pose), up=up).wrong
    ]
    meant = f"This looks like {'. Or like '.join(alike)}" if alike else POSE.rstrip(".")
    told = {"rule": rule, "received": f"{received}. {meant}"}
    return told | {"level": "warning", "also": ". If the camera is mounted so, go on"} if possible else told | {"also": ""}


def beyond_horizon(camera: Camera, mask: np.ndarray) -> dict[str, Any] | None:
    """Pixels of the object that look past the table."""
    own = object_on_table(camera, mask)
    beyond = int(np.isnan(own[:, 0]).sum())
    return {"value": beyond, "count": len(own)} if beyond else None


# fmt: off
checks = (
    Check("no table seen", "table", lambda seen: None if seen.candidates else {}, None, "note",
          "camera {0.name} sees no plane in depth: z = 0 and up are not checked against the table", title=""),
    Check("table", "table", lambda seen: seen.table[1].off if seen.right else None, None, "note",
          "camera {0.name}: the table is {0.text}", title=""),
    Check("high camera", "table", lambda seen: seen.table[0].height if seen.right else None, (0, HIGHEST_CAMERA), "warning",
          "cameras.{0.name}.camera_to_world: a camera should be at most {high:g} m above the table; received {value:.2f} m. "
          "Check depth_unit: ten times too large makes all of the scene so", title=""),
    Check("table explained", "table", lambda seen: seen.explained, None, "error", "{rule}; received {received}", title="{key}"),
    Check("table elsewhere", "table", unexplained, None, "warning",
          "the table that the camera sees {must} be z = 0; received {0.text}. {next}", title="cameras.{0.name}.camera_to_world"),
    Check("view of the table", "camera alone", wrong_view, None, "error", "{0.key}: {rule}; received {received}{also}", title=""),
    Check("distance of the table", "camera alone", lambda view: None if view.wrong else view.away, None, "note",
          "camera {0.camera.name}: color alone: the table is z = 0 as given, {value:.2f} m away in the center of the image, "
          "{0.height:.2f} m below the camera", title=""),
    Check("high camera", "camera alone", lambda view: None if view.wrong else view.height, (0, HIGHEST_CAMERA), "warning",
          "{0.key}: a camera should be at most {high:g} m above the table; received {value:.2f} m. Is camera_to_world in meters?",
          title=""),
    Check("beyond the horizon", "horizon", beyond_horizon, None, "error",
          "camera {0.name}: every pixel of the object in frame 0 must look at the table z = 0; received {value} of {count} pixels "
          "at or above its horizon. " + POSE + " Or correct the mask",
          title=""),
)
