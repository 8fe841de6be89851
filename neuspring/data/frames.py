"""Operations on the frames and masks of one camera that several steps of perception share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias, TypeVar

import cv2
import numpy as np
from scipy.spatial import cKDTree

from neuspring.core.files import write_atomically
from neuspring.data.capture import HANDS, NOTHING, OBJECT, PERSON, Capture

T = TypeVar("T")
Color: TypeAlias = tuple[int, int, int]
"""RGB."""
TINTS = {OBJECT: (40, 220, 60), HANDS: (70, 110, 255), PERSON: (150, 150, 150)}
"""RGB of labels in figures of masks: green, blue and gray, unless the image has these colors."""
OTHERS = ((255, 140, 0), (240, 50, 220), (250, 230, 30))
"""Alternative tints, RGB."""
CLEAR, TINT_AROUND = 20.0, 15
"""Smallest visible difference in a and b of Lab, and the distance around a label within which colors are compared, pixels."""

ISLAND_SHARE, ISLAND_GAP, ISLAND_AWAY, CRACK = 0.05, 0.03, 0.04, 5
"""Limits of an island of the object's mask: largest area, as a fraction of the largest piece; smallest distance from the rest, as a
fraction of the image width and, where depth was measured, in m; and the gap, pixels, across which labels still touch."""


def frames_of(capture: Capture, camera: str) -> list[int]:
    """The frames that are not missing for a camera."""
    return [frame for frame in range(capture.frame_count) if capture.has(camera, frame)]


def spread(values: Sequence[T], count: int) -> list[T]:
    """At most `count` values, evenly spread from the first to the last."""
    return [values[index] for index in np.unique(np.linspace(0, len(values) - 1, count).astype(int))]


def gray(capture: Capture, camera: str, frame: int) -> np.ndarray:
    """The gray image [H, W] uint8."""
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(capture.color(camera, frame)), cv2.COLOR_RGB2GRAY))


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two masks [...] bool; NaN if both are empty."""
    union = int((one | other).sum())
    return float((one & other).sum() / union) if union else float("nan")


def without_islands(capture: Capture, camera: str, labels: np.ndarray) -> np.ndarray:
    """Remove small, distant pieces of the object from labels [T, H, W] of a camera, and print a summary.

    A piece is kept if it touches the rest of the object, directly or through hands or a person.
    """
    result, removed = labels.copy(), list[tuple[int, int]]()
    for frame in frames_of(capture, camera):
        count, pieces, boxes, _ = cv2.connectedComponentsWithStats((labels[frame] == OBJECT).astype(np.uint8))
        if count <= 2:
            continue
        areas = boxes[:, cv2.CC_STAT_AREA] * (np.arange(count) > 0)
        grown = cv2.dilate((labels[frame] != NOTHING).astype(np.uint8), np.ones((CRACK, CRACK), np.uint8))
        touching = cv2.connectedComponents(grown)[1]
        islands = [piece for piece in range(1, count) if areas[piece] <= ISLAND_SHARE * areas.max()]
        rest = np.isin(touching, np.unique(touching[(pieces > 0) & ~np.isin(pieces, islands)]))
        while near := [piece for piece in islands if not _is_apart(capture, camera, frame, pieces == piece, rest & (pieces > 0))]:
            islands = [piece for piece in islands if piece not in near]
            rest |= np.isin(pieces, near)
        result[frame][np.isin(pieces, islands)] = NOTHING
        removed += [(frame, int(areas[piece])) for piece in islands]
    if removed:
        extent = f"frames {removed[0][0]} to {removed[-1][0]}, at most {max(area for _, area in removed)} pixels each"
        print(f"camera {camera}: removed {len(removed)} small distant pieces of the object's mask: {extent}", flush=True)
    return result


def _is_apart(capture: Capture, camera: str, frame: int, piece: np.ndarray, rest: np.ndarray) -> bool:
    """True if a piece [H, W] bool is far from the rest in the image and, if both have depth, in space."""
    away = cv2.distanceTransform((~rest).astype(np.uint8), cv2.DIST_L2, 5)
    if away[piece].min() <= ISLAND_GAP * rest.shape[1]:
        return False
    view, has_depth = capture.cameras[camera], capture.path("depth", camera, frame).exists()
    depth = capture.depth(camera, frame) if has_depth else np.zeros(rest.shape)
    points = []
    for part in (rest, piece):
        y, x = np.nonzero(part & (depth > 0))
        points.append(view.lift(np.stack([x, y], axis=1).astype(float), depth[y, x]))
    return not all(map(len, points)) or float(cKDTree(points[0]).query(points[1])[0].min()) > ISLAND_AWAY


def tints_of(image: np.ndarray, labels: np.ndarray) -> dict[int, Color]:
    """The tint, RGB, of each label in figures of this camera: the usual tint if it is visible, else the most visible one.

    `image` [H, W, 3] and `labels` [H, W] are one frame. A tint is visible if the label's tinted median color differs by CLEAR from
    nine tenths of the colors around the label.
    """

    def hues(colors: np.ndarray) -> np.ndarray:
        """a and b of Lab [n, 2]."""
        return np.asarray(cv2.cvtColor(colors.reshape(1, -1, 3).astype(np.uint8), cv2.COLOR_RGB2LAB)[0, :, 1:], dtype=float)

    chosen: dict[int, Color] = {}
    for label, usual in TINTS.items():
        inside = labels == label
        around = cv2.dilate(inside.astype(np.uint8), np.ones((2 * TINT_AROUND + 1,) * 2, np.uint8)).astype(bool) & ~inside
        free = [tint for tint in (usual, *OTHERS) if tint not in chosen.values()]
        clear = [CLEAR]
        if inside.any() and around.any():
            drawn = hues(tinted(np.median(image[inside], axis=0), np.array(free)))
            clear = [float(np.quantile(np.linalg.norm(hues(image[around]) - hue, axis=1), 0.1)) for hue in drawn]
        chosen[label] = usual if clear[0] >= CLEAR else free[int(np.argmax(clear))]
    return chosen


def tinted(color: np.ndarray, tint: np.ndarray) -> np.ndarray:
    """RGB blended with a tint [..., 3]: 60 % color, 40 % tint."""
    return np.asarray(0.6 * color + 0.4 * tint)


def overlay(image: np.ndarray, labels: np.ndarray, tints: Mapping[int, Color]) -> np.ndarray:
    """An RGB image [H, W, 3] with tinted labels [H, W] and their outlines."""
    result = np.array(image, order="C")
    for label, tint in tints.items():
        inside = (labels == label).astype(np.uint8)
        result[inside > 0] = tinted(image[inside > 0], np.array(tint)).astype(np.uint8)
        outlines, _ = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(result, outlines, -1, tint, 1)
    return result


def write_png(path: Path, image: np.ndarray) -> Path:
    """Write RGB [H, W, 3], RGBA [H, W, 4] or a mask [H, W], uint8, atomically; a link is replaced, not followed."""
    pixels = image[..., [2, 1, 0, 3][: image.shape[2]]] if image.ndim == 3 else image
    ok, png = cv2.imencode(".png", np.ascontiguousarray(pixels))
    assert ok, "an image can be encoded"
    write_atomically(path, lambda temporary: temporary.write_bytes(png.tobytes()))
    return path
