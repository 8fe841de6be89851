"""Segmentation from the marks of a user: marks.json of the capture, carried through the video."""

from __future__ import annotations

import numpy as np

from neuspring.config.perception import MarksSegmentation
from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.perception.marks.marks import MARKS, Marks
from neuspring.perception.marks.store import carry_camera


def segment(capture: Capture, camera: str, settings: MarksSegmentation) -> np.ndarray:
    """Labels [T, H, W]. Raises InputError without marks.json, or where it has no marks of this camera."""
    path = capture.folder / MARKS
    if not path.exists():
        remedy = "Mark object and hands with `neuspring annotate`, or write the file by hand: see perception/README.md."
        raise InputError(path, "perception.segment.backend: marks needs this file", "no such file", remedy)
    marks = Marks.load(path)
    marks.require(capture, path)
    if not marks.of(camera):
        raise InputError(f"{path}, cameras", f"camera {camera} needs marks", sorted(marks.cameras))
    carried = carry_camera(capture, camera, marks.of(camera), settings)
    doubtful = np.argsort(-carried.doubt, kind="stable")[:3]
    print(f"camera {camera}: most doubtful frames: " + ", ".join(f"{f} ({carried.doubt[f]:.2f})" for f in doubtful), flush=True)
    return carried.labels
