"""Segmentation from the marks of a user: marks.json of the capture, carried through the video."""

from __future__ import annotations

import numpy as np

from neuspring.config.perception import MarksSegmentation
from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.perception.marks.carry import carry_camera
from neuspring.perception.marks.marks import MARKS, Mark, Marks


def require(capture: Capture) -> None:
    """Raise InputError if marks.json is not there, is wrong, or lacks a camera."""
    for camera in capture.cameras:
        _marks_of(capture, camera)


def segment(capture: Capture, camera: str, settings: MarksSegmentation) -> np.ndarray:
    """Labels [T, H, W]. Raises InputError without marks.json, or where it has no marks of this camera."""
    carried = carry_camera(capture, camera, _marks_of(capture, camera), settings)
    doubtful = np.argsort(-carried.doubt, kind="stable")[:3]
    print(f"camera {camera}: most doubtful frames: " + ", ".join(f"{f} ({carried.doubt[f]:.2f})" for f in doubtful), flush=True)
    return carried.labels


def _marks_of(capture: Capture, camera: str) -> tuple[Mark, ...]:
    path = capture.folder / MARKS
    marks = Marks.load(path)
    marks.require(capture, path)
    if not marks.of(camera):
        raise InputError(f"{path}, cameras", f"camera {camera} needs marks", sorted(marks.cameras))
    return marks.of(camera)
