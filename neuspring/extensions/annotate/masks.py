"""Masks mode: annotations, a preview of one frame, carrying through the video, saving masks."""

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
"""Largest number of annotations per camera that a browser may send."""


@dataclass(frozen=True, eq=False)
class CarriedMasks:
    """Carried masks of one camera."""

    packed: Sequence[bytes]
    """Compressed labels of each frame; uncompressed, a long video would not fit into memory."""
    doubt: np.ndarray
    """[T], 0 (certain) to 1."""
    marks: Marks
    """Annotations from which the masks were carried."""
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
        """Annotations with their revision, the job, and carried masks, as plain values."""
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
        """Replace the annotations by plain values; returns the new revision. Raises Stale, InputError.

        Annotations may be incomplete: the user may draw the object last.
        """
        if not isinstance(values, dict):
            raise InputError(MARKS, "a JSON object is required", type(values).__name__)
        cameras = values.get("cameras")
        for camera, marks in cameras.items() if isinstance(cameras, dict) else ():
            if isinstance(marks, list) and len(marks) > MOST_MARKS:
                raise InputError(f"{MARKS}, cameras.{camera}", f"a camera must have at most {MOST_MARKS} annotations", len(marks))
        parsed = parse(Marks, values, MARKS)
        parsed.require(self.capture, whole=False)
        return self.document.write(revision, parsed)

    def preview(self, camera: str, frame: int) -> np.ndarray:
        """Labels [H, W] of one annotated frame, from its own annotations. Raises InputError."""
        return SEGMENTERS["marks"].outline(self.capture, camera, frame, self.document.read()[1].of(camera))

    def carry(self, cameras: Sequence[str]) -> None:
        """Start to carry the annotations of cameras through the video. Raises InputError, Busy."""
        marks = self.document.read()[1]
        missing = [camera for camera in cameras if not marks.of(camera)]
        if missing or not cameras:
            where = f"camera {', '.join(missing)}" if missing else "the capture"
            raise InputError(where, "the object must be annotated in a frame", "no annotations", "Draw a box around it first.")
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
        return f"Carried {names}; {frames}. Check the listed frames, then save."

    def labels(self, camera: str, frame: int, source: str) -> np.ndarray | None:
        """Labels [H, W] of a frame, `carried` by this server or `saved` in the capture; None if there are none."""
        if source == "carried":
            with self._lock:
                result = self._results.get(camera)
            return self._unpacked(camera, result.packed[frame]) if result and self.capture.has(camera, frame) else None
        exists = self.capture.has(camera, frame) and self.capture.path("mask", camera, frame).exists()
        return self.capture.mask(camera, frame) if source == "saved" and exists else None

    def save(self) -> list[str]:
        """Write carried masks to the capture; returns the cameras. Raises InputError without carried masks."""
        with self._lock:
            results = dict(self._results)
        if not results:
            raise InputError("masks", "there must be masks to save", "none", "Carry the annotations through the video first.")
        # Prevents two tabs from writing the same files and losing a record.
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
        """Cameras that have a mask in the capture."""
        frames = range(self.capture.frame_count)
        return [c for c in self.capture.cameras if any(self.capture.path("mask", c, frame).exists() for frame in frames)]
