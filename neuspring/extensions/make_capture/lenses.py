"""Intrinsics and poses from JSON files of other programs, the removal of distortion, and poses by a ChArUco board that lies still.

Intrinsics: an object with fx, fy, cx, cy or K [3, 3] (intrinsic_matrix has 9 numbers, column by column, as Open3D writes them), and
optionally width, height, distortion, model. `LENS_KEYS` has the spellings of other programs; another key that may be of the lens is
an error. For several cameras: a list of such objects in the order of the cameras, or an object of them by name, also under the key
cameras. One alone is for all.

Distortion: with ideal (x, y) = ((u - cx) / fx, (v - cy) / fy) and P the polynomial of OpenCV's coefficients k1, k2, p1, p2, k3, ...
`opencv` shows (x, y) at P(x, y); `distorted_to_ideal` shows at (x, y) what belongs at P(x, y); `fisheye` is OpenCV's, of 4
coefficients of the angle. librealsense says inverse_brown_conrady. Its documentation means distorted_to_ideal; its functions, and
with them aligned depth, apply the coefficients as opencv. So nothing is taken for granted: the file must say which.

Poses: {"camera_to_world": ...} or {"world_to_camera": ...}, [4, 4] or [3, 4] in meters per camera: a list, or an object by name.

A board's coordinates become the world: x along its rows, z up out of its printed side, the origin at its corner. A board that lies
on the table puts the table at z = minus its thickness.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.files import load_json
from neuspring.core.findings import refuse
from neuspring.core.geometry import rigid_inverse
from neuspring.data.camera import Lens
from neuspring.data.capture import TEXT_TOLERANCE, intrinsics_findings, pose_findings

OPEN3D = "intrinsic_matrix"
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "taux", "tauy")
"""In OpenCV's order."""
SPELLINGS = (
    "fx fl_x / fy fl_y / cx ppx / cy ppy / K intrinsics camera_matrix / width w image_width / height h image_height / model "
    "distortion_model / camera_model / distortion D dist coeffs dist_coeffs distortion_coeffs distortion_coefficients"
)
LENS_KEYS = {words.split()[0]: words.split() for words in (*SPELLINGS.split(" / "), OPEN3D, *COEFFICIENTS)}
"""Keys that are read, and their spellings: ours, and those of OpenCV, ROS, librealsense, Open3D, nerfstudio and Kalibr."""
SILENT = "R P rectification_matrix projection_matrix roi header frames applied_transform camera_name camera_angle_x camera_angle_y"
"""Keys beside them that say nothing about a lens, or the same once more."""
TELLING = re.compile(
    r"dist|coef|lens|model|skew|fish|radial|tang|focal|princip|camera|proj|^f[xy_]|^c[xy_]|^[a-z]_?\d+$", re.IGNORECASE
)
"""A key like this may be of the lens, as may one with several numbers."""
RATIONAL = ("rational_polynomial", "full_opencv")
"""Models of which k4 to k6 are OpenCV's. Other programs have other polynomials with these names."""
MODELS = {
    **dict.fromkeys(("opencv", "brown_conrady", "plumb_bob", "radtan", "pinhole", "simple_radial", "radial", *RATIONAL), "opencv"),
    **dict.fromkeys(("fisheye", "opencv_fisheye", "kannala_brandt4", "equidistant"), "fisheye"),
    "distorted_to_ideal": "distorted_to_ideal",
}
"""Names of models and what we call them."""
TWO_READINGS = "inverse_brown_conrady"
COEFFICIENT_COUNTS = {"opencv": (4, 5, 8, 12, 14), "distorted_to_ideal": (4, 5), "fisheye": (4,)}
"""Coefficients of a model."""
UNDISTORT_STEPS = 20
"""Iterations of the solution; each leaves a fifth of the error at the corner of a wide lens."""
NARROWEST, WIDEST = 10.0, 150.0
"""Degrees. A field of view outside this range is a wrong focal length."""
FARTHEST_CAMERA = 20.0
"""m. A camera farther from the world's origin has its position in another unit."""
POSE_KEYS = ("camera_to_world", "world_to_camera")


