"""The masks mode: marks, a preview of one frame, carrying them through the video, saving what came out."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from threading import Lock
from typing import Any

import numpy as np

from neuspring.config import parse, plain
from neuspring.config.perception import Perception
from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.extensions.annotate.shared import BackgroundJob, Document, Report
from neuspring.perception.backends import SEGMENTERS
from neuspring.perception.film import Carried
from neuspring.perception.marks import MARKS, Marks
from neuspring.perception.masks import MasksFile, save_carried, source_digest

MOST_MARKS = 2000
"""Marks of a camera: a limit for what a browser may send."""


@dataclass(frozen=True, eq=False)
class CarriedMasks:
    """Masks of one camera, as they were carried."""

    packed: Sequence[bytes]
    """The labels of each frame, compressed: a long film would not fit into memory."""
    doubt: np.ndarray
    """[T], 0 sure, 1 doubtful."""
    marks: Marks
    """Marks that the masks were carried from."""
    saved: bool = False


class MasksMode:
    """State of the masks mode, shared by all tabs."""

    def __init__(self, capture: Capture) -> None:
        self.capture, self.job = capture, BackgroundJob()
        path = capture.folder / MARKS
        self.document: Document[Marks] = Document(
            path, lambda: Marks.load(path) if path.exists() else Marks(), lambda marks: marks.save(path)
        )
        self._results: dict[str, CarriedMasks] = {}
        self._lock, self._saving = Lock(), Lock()

    def plain(self) -> dict[str, Any]:
        """Marks with their revision, the job, and what was carried, as plain values."""
        revision, marks = self.document.read()
        with self._lock:
            carried = {
                camera: {
                    "doubt": [round(float(value), 3) for value in result.doubt],
                    "saved": result.saved,
                    "stale": result.marks.of(camera) != marks.of(camera),
                }
                for camera, result in self._results.items()
            }
        made = MasksFile.of(self.capture).cameras
        saved = {camera: list(made[camera].doubt) if camera in made else [] for camera in self.saved_cameras()}
        return {"revision": revision, "marks": plain(marks), "job": self.job.plain(), "carried": carried, "saved": saved}

    def write(self, revision: Any, values: Any) -> str:
        """Replace the marks by plain values; returns the new revision. Raises Stale, InputError.

        Half-done work is good too: the object may come last.
        """
        if not isinstance(values, dict):
            raise InputError(MARKS, "a JSON object is required", type(values).__name__)
        cameras = values.get("cameras")
        for camera, marks in cameras.items() if isinstance(cameras, dict) else ():
            if isinstance(marks, list) and len(marks) > MOST_MARKS:
                raise InputError(f"{MARKS}, cameras.{camera}", f"at most {MOST_MARKS} marks a camera", len(marks))
        parsed = parse(Marks, values, MARKS)
        parsed.require(self.capture, whole=False)
        return self.document.write(revision, parsed)

    def preview(self, camera: str, frame: int) -> np.ndarray:
        """Labels [H, W] of one marked frame from its marks alone. Raises InputError."""
        return SEGMENTERS["marks"].outline(self.capture, camera, frame, self.document.read()[1].of(camera))

    def carry(self, cameras: Sequence[str]) -> None:
        """Begin to carry the marks of cameras through the video. Raises InputError, Busy."""
        marks = self.document.read()[1]
        unmarked = [camera for camera in cameras if not marks.of(camera)]
        if unmarked or not cameras:
            where = f"camera {', '.join(unmarked)}" if unmarked else "the capture"
            raise InputError(where, "the object must be marked in a frame", "no marks", "Draw a box around it first.")
        self.job.start(lambda report: self._carry(list(cameras), marks, report))

    def _carry(self, cameras: Sequence[str], marks: Marks, report: Report) -> str:
        doubtful = 0
        for camera in cameras:

            def progress(done: int, total: int, camera: str = camera) -> None:
                report(f"camera {camera}", done, total)

            progress(0, self.capture.frame_count)
            carried = SEGMENTERS["marks"].carry(self.capture, camera, marks.of(camera), Perception(), "cpu", progress)
            doubtful += int((carried.doubt > 0.5).sum())
            with self._lock:
                self._results[camera] = CarriedMasks([zlib.compress(labels, 1) for labels in carried.labels], carried.doubt, marks)
        names = f"{'camera' if len(cameras) == 1 else 'cameras'} {', '.join(cameras)}"
        frames = f"{doubtful or 'no'} very doubtful frame{'' if doubtful == 1 else 's'}"
        return f"Carried {names}; {frames}. Look at the frames that are listed, then save."

    def labels(self, camera: str, frame: int, source: str) -> np.ndarray | None:
        """Labels [H, W] of a frame, `carried` just now or `saved` in the capture; None where there are none."""
        if source == "carried":
            with self._lock:
                result = self._results.get(camera)
            return self._unpacked(camera, result.packed[frame]) if result and self.capture.has(camera, frame) else None
        exists = self.capture.has(camera, frame) and self.capture.path("mask", camera, frame).exists()
        return self.capture.mask(camera, frame) if source == "saved" and exists else None

    def save(self) -> list[str]:
        """Write what was carried to the capture; returns the cameras. Raises InputError where nothing was carried."""
        with self._lock:
            results = dict(self._results)
        if not results:
            raise InputError("masks", "there must be masks to save", "none", "Carry the marks through the video first.")
        # Two tabs would write the same files, and the record of one of them would be lost.
        with self._saving:
            for camera, result in results.items():
                source = source_digest(self.capture, camera, result.marks.of(camera), "marks")
                carried = Carried(np.stack([self._unpacked(camera, labels) for labels in result.packed]), result.doubt)
                save_carried(self.capture, camera, carried, source, "marks")
                with self._lock:
                    if self._results.get(camera) is result:
                        self._results[camera] = replace(result, saved=True)
        return list(results)

    def _unpacked(self, camera: str, labels: bytes) -> np.ndarray:
        view = self.capture.cameras[camera]
        return np.frombuffer(zlib.decompress(labels), np.uint8).reshape(view.height, view.width)

    def saved_cameras(self) -> list[str]:
        """Cameras with a mask in the capture."""
        frames = range(self.capture.frame_count)
        return [c for c in self.capture.cameras if any(self.capture.path("mask", c, frame).exists() for frame in frames)]
