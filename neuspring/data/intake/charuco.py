"""Poses of cameras from images of one ChArUco board that lies still, by OpenCV.

The board's coordinates become the world: x along its rows, z up out of its printed side, the origin at its corner. A board that
lies on the table puts the table at z = minus its thickness.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.intake.lenses import rigid_inverse

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
