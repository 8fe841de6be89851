"""Intrinsics and poses from JSON files of other programs, and the removal of distortion.

Intrinsics: an object with fx, fy, cx, cy (also ppx, ppy) or K [3, 3] (also intrinsics, camera_matrix; intrinsic_matrix has 9
numbers, column by column, as Open3D writes them), and optionally width, height, distortion (also coeffs). For several cameras: a
list of such objects in the order of the cameras, or an object of them by name, also under the key cameras. One alone is for all.

Poses: {"camera_to_world": ...} or {"world_to_camera": ...}, [4, 4] or [3, 4] in meters per camera: a list, or an object by name.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.calibration import TEXT_TOLERANCE, intrinsics_departures, pose_departures
from neuspring.data.departure import refuse
from neuspring.data.intake.views import Lens
from neuspring.data.json_file import load_json

MATRIX = ("K", "intrinsics", "camera_matrix")
OPEN3D = "intrinsic_matrix"
DISTORTION = ("distortion", "coeffs", "dist_coeffs")
COUNTS = (0, 4, 5, 8, 12, 14)
"""Coefficients of OpenCV's models."""
NARROWEST, WIDEST = 10.0, 150.0
"""Degrees. A field of view outside this range is a wrong focal length."""
FARTHEST = 20.0
"""m. A camera farther from the world's origin has its position in another unit."""
DIRECTIONS = ("camera_to_world", "world_to_camera")


def read_lenses(path: Path, names: Sequence[str]) -> dict[str, Lens]:
    """Intrinsics of each camera. Raises InputError naming the file and the key."""
    content = load_json(path)
    if isinstance(content, dict) and "cameras" in content:
        content = content["cameras"]
    if isinstance(content, dict) and _describes(content):
        content = dict.fromkeys(names, content)
    return {name: _lens(path, name, entry) for name, entry in _by_camera(path, "intrinsics", content, names).items()}


