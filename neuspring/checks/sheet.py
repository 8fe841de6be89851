"""The contact sheet of a capture: one row per camera with the first frame, those at one and two thirds, and the last.

Each image shows:

- outlines of the masks, controllers and annotated points
- the table z = 0 as a grid of 10 cm, with the axes of the world (x red, y green, z blue)
- surface points of the other cameras, one color per camera

A wrong pose, unit, camera order or time is visible: grids are off the table, dots miss the object, or outlines do not match it.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.camera import Camera
from neuspring.data.capture import OBJECT, Capture
from neuspring.data.frames import TINTS

SHEET_FILE, SHEET_TILE = "contact_sheet.jpg", 480
"""Name of the file in the capture's folder, and the width of one image in it, px."""
CAMERA_TINTS = ((255, 140, 0), (240, 50, 220), (60, 220, 255), (250, 230, 30))
"""RGB of a camera's surface points in the other images."""
AXIS_TINTS = ((255, 60, 60), (60, 230, 60), (90, 140, 255))
SQUARE = 0.1
"""Side of a square of the table's grid, m."""


def draw_sheet(capture: Capture, controllers: np.ndarray, annotated: np.ndarray, path: Path) -> None:
    """Write the contact sheet; controllers and annotated points are [T, n, 3], m. Raises InputError if it cannot be written."""
    frames = sorted({round(part * (capture.frame_count - 1)) for part in (0, 1 / 3, 2 / 3, 1)})
    rows = [
        np.hstack([_tile(capture, controllers[frame], annotated[frame], name, frame) for frame in frames])
        for name in capture.cameras
    ]
    width = max(row.shape[1] for row in rows)
    sheet = np.vstack([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])
    legend, x = np.zeros((26, width, 3), np.uint8), 8
    texts = [("object", TINTS[1]), ("hands", TINTS[2]), ("controllers", (255, 255, 255)), ("annotated", (0, 255, 255))]
    texts += [("table z = 0, 10 cm", (200, 200, 200)), ("x", AXIS_TINTS[0]), ("y", AXIS_TINTS[1]), ("z", AXIS_TINTS[2])]
    texts += [(f"seen by {name}", CAMERA_TINTS[k % len(CAMERA_TINTS)]) for k, name in enumerate(capture.cameras) if len(rows) > 1]
    for text, color in texts:
        cv2.putText(legend, text, (x, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, 1, cv2.LINE_AA)
        x += 22 + cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0]
    try:
        written = cv2.imwrite(str(path), np.ascontiguousarray(np.vstack([sheet, legend])[..., ::-1]))
    except cv2.error:
        written = False
    if not written:
        raise InputError(path, "the contact sheet must be writable here")


def _tile(capture: Capture, controllers: np.ndarray, annotated: np.ndarray, name: str, frame: int) -> np.ndarray:
    """The image of one camera and frame, SHEET_TILE px wide."""
    camera = capture.cameras[name]
    scale = SHEET_TILE / camera.width
    size = (SHEET_TILE, round(scale * camera.height))
    try:
        image = cv2.resize(np.ascontiguousarray(capture.color(name, frame)), size, interpolation=cv2.INTER_AREA)
    except InputError:
        image = np.zeros((*size[::-1], 3), np.uint8)
    _grid(image, camera, scale, capture.description.up_sign)
    for number, other in enumerate(capture.cameras):
        if other != name:
            _dots(image, camera, scale, _measured(capture, other, frame), CAMERA_TINTS[number % len(CAMERA_TINTS)], 1)
    if "mask" in capture.streams and capture.has(name, frame) and capture.path("mask", name, frame).exists():
        labels = cv2.resize(capture.mask(name, frame), size, interpolation=cv2.INTER_NEAREST)
        for label, tint in TINTS.items():
            outlines, _ = cv2.findContours((labels == label).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(image, outlines, -1, tint, 1)
    _dots(image, camera, scale, controllers, (255, 255, 255), 3)
    _dots(image, camera, scale, annotated, (0, 255, 255), 2)
    image[:24, :170] = np.right_shift(image[:24, :170], 2)
    cv2.putText(image, f"camera {name}, frame {frame}", (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return image


def _measured(capture: Capture, name: str, frame: int) -> np.ndarray:
    """Points [n, 3], m, of one camera on the object's mask; without a mask, all points above the table."""
    if not capture.has(name, frame) or "depth" not in capture.streams:
        return np.zeros((0, 3))
    camera = capture.cameras[name]
    try:
        depth = capture.depth(name, frame)
        masked = "mask" in capture.streams and capture.path("mask", name, frame).exists()
        mask = capture.mask(name, frame) == OBJECT if masked else np.ones(depth.shape, bool)
    except InputError:
        return np.zeros((0, 3))
    y, x = np.nonzero(mask & (depth > 0))
    points = camera.lift(np.stack([x, y], axis=1).astype(float), depth[y, x])
    height = capture.description.up_sign * points[:, 2]
    points = points if masked else points[(height > 0.015) & (height < 0.8)]
    return points[:: max(len(points) // 300, 1)]


def _grid(image: np.ndarray, camera: Camera, scale: float, up: float) -> None:
    """Draw the grid around the image center's point on the table, and the axes at the world's origin."""
    eye = camera.camera_to_world[:3, 3]
    ray = camera.rays(np.array([camera.width, camera.height]) / 2)
    middle = eye - ray * eye[2] / ray[2] if ray[2] * eye[2] < 0 else np.zeros(3)
    middle = np.round(middle[:2] / SQUARE) * SQUARE
    steps, ends = SQUARE * np.arange(-5, 6), SQUARE * 5 * np.array([-1.0, 1.0])
    for step in steps:
        for line in (np.stack([np.full(2, step), ends], axis=1), np.stack([ends, np.full(2, step)], axis=1)):
            for color, thick in (((30, 30, 30), 2), ((235, 235, 235), 1)):  # visible on dark and light tables
                _line(image, camera, scale, np.column_stack([line + middle, np.zeros(2)]), color, thick)
    for axis, color in enumerate(AXIS_TINTS):
        tip = np.zeros(3)
        tip[axis] = SQUARE * (up if axis == 2 else 1)
        _line(image, camera, scale, np.stack([np.zeros(3), tip]), color, 2)


def _line(image: np.ndarray, camera: Camera, scale: float, ends: np.ndarray, color: tuple[int, int, int], thick: int) -> None:
    points = ends[0] + np.linspace(0, 1, 21)[:, None] * (ends[1] - ends[0])
    pixels, depth = camera.project(points)
    drawable = (depth > 0.05) & (np.abs(pixels) < 4 * max(camera.width, camera.height)).all(axis=1)
    for a, b in zip(range(20), range(1, 21), strict=True):
        if drawable[a] and drawable[b]:
            start, stop = (tuple(int(v) for v in np.round(scale * pixels[k])) for k in (a, b))
            cv2.line(image, start, stop, color, thick, cv2.LINE_AA)


def _dots(image: np.ndarray, camera: Camera, scale: float, points: np.ndarray, color: tuple[int, int, int], radius: int) -> None:
    pixels, depth = camera.project(points[np.isfinite(points).all(axis=1)])
    for x, y in np.round(scale * pixels[(depth > 0.05) & camera.sees(pixels)]).astype(int).tolist():
        cv2.circle(image, (x, y), radius, color, -1, cv2.LINE_AA)
