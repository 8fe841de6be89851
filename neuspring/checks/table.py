"""The table, which must be z = 0: how a plane stands in the world, and where pixels meet it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from neuspring.core.checks import Check
from neuspring.data.camera import Camera, Plane
from neuspring.data.capture import OBJECT

SMALLEST_PLANE = 0.08
"""Share of the pixels with depth from which a plane may be the table."""
TILT, TABLE_OFF = 2.0, 0.01
"""Degrees and m within which the table is level and at z = 0. Ground contact of the simulation is at z = 0."""
TILTED, FAR_OFF = 15.0, 0.15
"""Degrees and m beyond which the table is elsewhere, and no twin can rest on it."""
EXPLAINED = (4.0, 0.03)
"""Degrees and m within which the table lies after a change that explains a finding; m also as a part of the camera's height."""
POSE = "Look at camera_to_world: the table must be z = 0 in meters, and the camera's z points forward."


@dataclass(frozen=True)
class Stand:
    """Tilt and height of a plane in the world."""

    tilt: float
    """Angle of its normal with up, degrees."""
    off: float
    """Height of its points above z = 0 along up, m."""

    def away(self, height: float) -> float:
        """Its distance from z = 0, 1: as far as EXPLAINED; `height` is the camera's above the plane, m."""
        return max(self.tilt / EXPLAINED[0], abs(self.off) / max(EXPLAINED[1], EXPLAINED[1] * height))


def stand(plane: Plane, pose: np.ndarray, up: float) -> Stand:
    """Tilt and height of `plane` in the world by `pose`, camera to world [4, 4], m."""
    cosine = up * (pose[:3, :3] @ plane.normal)[2]
    z = plane.points.mean(axis=0) @ pose[2, :3] + pose[2, 3]
    return Stand(float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))), float(up * z))


def other_side(up: str) -> str:
    """The opposite of `up`."""
    return "-z" if up == "+z" else "+z"


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


def beyond_horizon(camera: Camera, mask: np.ndarray) -> dict[str, Any] | None:
    """Pixels of the object that look past the table."""
    own = object_on_table(camera, mask)
    beyond = int(np.isnan(own[:, 0]).sum())
    return {"value": beyond, "count": len(own)} if beyond else None


# fmt: off
checks = (
    Check("beyond the horizon", "horizon", beyond_horizon, None, "error",
          "camera {0.name}: every pixel of the object in frame 0 must look at the table z = 0; received {value} of {count} pixels "
          "at or above its horizon. " + POSE + " Or correct the mask",
          title=""),
)
