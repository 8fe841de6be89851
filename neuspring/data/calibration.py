"""The rules for calibrated cameras, in capture.json and in PhysTwin's metadata.json and calibrate.pkl."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from neuspring.data.departure import Departure, broken, unusual

TEXT_TOLERANCE = 1e-4
"""Allowed departure from R^T R = 1 in JSON, where matrices may have five digits."""
BINARY_TOLERANCE = 1e-5
"""Allowed departure from R^T R = 1 in a pickle of float64 products of OpenCV rotations."""


def intrinsics_departures(file: Path, key: str, matrix: np.ndarray, size: tuple[int, int] | None) -> list[Departure]:
    """K [3, 3], pixels: its form, and (cx, cy) within the image of `size` (width, height), where that is known."""
    fixed = matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]]
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0 and np.array_equal(fixed, [0, 0, 0, 0, 1])):
        return [broken(file, key, "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0 is required", matrix.tolist())]
    if size is not None and not (0 <= matrix[0, 2] < size[0] and 0 <= matrix[1, 2] < size[1]):
        return [broken(file, key, f"(cx, cy) must lie in the {size[0]} x {size[1]} image", matrix.tolist())]
    return []


def pose_departures(file: Path, key: str, pose: np.ndarray, tolerance: float) -> list[Departure]:
    """Camera to world [4, 4], m: a rotation and a translation."""
    departures = []
    rotation = pose[:3, :3]
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if not error <= tolerance or np.linalg.det(rotation) < 0 or not np.isfinite(pose).all():
        rule = f"the upper left 3 x 3 block must be a rotation (rigid: orthonormal, right-handed) within {tolerance:g}"
        departures.append(broken(file, key, rule, f"a deviation of {error:.3g} from R^T R = 1, or a mirror image"))
    if not np.array_equal(pose[3], [0, 0, 0, 1]):
        departures.append(broken(file, key, "the last row must be [0, 0, 0, 1]", pose[3].tolist()))
    return departures


def metadata_departures(file: Path, metadata: dict[str, Any], cameras: int | None = None) -> list[Departure]:
    """Image size and intrinsics of metadata.json. `cameras` is the required number of cameras; None allows any but zero."""
    departures = []
    size: Any = metadata.get("WH")
    has_size = isinstance(size, list) and len(size) == 2 and all(type(value) is int and value > 0 for value in size)
    if not has_size:
        departures.append(broken(file, "WH", "two positive whole numbers [width, height] are required", size))
    try:
        intrinsics = np.asarray(metadata.get("intrinsics"), dtype=np.float64)
    except (TypeError, ValueError):
        intrinsics = np.zeros(0)
    count = cameras or max(len(intrinsics) if intrinsics.ndim else 0, 1)
    if intrinsics.shape != (count, 3, 3) or not np.isfinite(intrinsics).all():
        rule = f"{cameras or 'one or more'} finite 3 x 3 matrices are required"
        return [*departures, broken(file, "intrinsics", rule, f"shape {intrinsics.shape}")]
    for index, matrix in enumerate(intrinsics):
        key = f"intrinsics, camera {index}"
        departures += intrinsics_departures(file, key, matrix, (size[0], size[1]) if has_size else None)
    return departures


def poses_departures(file: Path, poses: Any, cameras: int | None) -> list[Departure]:
    """The matrices of calibrate.pkl. `cameras` is the required number of cameras; None skips the comparison."""
    if not isinstance(poses, (list, tuple)) or (cameras is not None and len(poses) != cameras):
        received = f"{type(poses).__name__} of {len(poses)}" if isinstance(poses, (list, tuple)) else type(poses).__name__
        return [broken(file, "", f"a list of {cameras or ''} camera-to-world matrices is required".replace("  ", " "), received)]
    departures = []
    for index, pose in enumerate(poses):
        key = f"camera {index}"
        if not isinstance(pose, np.ndarray) or pose.shape != (4, 4) or pose.dtype.kind != "f":
            received = f"{pose.shape} {pose.dtype}" if isinstance(pose, np.ndarray) else type(pose).__name__
            departures.append(broken(file, key, "a (4, 4) floating point matrix is required", received))
            continue
        if pose.dtype != np.float64:
            departures.append(unusual(file, key, "the released dtype is float64", pose.dtype))
        departures += pose_departures(file, key, pose, BINARY_TOLERANCE)
    return departures
