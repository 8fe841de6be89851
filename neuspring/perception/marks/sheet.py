"""A contact sheet of the masks of one camera: frames in doubt, and frames evenly over the video."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from neuspring.core.files import write_atomically
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.perception.marks.carry import Carried

TINTS = {OBJECT: (40, 220, 60), HANDS: (70, 110, 255)}
"""RGB, as in the other pictures of masks."""
COLUMNS = 4
EVEN, DOUBTFUL = 8, 8
"""How many frames are shown evenly over the video, and in doubt."""
WIDTH = 424
"""Of a tile, pixels, at most."""


def overlay(image: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """An RGB image [H, W, 3] with object tinted green and hands blue, their borders drawn."""
    result = image.copy()
    for label, tint in TINTS.items():
        own = (labels == label).astype(np.uint8)
        result[own > 0] = (0.6 * image[own > 0] + 0.4 * np.array(tint)).astype(np.uint8)
        outlines, _ = cv2.findContours(own, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(result, outlines, -1, tint, 1)
    return result


def sheet_of(capture: Capture, camera: str) -> Path:
    """Where the sheet of a camera lies: beside the masks."""
    return capture.folder / f"mask_{camera}.png"


def save_sheet(capture: Capture, camera: str, carried: Carried) -> Path:
    """Write `sheet_of` a camera: the most doubtful frames first, then frames evenly spaced."""
    path = sheet_of(capture, camera)
    frames = np.array([frame for frame in range(capture.frame_count) if capture.has(camera, frame)])
    doubtful = frames[np.argsort(-carried.doubt[frames], kind="stable")][:DOUBTFUL]
    even = frames[np.unique(np.linspace(0, len(frames) - 1, EVEN).astype(int))]
    tiles = [_tile(capture, camera, carried, int(frame), "doubt") for frame in doubtful]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % COLUMNS)
    tiles += [_tile(capture, camera, carried, int(frame), "even") for frame in even]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % COLUMNS)
    rows = [np.hstack(tiles[index : index + COLUMNS]) for index in range(0, len(tiles), COLUMNS)]
    ok, png = cv2.imencode(".png", np.vstack(rows)[..., ::-1])
    assert ok, "a PNG of tiles can be encoded"
    write_atomically(path, lambda temporary: temporary.write_bytes(png.tobytes()))
    return path


def _tile(capture: Capture, camera: str, carried: Carried, frame: int, why: str) -> np.ndarray:
    image = overlay(np.ascontiguousarray(capture.color(camera, frame)), carried.labels[frame])
    height, width = image.shape[:2]
    if width > WIDTH:
        image = cv2.resize(image, (WIDTH, round(height * WIDTH / width)), interpolation=cv2.INTER_AREA)
    text = f"{frame}: doubt {carried.doubt[frame]:.2f}" if why == "doubt" else str(frame)
    for color, thick in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(image, text, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, thick, cv2.LINE_AA)
    return image
