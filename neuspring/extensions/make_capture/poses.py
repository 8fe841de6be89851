"""Poses of the cameras: stated, measured with a ChArUco board, or measured with the table, which becomes z = 0.

The coordinates of a board become the world: x along its rows, z out of its printed side, the origin at its corner.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from neuspring.core.errors import InputError
from neuspring.core.findings import refuse
from neuspring.core.geometry import rigid_inverse
from neuspring.data.camera import ROLL, Lens, Plane
from neuspring.data.capture import TEXT_TOLERANCE, pose_findings
from neuspring.data.planes import cloud, planes
from neuspring.extensions.make_capture.formats import open_images
from neuspring.extensions.make_capture.rig import BoardEntry, StatedRig, Straightener, stated

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
TABLE_SHARE, ROUGH = 0.1, 0.02
"""Smallest fraction of the pixels with depth, and largest rms distance, m, of a plane that may be the table."""
FRONTAL = 78.0
"""Degrees. A plane that the camera sees at a steeper angle may be a wall, unless `table_at` states that it is the table."""
FEWEST_CORNERS, MOST_ERROR = 6, 1.5
"""Fewest corners of a board that give a pose, and their largest error, pixels rms."""


@dataclass(frozen=True, eq=False)
class SeenCamera:
    """A few undistorted frames of a camera."""

    name: str
    path: Path
    size: tuple[int, int]
    """(width, height)."""
    lens: Lens
    straight: Straightener
    colors: list[np.ndarray]
    """[H, W, 3] uint8 RGB."""
    depths: list[np.ndarray]
    """[H, W], m; empty for a camera without depth."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """Poses of the cameras."""

    poses: Mapping[str, np.ndarray]
    """Camera to world [4, 4], m."""
    up: str = "+z"
    how: str
    """Origin of the poses, as text."""
    motion: np.ndarray = field(default_factory=lambda: np.eye(4))
    """Rigid motion [4, 4] from the stated world to this one."""


def place(path: Path | None, rig: StatedRig, seen: Mapping[str, SeenCamera]) -> Placed:
    """Poses of all cameras as rig.json states. Raises InputError."""
    how, cameras = stated(path, "poses", rig.poses), dict(zip(seen, rig.cameras, strict=False))
    if how == "table":
        (name, view), *others = seen.items()
        if others or not view.depths:
            raise InputError(path or "--rig", "poses: table is for one camera with depth", f"{len(seen)} cameras", "State poses.")
        points = cloud(view.depths, view.lens.matrix)
        table = find_table(view.path, points, None if rig.table_at is None else _point(view, rig.table_at))
        return Placed(poses={name: pose_on(table, points, view)}, how=f"by the table: {table.text()}")
    if how == "board":
        board = stated(path, "board", rig.board)
        folders = {name: cameras[name].board_images if name in cameras else None for name in seen}
        base = path.parent if path else Path()
        found = {name: by_board(board, view, base / folder if (folder := folders[name]) else None) for name, view in seen.items()}
        errors = ", ".join(f"camera {name} {error:.2f} pixels rms" for name, (_, error) in found.items())
        return Placed(poses={name: pose for name, (pose, _) in found.items()}, how=f"by a ChArUco board: {errors}")
    axes, up, poses = stated(path, "axes", rig.axes), stated(path, "up", rig.up), dict[str, np.ndarray]()
    for name in seen:
        pose = np.array(stated(path, "pose", cameras[name].pose if name in cameras else None, name), dtype=float)
        refuse(pose_findings(path or Path(), f"cameras.{name}.pose", pose, TEXT_TOLERANCE))
        pose = rigid_inverse(pose) if how == "world_to_camera" else pose
        poses[name] = pose @ OPENGL if axes == "opengl" else pose
    motion = np.eye(4)
    if up == "table":
        tables = {name: find_table(view.path, cloud(view.depths, view.lens.matrix)) for name, view in seen.items()}
        motion = levelling(tables, poses)
    elif up[1] != "z":
        motion[:3, :3] = Rotation.align_vectors([[0, 0, 1]], [np.eye(3)["xyz".index(up[1])] * (1 if up[0] == "+" else -1)])[
            0
        ].as_matrix()
    side = up if up[1:] == "z" else "+z"
    return Placed(poses={name: motion @ pose for name, pose in poses.items()}, up=side, how=f"stated, {how}, {axes}", motion=motion)


def find_table(where: object, points: np.ndarray, at: np.ndarray | None = None) -> Plane:
    """The largest plane in points [n, 3], m, in camera coordinates, that may be the table.

    `at` [3] is a known point of the table. Raises InputError, with the reason for the largest plane, if none may be the table.
    """
    candidates = planes(points)
    if at is not None:
        candidates = sorted(candidates, key=lambda plane: abs(plane.above(at)))[:1]
    reasons = []
    for plane in candidates:
        roll = float(np.degrees(np.arctan2(abs(plane.normal[0]), -plane.normal[1])))
        if at is None and plane.elevation > FRONTAL:
            reasons.append(
                "it faces the camera: a wall, or a table seen from above; state a pixel of the table as table_at: [x, y]"
            )
        elif at is None and roll > ROLL:
            reasons.append(f"its normal leans {roll:.0f} degrees from the upward direction of the image: a wall or a ceiling")
        elif plane.share < TABLE_SHARE or plane.rms > ROUGH:
            reasons.append(f"a table has at least {TABLE_SHARE:.0%} of the pixels with depth and at most {1e3 * ROUGH:g} mm rms")
        else:
            return plane
    received = f"{candidates[0].text()}: {reasons[0]}" if candidates else "no plane in depth"
    raise InputError(where, "the table must be seen", received, "Record the table from above its edge, or state the poses.")


def pose_on(table: Plane, points: np.ndarray, view: SeenCamera) -> np.ndarray:
    """Camera-to-world pose [4, 4], m, of a camera that sees `table`: z along its normal, x to the right of the image.

    The origin is on the table, below the median of the points [n, 3] in the middle third of the image.
    """
    up = table.normal
    y = np.cross(up, [1.0, 0.0, 0.0])
    y /= np.linalg.norm(y)
    axes = np.stack([np.cross(y, up), y, up])
    rays = points[:, :2] / points[:, 2:]
    middle = points[(np.abs(rays) < np.array(view.size) / 6 / np.diag(view.lens.matrix)[:2]).all(axis=1)]
    target = np.median(middle if len(middle) else table.points, axis=0)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, -axes @ (target - table.above(target) * up)
    return pose


def levelling(tables: Mapping[str, Plane], poses: Mapping[str, np.ndarray]) -> np.ndarray:
    """Rigid motion [4, 4] of the world that moves the table of all cameras to z = 0, below the cameras."""
    points = np.concatenate([plane.points @ poses[name][:3, :3].T + poses[name][:3, 3] for name, plane in tables.items()])
    center = points.mean(axis=0)
    normal = np.linalg.svd((points - center).T @ (points - center))[0][:, -1]
    normal *= np.sign(normal @ (np.mean([pose[:3, 3] for pose in poses.values()], axis=0) - center))
    motion = np.eye(4)
    motion[:3, :3] = Rotation.align_vectors([[0.0, 0.0, 1.0]], [normal])[0].as_matrix()
    motion[2, 3] = -(motion[:3, :3] @ center)[2]
    return motion


def by_board(board: BoardEntry, view: SeenCamera, folder: Path | None) -> tuple[np.ndarray, float]:
    """Measure a camera's pose with a static board, in images of `folder` or in the camera's own frames.

    Returns the camera-to-world pose [4, 4], m, and the error, pixels rms. Raises InputError if too few corners are seen, or they do
    not fit.
    """
    if not hasattr(cv2.aruco, board.dictionary) or not board.marker < board.square:
        rule = "board: a dictionary of OpenCV and markers smaller than squares are required"
        raise InputError("rig.json", rule, f"{board.dictionary}, {board.marker:g} and {board.square:g} m")
    images: Sequence[np.ndarray] = view.colors
    if folder is not None:
        source = open_images(folder, "color")
        images = [view.straight.color(image) for image in source.read(range(len(source.series.numbers)))]
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    points, pixels = np.zeros((0, 3), np.float32), np.zeros((0, 2), np.float32)
    for legacy in (False, True):  # boards with an even number of rows that were printed before OpenCV 4.6
        pattern = cv2.aruco.CharucoBoard(board.squares, board.square, board.marker, dictionary)
        pattern.setLegacyPattern(legacy)
        detector, seen = cv2.aruco.CharucoDetector(pattern), []
        for image in images:
            corners, ids, _, _ = detector.detectBoard(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY))
            seen += [] if ids is None else list(zip(np.ravel(ids), corners.reshape(-1, 2), strict=True))
        if len(seen) > len(pixels):
            points = np.asarray(pattern.getChessboardCorners(), np.float32)[np.array([number for number, _ in seen], int)]
            pixels = np.array([corner for _, corner in seen], np.float32)
    where, matrix = folder or view.path, view.lens.matrix
    if len(pixels) < FEWEST_CORNERS:
        rule = f"at least {FEWEST_CORNERS} corners of the board must be seen by camera {view.name}"
        raise InputError(where, rule, f"{len(pixels)} in {len(images)} images", "Correct `board` of rig.json, or use more light.")
    _, turn, shift = cv2.solvePnP(points, pixels, matrix, None, flags=cv2.SOLVEPNP_IPPE)
    turn, shift = cv2.solvePnPRefineLM(points, pixels, matrix, None, turn, shift)
    projected = cv2.projectPoints(points, turn, shift, matrix, None)[0].reshape(-1, 2)
    if (error := float(np.sqrt(np.mean(np.sum((projected - pixels) ** 2, axis=1))))) > MOST_ERROR:
        remedy = "Keep the board still in all images, and state the intrinsics of these images."
        raise InputError(where, f"corners of the board must fit within {MOST_ERROR:g} pixels rms", f"{error:.2f}", remedy)
    board_to_camera = np.eye(4)
    board_to_camera[:3, :3], board_to_camera[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return OPENGL @ rigid_inverse(board_to_camera), error  # OpenCV's board has y down and z into the paper.


def _point(view: SeenCamera, at: tuple[float, float]) -> np.ndarray:
    """The point [3], m, in camera coordinates, at pixel (x, y), from the median depth around it. Raises InputError."""
    x, y = round(at[0]), round(at[1])
    around = np.stack(view.depths)[:, max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
    if not (around > 0).any():
        raise InputError("rig.json", "table_at: a pixel of the table with depth is required", f"none at {x} {y}")
    return np.asarray(np.median(around[around > 0]) * (np.linalg.inv(view.lens.matrix) @ [x, y, 1.0]))