def read_poses(path: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Camera to world [4, 4], m, of each camera. Raises InputError naming the file and the key."""
    content = load_json(path)
    keys = [key for key in DIRECTIONS if isinstance(content, dict) and key in content]
    if len(keys) != 1:
        rule = f"exactly one of the keys {' and '.join(DIRECTIONS)} is required: it says what the matrices do"
        raise InputError(path, rule, keys or "neither")
    poses = {}
    for name, listed in _by_camera(path, keys[0], content[keys[0]], names).items():
        key = f"{keys[0]}, camera {name}"
        matrix = _numbers(path, key, listed, ((4, 4), (3, 4)))
        matrix = np.vstack([matrix[:3], [0.0, 0.0, 0.0, 1.0]]) if len(matrix) == 3 else matrix
        refuse(pose_departures(path, key, matrix, TEXT_TOLERANCE))
        poses[name] = matrix if keys[0] == DIRECTIONS[0] else rigid_inverse(matrix)
        distance = float(np.linalg.norm(matrix[:3, 3]))
        if distance > FARTHEST:
            remedy = "Divide the last columns by 1000 if they are millimeters, by 100 if they are centimeters."
            raise InputError(path, f"{key}: the position must be in meters", f"one {distance:.4g} m from the origin", remedy)
    return poses


def rigid_inverse(pose: np.ndarray) -> np.ndarray:
    """The inverse of a rigid motion [4, 4]."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def require_lens(where: Path, name: str, lens: Lens, size: tuple[int, int]) -> None:
    """Raise InputError unless intrinsics fit images of `size` (width, height)."""
    if lens.size is not None and lens.size != size:
        factor = size[0] / lens.size[0]
        remedy = f"Scale fx and cx by {factor:.4g}, fy and cy by {size[1] / lens.size[1]:.4g}, if the images were only resized."
        rule = f"camera {name}: width and height must be those of its images, {size[0]} x {size[1]}"
        raise InputError(where, rule, f"{lens.size[0]} x {lens.size[1]}", remedy)
    refuse(intrinsics_departures(where, f"intrinsics of camera {name}", lens.matrix, size))
    for side, pixels, focal in zip(("width", "height"), size, np.diag(lens.matrix)[:2], strict=True):
        view = float(np.degrees(2 * np.arctan(0.5 * pixels / focal)))
        if not NARROWEST < view < WIDEST:
            rule = f"camera {name}: a field of view between {NARROWEST:g} and {WIDEST:g} degrees is required"
            received = f"{view:.1f} degrees across the {side} of {pixels} pixels at a focal length of {focal:.4g} pixels"
            raise InputError(where, rule, received, "Focal lengths are in pixels of these images, not in millimeters.")


class Straightener:
    """Removes the distortion of one camera's images; K stays."""

    def __init__(self, lens: Lens, size: tuple[int, int]) -> None:
        self.maps: tuple[np.ndarray, np.ndarray] | None = None
        if lens.distortion.any():
            k = lens.matrix
            self.maps = cv2.initUndistortRectifyMap(k, lens.distortion, None, k, size, cv2.CV_32FC1)

    def color(self, image: np.ndarray) -> np.ndarray:
        """Interpolated."""
        return image if self.maps is None else cv2.remap(np.ascontiguousarray(image), *self.maps, cv2.INTER_LINEAR)

    def depth(self, image: np.ndarray) -> np.ndarray:
        """The nearest value: a mean of two depths is a depth where nothing is."""
        return image if self.maps is None else cv2.remap(np.ascontiguousarray(image), *self.maps, cv2.INTER_NEAREST)


def _describes(entry: dict[str, Any]) -> bool:
    return any(key in entry for key in ("fx", OPEN3D)) or any(isinstance(entry.get(key), list) for key in MATRIX)


def _by_camera(path: Path, key: str, content: Any, names: Sequence[str]) -> dict[str, Any]:
    if isinstance(content, list) and len(content) == len(names):
        return dict(zip(names, content, strict=True))
    if isinstance(content, dict) and all(name in content for name in names):
        return {name: content[name] for name in names}
    received = f"{type(content).__name__} of {len(content)}" if isinstance(content, list) else sorted(content)
    rule = f"{key}: a list for {len(names)} cameras in their order, or an object with the keys {' '.join(names)}"
    raise InputError(path, rule, received if isinstance(content, (dict, list)) else type(content).__name__)


def _lens(path: Path, name: str, entry: Any) -> Lens:
    where = f"intrinsics of camera {name}"
    if not isinstance(entry, dict) or not _describes(entry):
        rule = f"{where}: fx, fy, cx, cy are required, or K [3, 3]"
        raise InputError(path, rule, sorted(entry) if isinstance(entry, dict) else type(entry).__name__)
    if "fx" in entry:
        values = [entry.get("fx"), entry.get("fy"), entry.get("cx", entry.get("ppx")), entry.get("cy", entry.get("ppy"))]
        fx, fy, cx, cy = _numbers(path, f"{where}: fx, fy, cx, cy", values, ((4,),))
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    elif OPEN3D in entry:
        matrix = _numbers(path, f"{where}: {OPEN3D}", entry[OPEN3D], ((9,),)).reshape(3, 3).T
    else:
        key = next(key for key in MATRIX if key in entry)
        matrix = _numbers(path, f"{where}: {key}", entry[key], ((3, 3),))
    listed: Any = next((entry[key] for key in DISTORTION if key in entry), [])
    distortion = _numbers(path, f"{where}: distortion", listed, tuple((count,) for count in COUNTS))
    size = (entry["width"], entry["height"]) if type(entry.get("width")) is type(entry.get("height")) is int else None
    return Lens(matrix=matrix, distortion=distortion, size=size)


def _numbers(path: Path, key: str, listed: Any, shapes: Sequence[tuple[int, ...]]) -> np.ndarray:
    try:
        array = np.array(listed, dtype=float)
    except (TypeError, ValueError):
        array = np.full(99, np.nan)
    if array.shape not in shapes or not np.isfinite(array).all():
        wanted = " or ".join(" x ".join(map(str, shape)) for shape in shapes)
        raise InputError(path, f"{key}: {wanted} finite numbers are required", str(listed)[:80])
    return array
