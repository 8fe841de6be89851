"""Departures of a capture folder from its format, image by image, and conditions under which perception would fail."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Capture, description_departures, read_description
from neuspring.data.departure import Departure, Inspection, broken, note, unusual

NEAR, FAR = 0.1, 10.0
"""m. A median depth outside this range means that the unit is wrong."""
APART = 0.1
"""Distance between two pieces of one label, as a fraction of the image, from which they count as two objects."""
SECOND = 0.3
"""A piece with at least this fraction of the largest piece's area counts as an object."""
LEAVES = 0.1
"""Fraction of its area in frame 0 below which an object has left the view."""


def is_capture(folder: Path) -> bool:
    """Whether the folder holds a capture."""
    return (folder / CAPTURE).exists()


def check_capture(folder: Path) -> list[Departure]:
    """Description, calibration, every image, masks of frame 0, tracks."""
    case, path = Inspection(folder), folder / CAPTURE
    description = case.load(path, read_description)
    if description is None:
        return case.departures
    case.departures += description_departures(path, description)
    capture = Capture(folder, description)
    for name in capture.cameras:
        _check_camera(case, capture, name)
    case.load(folder / "tracks.json", lambda _: capture.tracks())
    if not description.masks:
        message = "masks: false: masks are not checked; perception.segment needs another backend than given"
        case.departures.append(note(path, message))
    return case.departures


def _check_camera(case: Inspection, capture: Capture, name: str) -> None:
    depths, areas = [], np.zeros((3, capture.frame_count))
    for frame in range(capture.frame_count):
        if not capture.has(name, frame):
            areas[:, frame] = np.nan
            continue
        try:
            capture.colour(name, frame)
            depth = capture.depth(name, frame)
            depths.append(float(np.median(depth[depth > 0])) if (depth > 0).any() else np.nan)
            if capture.description.masks:
                areas[:, frame] = np.bincount(capture.mask(name, frame).ravel(), minlength=3)[:3]
        except InputError as error:
            case.departures.append(Departure.of_error(error))
    case.departures += depth_departures(capture, name, depths)
    if capture.description.masks:
        case.departures += mask_departures(capture, name, areas)


def depth_departures(capture: Capture, name: str, medians: list[float]) -> list[Departure]:
    """Departures of a camera whose median depths, m, are not those of a scene on a table."""
    path, depths = capture.folder / CAPTURE, np.array([m for m in medians if np.isfinite(m)])
    if medians and not len(depths):
        return [broken(path, f"cameras.{name}", "some depth is required", "0 in every pixel of every frame")]
    if len(depths) and not NEAR < np.median(depths) < FAR:
        unit = capture.description.depth_unit
        rule = f"the median depth of camera {name} must lie between {NEAR:g} and {FAR:g} m, with the unit of the images"
        return [broken(path, "depth_unit", rule, f"{unit:g} m per count, which makes it {np.median(depths):.4g} m")]
    return []


def mask_departures(capture: Capture, name: str, areas: np.ndarray) -> list[Departure]:
    """Masks of frame 0 show object and hands, each object once; later frames still show the object."""
    path, departures = capture.path("mask", name, 0), []
    for label, thing in ((OBJECT, "the object"), (HANDS, "a hand")):
        if areas[label, 0] == 0:
            departures.append(unusual(path, "", f"camera {name} should show {thing} (label {label}) in frame 0", "no such pixel"))
    if areas[OBJECT, 0]:
        try:
            count = objects(capture.mask(name, 0))
        except InputError:
            return departures
        if count > 1:
            departures.append(
                unusual(path, "", "label 1 should be one object, whose pieces lie together", f"{count} pieces far apart")
            )
        gone = np.flatnonzero(areas[OBJECT] < LEAVES * areas[OBJECT, 0])
        if len(gone):
            rule = f"camera {name} should show the object throughout"
            departures.append(unusual(path, "", rule, f"almost nothing of it in {len(gone)} frames, first in frame {gone[0]}"))
    return departures


def objects(labels: np.ndarray) -> int:
    """Number of objects with label 1: pieces of the mask that stay apart when it is grown by half of APART."""
    own = (labels == OBJECT).astype(np.uint8)
    reach = max(int(0.5 * APART * max(labels.shape)), 1)
    grown = cv2.dilate(own, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2))
    count, pieces = cv2.connectedComponents(grown)
    sizes = np.array([(own[pieces == k] > 0).sum() for k in range(1, count)])
    return int((sizes >= SECOND * sizes.max()).sum()) if len(sizes) else 0