def read_lenses(path: Path, names: Sequence[str]) -> dict[str, Lens]:
    """Intrinsics of each camera. Raises InputError naming the file and the key."""
    content = load_json(path)
    if isinstance(content, dict) and not _describes(content):
        loose = [key for key, value in content.items() if not isinstance(value, dict) and key != "cameras" and TELLING.search(key)]
        if loose and ("cameras" in content or any(name in content for name in names)):
            raise InputError(path, "what describes a lens belongs into its camera's object", f"{loose[0]!r} beside the cameras")
        content = content.get("cameras", content)
    if isinstance(content, dict) and _describes(content):
        content = dict.fromkeys(names, content)
    return {name: _lens(path, name, entry) for name, entry in _by_camera(path, "intrinsics", content, names).items()}


def read_poses(path: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Camera to world [4, 4], m, of each camera. Raises InputError naming the file and the key."""
    content = load_json(path)
    keys = [key for key in POSE_KEYS if isinstance(content, dict) and key in content]
    if len(keys) != 1:
        rule = f"exactly one of the keys {' and '.join(POSE_KEYS)} is required: it says what the matrices do"
        raise InputError(path, rule, keys or "neither")
    poses = {}
    for name, listed in _by_camera(path, keys[0], content[keys[0]], names).items():
        key = f"{keys[0]}, camera {name}"
        matrix = _numbers(path, key, listed, ((4, 4), (3, 4)))
        matrix = np.vstack([matrix[:3], [0.0, 0.0, 0.0, 1.0]]) if len(matrix) == 3 else matrix
        refuse(pose_findings(path, key, matrix, TEXT_TOLERANCE))
        poses[name] = matrix if keys[0] == POSE_KEYS[0] else rigid_inverse(matrix)
        distance = float(np.linalg.norm(matrix[:3, 3]))
        if distance > FARTHEST_CAMERA:
            remedy = "Divide the last columns by 1000 if they are millimeters, by 100 if they are centimeters."
            raise InputError(path, f"{key}: the position must be in meters", f"one {distance:.4g} m from the origin", remedy)
    return poses


def require_lens(where: Path, name: str, lens: Lens, size: tuple[int, int]) -> None:
    """Raise InputError unless intrinsics fit images of `size` (width, height)."""
    if lens.size is not None and lens.size != size:
        remedy = "If the images were only resized since: --take lens_resized."
        rule = f"camera {name}: width and height must be those of its images, {size[0]} x {size[1]}"
        raise InputError(where, rule, f"{lens.size[0]} x {lens.size[1]}", remedy)
    refuse(intrinsics_findings(where, f"intrinsics of camera {name}", lens.matrix, size))
    if lens.distortion.any():
        _require_model(where, name, lens, size)
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
        k, coefficients = lens.matrix, lens.distortion
        model = MODELS.get(lens.model) if coefficients.any() else None
        if model == "opencv":
            self.maps = cv2.initUndistortRectifyMap(k, coefficients, None, k, size, cv2.CV_32FC1)
        elif model == "fisheye":
            self.maps = cv2.fisheye.initUndistortRectifyMap(k, coefficients, np.eye(3), k, size, cv2.CV_32FC1)
        elif model == "distorted_to_ideal":
            # What belongs at an ideal pixel is seen at the pixel from which P leads there: a fixed point.
            ideal = np.stack([(_grid(size)[side] - k[side, 2]) / k[side, side] for side in (0, 1)], axis=-1).reshape(-1, 2)
            seen, still = ideal.astype(float), np.zeros(3)
            for _ in range(UNDISTORT_STEPS):
                points = np.concatenate([seen, np.ones((len(seen), 1))], axis=1)
                seen = seen + ideal - cv2.projectPoints(points, still, still, np.eye(3), coefficients)[0].reshape(-1, 2)
            x, y = (seen * np.diag(k)[:2] + k[:2, 2]).T.reshape(2, size[1], size[0]).astype(np.float32)
            self.maps = (x, y)
        self.shown = _grid(size) if self.maps is None else np.stack(self.maps)
        """Places at which ideal pixels are seen, x and y [2, H, W]."""
        moved = np.hypot(*(self.shown - _grid(size)))
        self.most, self.mean = float(moved.max()), float(moved.mean())

    def text(self, name: str) -> str:
        """The distortion that was removed, in one line."""
        return f"distortion, camera {name}: removed, up to {self.most:.1f} pixels and {self.mean:.1f} on average"

    def color(self, image: np.ndarray) -> np.ndarray:
        """Interpolated."""
        return image if self.maps is None else cv2.remap(np.ascontiguousarray(image), *self.maps, cv2.INTER_LINEAR)

    def depth(self, image: np.ndarray) -> np.ndarray:
        """The nearest value: a mean of two depths is a depth where nothing is."""
        return image if self.maps is None else cv2.remap(np.ascontiguousarray(image), *self.maps, cv2.INTER_NEAREST)


def _grid(size: tuple[int, int]) -> np.ndarray:
    """x and y of all pixels [2, H, W]."""
    return np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1]))).astype(np.float32)


def _require_model(where: Path, name: str, lens: Lens, size: tuple[int, int]) -> None:
    """Raise InputError unless the distortion is of a model that we have."""
    rule = f"camera {name}: the model of the distortion must be one of {' '.join(MODELS)}"
    if lens.model == TWO_READINGS:
        one, two = (Straightener(replace(lens, model=model), size).shown for model in ("brown_conrady", "distorted_to_ideal"))
        apart = float(np.hypot(*(one - two)).max())
        rule = f"camera {name}: {TWO_READINGS} has two meanings, here up to {apart:.1f} pixels apart, and the file must say which"
        remedy = (
            'Write "model": "brown_conrady" if librealsense or its ROS driver aligned depth: they read it so. Write "model": '
            '"distorted_to_ideal" if the coefficients undistort, as its documentation says. A straight edge near the border of the '
            "image shows which is right."
        )
        raise InputError(where, rule, remedy=remedy)
    if lens.model not in MODELS:
        remedy = "Undistort the images with the camera's software, and give the intrinsics of the result without coefficients."
        raise InputError(where, rule, lens.model, remedy)
    counts = COEFFICIENT_COUNTS[MODELS[lens.model]]
    if len(lens.distortion) not in counts:
        wanted = " or ".join(map(str, counts))
        raise InputError(where, f"camera {name}: the model {lens.model} has {wanted} coefficients", len(lens.distortion))


def _spelled(entry: dict[str, Any], key: str) -> list[Any]:
    """The values of a key in all its spellings."""
    return [entry[word] for word in LENS_KEYS[key] if word in entry]


def _describes(entry: dict[str, Any]) -> bool:
    matrices = (value for value in _spelled(entry, "K") if isinstance(value, list) or (isinstance(value, dict) and "data" in value))
    return bool(_spelled(entry, "fx") or OPEN3D in entry) or any(True for _ in matrices)


def _unread(path: Path, where: str, entry: dict[str, Any]) -> tuple[str, ...]:
    """The keys that are not read. Raises InputError where one may be of the lens."""
    read = [word for words in LENS_KEYS.values() for word in words]
    unread = [key for key in entry if key not in read and key not in SILENT.split()]
    if telling := [key for key in unread if TELLING.search(key) or isinstance(entry[key], (list, dict))]:
        close = difflib.get_close_matches(telling[0], read, n=1)
        remedy = (f"Is {close[0]} meant? " if close else "") + "Remove it if it says nothing about the lens."
        raise InputError(path, f"{where}: the keys that are read are {' '.join(read)}", repr(telling[0]), remedy)
    return tuple(unread)


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
    unread = _unread(path, where, entry)
    for words in LENS_KEYS.values():
        if len(twice := [word for word in words if word in entry]) > 1:
            raise InputError(path, f"{where}: one spelling of a key is required", " and ".join(twice), "Remove the others.")
    said = {key: values[0] for key in LENS_KEYS if (values := _spelled(entry, key))}
    if "fx" in said:
        values = [said.get(key) for key in ("fx", "fy", "cx", "cy")]
        fx, fy, cx, cy = _numbers(path, f"{where}: fx, fy, cx, cy", values, ((4,),))
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    elif OPEN3D in said:
        matrix = _numbers(path, f"{where}: {OPEN3D}", said[OPEN3D], ((9,),)).reshape(3, 3).T
    else:
        matrix = _numbers(path, f"{where}: K", _plain(said["K"]), ((3, 3), (9,))).reshape(3, 3)
    named = [str(said[key]).rpartition(".")[2].lower() for key in ("model", "camera_model") if key in said]
    models = {word.removeprefix("rs2_distortion_") for word in named}
    models -= {"pinhole"} if len(models) > 1 else set()
    if len(models) > 1:
        raise InputError(path, f"{where}: one model is required", " and ".join(sorted(models)))
    model = models.pop() if models else "opencv"
    distortion = _coefficients(path, where, said, model)
    size = (said["width"], said["height"]) if type(said.get("width")) is type(said.get("height")) is int else None
    return Lens(matrix=matrix, distortion=distortion, model=model, size=size, unread=unread)


def _coefficients(path: Path, where: str, said: dict[str, Any], model: str) -> np.ndarray:
    """Coefficients of a list in OpenCV's order, or by name; none without any."""
    named = {key: said[key] for key in COEFFICIENTS if key in said}
    listed = _plain(said.get("distortion", []))
    if isinstance(listed, dict):
        if unknown := sorted(listed.keys() - set(COEFFICIENTS)):
            raise InputError(path, f"{where}: distortion: names {' '.join(COEFFICIENTS)} are required", unknown[0])
        named, listed = named | listed, []
    if not named:
        counts = sorted({0, *(count for counts in COEFFICIENT_COUNTS.values() for count in counts)})
        return _numbers(path, f"{where}: distortion", listed, tuple((count,) for count in counts))
    if np.size(listed):
        rule = f"{where}: coefficients are required in a list or by name, not both"
        raise InputError(path, rule, f"distortion and {next(iter(named))}")
    if MODELS.get(model) == "fisheye":
        order: tuple[str, ...] = ("k1", "k2", "k3", "k4")
    else:
        order = COEFFICIENTS[: next(count for count in COEFFICIENT_COUNTS["opencv"] if named.keys() <= set(COEFFICIENTS[:count]))]
        if any(named.get(key) for key in ("k4", "k5", "k6")) and model not in RATIONAL:
            rule = f"{where}: k4 to k6 differ between programs: the model must be {' or '.join(RATIONAL)}, OpenCV's"
            raise InputError(path, rule, model, "Or give OpenCV's coefficients as the list distortion.")
    return _numbers(path, f"{where}: {' '.join(order)}", [named.get(key, 0.0) for key in order], ((len(order),),))


def _plain(value: Any) -> Any:
    """The numbers of a matrix that OpenCV or ROS wrote with rows, cols and data; the inside of a list of one row or one column."""
    value = value["data"] if isinstance(value, dict) and "data" in value else value
    if isinstance(value, list) and value and all(isinstance(row, list) for row in value):
        return value[0] if len(value) == 1 else [row[0] for row in value] if {len(row) for row in value} == {1} else value
    return value


def _numbers(path: Path, key: str, listed: Any, shapes: Sequence[tuple[int, ...]]) -> np.ndarray:
    try:
        array = np.array(listed, dtype=float)
    except (TypeError, ValueError):
        array = np.full(99, np.nan)
    if array.shape not in shapes or not np.isfinite(array).all():
        wanted = " or ".join(" x ".join(map(str, shape)) for shape in shapes)
        raise InputError(path, f"{key}: {wanted} finite numbers are required", str(listed)[:80])
    return array


FEWEST_CORNERS = 6
"""Corners from which a pose is taken."""
MOST_ERROR = 1.5
"""Pixels, rms. Beyond it the board moved, or it is another one, or the intrinsics are wrong."""
BOARD_FORM = re.compile(r"(\d+)x(\d+):([0-9.]+):([0-9.]+):(\w+)")


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
    """Name by OpenCV, as DICT_5X5_100."""

    @classmethod
    def of(cls, text: str) -> Board:
        """From `5x7:0.04:0.03:DICT_5X5_100`. Raises InputError."""
        match = BOARD_FORM.fullmatch(text)
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
    """The place where the corners were seen (x, y) [n, 2]."""
    depths: np.ndarray
    """Their depth along the optical axis by the pose [n], m."""


def sight(where: object, board: Board, images: Sequence[np.ndarray], intrinsics: np.ndarray) -> Sighting:
    """The pose of a camera from images [H, W, 3] RGB without distortion, in all of which the board lies still.

    Raises InputError where too few corners are seen, or they do not fit.
    """
    found = max((_corners(board, images, legacy) for legacy in (False, True)), key=lambda pair: len(pair[1]))
    points, pixels = found
    if len(pixels) < FEWEST_CORNERS:
        rule = f"at least {FEWEST_CORNERS} corners of the {board.across} x {board.down} board ({board.dictionary}) must be seen"
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
    return float(np.median(measured[valid] / sighting.depths[valid])) if valid.sum() >= FEWEST_CORNERS else None


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
