"""Intrinsics and poses from JSON files of other programs, the removal of distortion, and poses by a ChArUco board that lies still.

Intrinsics: an object with fx, fy, cx, cy (also ppx, ppy) or K [3, 3] (also intrinsics, camera_matrix; intrinsic_matrix has 9
numbers, column by column, as Open3D writes them), and optionally width, height, distortion (also coeffs). For several cameras: a
list of such objects in the order of the cameras, or an object of them by name, also under the key cameras. One alone is for all.

Poses: {"camera_to_world": ...} or {"world_to_camera": ...}, [4, 4] or [3, 4] in meters per camera: a list, or an object by name.

A board's coordinates become the world: x along its rows, z up out of its printed side, the origin at its corner. A board that lies
on the table puts the table at z = minus its thickness.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.files import load_json
from neuspring.core.findings import refuse
from neuspring.data.capture import TEXT_TOLERANCE, intrinsics_findings, pose_findings
from neuspring.data.intake.feeds import Lens

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
        refuse(pose_findings(path, key, matrix, TEXT_TOLERANCE))
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
    refuse(intrinsics_findings(where, f"intrinsics of camera {name}", lens.matrix, size))
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


FEWEST = 6
"""Corners from which a pose is taken."""
MOST_ERROR = 1.5
"""Pixels, rms. Beyond it the board moved, or it is another one, or the intrinsics are wrong."""
SYNTAX = re.compile(r"(\d+)x(\d+):([0-9.]+):([0-9.]+):(\w+)")


@dataclass(frozen=True)
class Board:
    """A ChArUco board."""

    across: int
    """Squares along x."""
    down: int
    """Squares along y."""
    square: float
    """Side of a square, m."""
    marker: float
    """Side of a marker, m."""
    dictionary: str
    """Of OpenCV, as DICT_5X5_100."""

    @classmethod
    def of(cls, text: str) -> Board:
        """From `5x7:0.04:0.03:DICT_5X5_100`. Raises InputError."""
        match = SYNTAX.fullmatch(text)
        form = "SQUARES_XxSQUARES_Y:SQUARE_M:MARKER_M:DICTIONARY is required, like 5x7:0.04:0.03:DICT_5X5_100"
        if not match:
            raise InputError("--board", form, repr(text))
        board = cls(int(match[1]), int(match[2]), float(match[3]), float(match[4]), match[5])
        if not (0.002 < board.marker < board.square < 0.5) or min(board.across, board.down) < 3:
            rule = "squares and markers in meters are required, markers smaller than squares, at least 3 x 3 squares"
            raise InputError("--board", rule, repr(text))
        if not board.dictionary.startswith("DICT_") or not hasattr(cv2.aruco, board.dictionary):
            known = " ".join(sorted(name for name in dir(cv2.aruco) if re.fullmatch(r"DICT_\dX\d_\d+", name)))
            raise InputError("--board", f"the dictionary must be one of OpenCV's: {known}", board.dictionary)
        return board

    def opencv(self, legacy: bool = False) -> cv2.aruco.CharucoBoard:
        """OpenCV's board. Boards with an even number of rows that were printed before OpenCV 4.6 are `legacy`."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard((self.across, self.down), self.square, self.marker, dictionary)
        board.setLegacyPattern(legacy)
        return board


@dataclass(frozen=True, eq=False)
class Sighting:
    """One camera's pose by the board."""

    camera_to_world: np.ndarray
    """[4, 4], m."""
    corners: int
    error: float
    """Root mean square reprojection error, pixels."""
    pixels: np.ndarray
    """Where the corners were seen (x, y) [n, 2]."""
    depths: np.ndarray
    """Their depth along the optical axis by the pose [n], m."""


def sight(where: object, board: Board, images: Sequence[np.ndarray], intrinsics: np.ndarray) -> Sighting:
    """The pose of a camera from images [H, W, 3] RGB without distortion, in all of which the board lies still.

    Raises InputError where too few corners are seen, or they do not fit.
    """
    found = max((_corners(board, images, legacy) for legacy in (False, True)), key=lambda pair: len(pair[1]))
    points, pixels = found
    if len(pixels) < FEWEST:
        rule = f"at least {FEWEST} corners of the {board.across} x {board.down} board ({board.dictionary}) must be seen"
        remedy = "Check --board (squares across and down, dictionary), light, and that the board fills a part of the image."
        raise InputError(where, rule, f"{len(pixels)} in {len(images)} images", remedy)
    _, rotation, translation = cv2.solvePnP(points, pixels, intrinsics, None, flags=cv2.SOLVEPNP_IPPE)
    rotation, translation = cv2.solvePnPRefineLM(points, pixels, intrinsics, None, rotation, translation)
    projected = cv2.projectPoints(points, rotation, translation, intrinsics, None)[0].reshape(-1, 2)
    error = float(np.sqrt(np.mean(np.sum((projected - pixels) ** 2, axis=1))))
    if error > MOST_ERROR:
        remedy = "The board must lie still in all images of --board-images, and the intrinsics must be those of these images."
        raise InputError(where, f"corners of the board must fit within {MOST_ERROR:g} pixels rms", f"{error:.2f} pixels", remedy)
    board_to_camera = np.eye(4)
    board_to_camera[:3, :3], board_to_camera[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
    depths = (points @ board_to_camera[:3, :3].T + board_to_camera[:3, 3])[:, 2]
    # OpenCV's board has y down and z into the paper.
    to_world = np.diag([1.0, -1.0, -1.0, 1.0])
    return Sighting(to_world @ rigid_inverse(board_to_camera), len(pixels), error, pixels, depths)


def depth_ratio(sighting: Sighting, depth: np.ndarray) -> float | None:
    """Median of measured depth over that by the pose, at the corners in a depth image [H, W], m; None where little is measured."""
    x, y = np.clip(np.round(sighting.pixels).astype(int).T, 0, np.array(depth.shape[::-1])[:, None] - 1)
    measured = depth[y, x]
    valid = measured > 0
    return float(np.median(measured[valid] / sighting.depths[valid])) if valid.sum() >= FEWEST else None


def _corners(board: Board, images: Sequence[np.ndarray], legacy: bool) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 3], m, on the board and pixels [n, 2], of all images together."""
    pattern = board.opencv(legacy)
    detector = cv2.aruco.CharucoDetector(pattern)
    points, pixels = [np.zeros((0, 3), np.float32)], [np.zeros((0, 2), np.float32)]
    for image in images:
        corners, ids, _, _ = detector.detectBoard(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY))
        if corners is not None and ids is not None and len(ids):
            points.append(np.asarray(pattern.getChessboardCorners(), np.float32)[np.ravel(ids)])
            pixels.append(corners.reshape(-1, 2).astype(np.float32))
    return np.concatenate(points), np.concatenate(pixels)
