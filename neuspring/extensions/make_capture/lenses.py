"""Intrinsics against the images, the removal of distortion, and poses by a ChArUco board that lies still.

Distortion: with ideal (x, y) = ((u - cx) / fx, (v - cy) / fy) and P the polynomial of OpenCV's coefficients k1, k2, p1, p2, k3, ...
`opencv` shows (x, y) at P(x, y); `distorted_to_ideal` shows at (x, y) what belongs at P(x, y); `fisheye` is OpenCV's, of 4
coefficients of the angle. librealsense says inverse_brown_conrady. Its documentation means distorted_to_ideal; its functions, and
with them aligned depth, apply the coefficients as opencv. So nothing is taken for granted: the file must say which.

A board's coordinates become the world: x along its rows, z up out of its printed side, the origin at its corner. A board that lies
on the table puts the table at z = minus its thickness.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from neuspring.checks.rig import OFF_CENTER
from neuspring.core.errors import InputError
from neuspring.core.findings import refuse
from neuspring.core.geometry import rigid_inverse
from neuspring.data.camera import Lens
from neuspring.data.capture import intrinsics_findings

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


def require_lens(where: Path, name: str, lens: Lens, size: tuple[int, int]) -> None:
    """Raise InputError unless intrinsics fit images of `size` (width, height)."""
    if lens.size is not None and lens.size != size:
        remedy = "If the images were only resized since: --take lens_resized."
        if np.abs(lens.matrix[:2, 2] / size - 0.5).max() < OFF_CENTER:
            remedy = "(cx, cy) is in the middle of these images: if fx, fy, cx, cy are theirs, correct the size in the file."
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
    points, pixels = max((_corners(board, images, legacy) for legacy in (False, True)), key=lambda pair: len(pair[1]))
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
    return Sighting(to_world @ rigid_inverse(board_to_camera), error, pixels, depths)


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
