"""Color alone against the world: the table is z = 0 as the camera's pose says, and what lies on it is measured there."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from neuspring.core.artifacts import up_sign
from neuspring.core.findings import Finding, finding
from neuspring.data.capture import OBJECT, Camera
from neuspring.data.departure import Departure, broken, note, unusual
from neuspring.data.intake.units import FAR, NEAR
from neuspring.data.plausible.table import HIGHEST
from neuspring.data.plausible.things import FEW, implausible

NAME = "size of the object"
POSE = "Look at camera_to_world: the table must be z = 0 in meters, and the camera's z points forward."


def on_table(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """World points [n, 3], m, at which the rays of pixels (x, y) [n, 2] meet z = 0; NaN for rays that never do."""
    eye = camera.camera_to_world[:3, 3]
    rays = camera.lift(pixels.astype(float), np.ones(len(pixels))) - eye
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -eye[2] / rays[:, 2]
    return np.asarray(eye + np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)[:, None] * rays)


def alone_departures(path: Path, camera: Camera, up: str) -> list[Departure]:
    """Departures of a camera that is not above the table z = 0, or does not look at it; else a note on how far it is."""
    where, height = f"cameras.{camera.name}.camera_to_world", float(camera.camera_to_world[2, 3])
    if height * up_sign(up) <= 0:
        rule = f"{where}: the camera must be above the table z = 0, on the side of it that is up"
        return [broken(path, "", rule, f"its center at z = {height:.3f} m, and up {up}. {POSE}")]
    center = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    away = float(np.linalg.norm(on_table(camera, center)[0] - camera.camera_to_world[:3, 3]))
    if not NEAR <= away <= FAR:
        rule = f"{where}: the table z = 0 must be {NEAR:g} to {FAR:g} m away in the center of the image"
        received = f"{away:.3g} m" if np.isfinite(away) else "a view past it"
        return [broken(path, "", rule, f"{received}. {POSE}")]
    text = f"the table is z = 0 as given, {away:.2f} m away in the center of the image"
    found = [note(path, f"camera {camera.name}: color alone: {text}, {abs(height):.2f} m below the camera")]
    if abs(height) > HIGHEST:
        rule = f"{where}: a camera should be at most {HIGHEST:g} m above the table"
        found.append(unusual(path, "", rule, f"{abs(height):.2f} m. Is camera_to_world in meters?"))
    return found


def horizon_departures(path: Path, camera: Camera, mask: np.ndarray) -> list[Departure]:
    """A departure of the object's mask [H, W] of frame 0 that reaches beyond the horizon, where no table is."""
    own = object_on_table(camera, mask)
    beyond = int(np.isnan(own[:, 0]).sum())
    if not beyond:
        return []
    rule = f"camera {camera.name}: every pixel of the object in frame 0 must look at the table z = 0"
    received = f"{beyond} of {len(own)} pixels at or above its horizon"
    return [broken(path, "", rule, f"{received}. {POSE} Or correct the mask")]


def size_findings(camera: Camera, mask: np.ndarray) -> list[Finding]:
    """The object's size where its mask [H, W] of frame 0 meets the table: a note, and a warning for what is no object's.

    The sides are those of the smallest rectangle around it. What rises above the table seems larger by its height.
    """
    own = object_on_table(camera, mask)
    own = own[np.isfinite(own[:, 0])]
    if len(own) < FEW:
        return []
    where = f"camera {camera.name}, object"
    sides = sorted(cv2.minAreaRect(own[:, :2].astype(np.float32))[1], reverse=True)
    text = " x ".join(f"{100 * side:.0f}" for side in sides)
    value = f"color alone: table z = 0 as given, object size on the table {text} cm"
    return [
        finding(NAME, "note", where, value, "by its mask of frame 0", "Is that what was filmed?"),
        *implausible(where, sides[0]),
    ]


def object_on_table(camera: Camera, mask: np.ndarray) -> np.ndarray:
    """Where the object's pixels of a mask [H, W] meet the table [n, 3], m; NaN beyond the horizon."""
    y, x = np.nonzero(mask == OBJECT)
    return on_table(camera, np.stack([x, y], axis=1))
