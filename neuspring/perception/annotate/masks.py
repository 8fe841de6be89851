"""The masks mode: marks, a preview of one frame, carrying them through the video, and saving what came out."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from threading import Lock
from typing import Any, Protocol

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.perception.annotate.document import Document
from neuspring.perception.annotate.job import Job, Report
from neuspring.perception.marks.marks import MARKS

MOST_MARKS = 2000
"""Marks of a camera: a limit for what a browser may send."""


class Method(Protocol):
    """What marks are and how masks come from them: `neuspring.perception.marks`, or a stand-in."""

    def load(self, capture: Capture) -> Any:
        """The marks of a capture; none where there is no file. Raises InputError."""

    def read(self, values: Any, capture: Capture) -> Any:
        """Marks from plain values, checked. Raises InputError."""

    def plain(self, marks: Any) -> dict[str, Any]:
        """Marks as plain values."""

    def save(self, marks: Any, capture: Capture) -> None:
        """Write marks.json."""

    def preview(self, capture: Capture, camera: str, frame: int, marks: Any) -> np.ndarray:
        """Labels [H, W] of one marked frame. Raises InputError."""

    def carry(
        self, capture: Capture, camera: str, marks: Any, progress: Callable[[int, int], None]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Labels [T, H, W] and doubt [T] of every frame. Raises InputError."""

    def save_masks(self, capture: Capture, camera: str, labels: np.ndarray, doubt: np.ndarray, marks: Any) -> None:
        """Write mask/<camera>/, and how the masks were made."""

    def doubt(self, capture: Capture) -> dict[str, list[float]]:
        """Doubt [T] of masks that the capture has, by camera, where it is known. Raises InputError."""


@dataclass(frozen=True, eq=False)
class Result:
    """Masks of one camera, as they were carried."""

    images: Sequence[bytes]
    """A gray PNG per frame."""
    doubt: np.ndarray
    """[T], 0 sure, 1 doubtful."""
    marks: Any
    """What they came from."""
    source: str
    """Digest of the camera's marks."""
    saved: bool = False

    def labels(self) -> np.ndarray:
        """[T, H, W] uint8."""
        return np.stack([decode(image) for image in self.images])


class Masks:
    """State of the masks mode, shared by all tabs."""

    def __init__(self, capture: Capture, method: Method) -> None:
        self.capture, self.method, self.job = capture, method, Job()
        self.document: Document[Any] = Document(
            capture.folder / MARKS, lambda: method.load(capture), lambda marks: method.save(marks, capture)
        )
        self._results: dict[str, Result] = {}
        self._lock, self._saving = Lock(), Lock()

    def plain(self) -> dict[str, Any]:
        """Marks with their revision, the job, and what was carried, as plain values."""
        revision, marks = self.document.read()
        values = self.method.plain(marks)
        with self._lock:
            carried = {
                camera: {
                    "doubt": [round(float(value), 3) for value in result.doubt],
                    "saved": result.saved,
                    "stale": result.source != digest(values, camera),
                }
                for camera, result in self._results.items()
            }
        doubt = self.method.doubt(self.capture)
        saved = {camera: doubt.get(camera, []) for camera in self.saved_cameras()}
        return {"revision": revision, "marks": values, "job": self.job.plain(), "carried": carried, "saved": saved}

    def write(self, revision: Any, values: Any) -> str:
        """Replace the marks; returns the new revision. Raises Stale, InputError."""
        lists = values.get("cameras") if isinstance(values, dict) else None
        if isinstance(lists, dict):
            for camera, marks in lists.items():
                if isinstance(marks, list) and len(marks) > MOST_MARKS:
                    raise InputError(f"{MARKS}, cameras.{camera}", f"at most {MOST_MARKS} marks a camera", len(marks))
        return self.document.write(revision, self.method.read(values, self.capture))

    def preview(self, camera: str, frame: int) -> np.ndarray:
        """Labels [H, W] of one marked frame. Raises InputError."""
        return self.method.preview(self.capture, camera, frame, self.document.read()[1])

    def carry(self, cameras: Sequence[str]) -> None:
        """Begin to carry the marks of cameras through the video. Raises InputError, Busy."""
        marks = self.document.read()[1]
        values = self.method.plain(marks)
        unmarked = [camera for camera in cameras if not values["cameras"].get(camera)]
        if unmarked or not cameras:
            where = f"camera {', '.join(unmarked)}" if unmarked else "the capture"
            raise InputError(where, "the object must be marked in a frame", "no marks", "Draw a box around it first.")
        self.job.start(lambda report: self._carry(list(cameras), marks, values, report))

    def _carry(self, cameras: Sequence[str], marks: Any, values: dict[str, Any], report: Report) -> str:
        doubtful = 0
        for camera in cameras:

            def progress(done: int, total: int, camera: str = camera) -> None:
                report(f"camera {camera}", done, total)

            progress(0, self.capture.frame_count)
            labels, doubt = self.method.carry(self.capture, camera, marks, progress)
            doubtful += int((doubt > 0.5).sum())
            result = Result([encode(image) for image in labels], doubt, marks, digest(values, camera))
            with self._lock:
                self._results[camera] = result
        names = f"{'camera' if len(cameras) == 1 else 'cameras'} {', '.join(cameras)}"
        frames = f"{doubtful or 'no'} very doubtful frame{'' if doubtful == 1 else 's'}"
        return f"Carried {names}; {frames}. Look at the frames that are listed, then save."

    def labels(self, camera: str, frame: int, source: str) -> np.ndarray | None:
        """Labels [H, W] of a frame, `carried` just now or `saved` in the capture; None where there are none."""
        if source == "carried":
            with self._lock:
                result = self._results.get(camera)
            return decode(result.images[frame]) if result and self.capture.has(camera, frame) else None
        exists = self.capture.has(camera, frame) and self.capture.path("mask", camera, frame).exists()
        return self.capture.mask(camera, frame) if exists else None

    def save(self) -> list[str]:
        """Write what was carried to the capture; returns the cameras. Raises InputError where nothing was carried."""
        with self._lock:
            results = dict(self._results)
        if not results:
            raise InputError("masks", "there must be masks to save", "none", "Carry the marks through the video first.")
        # Two tabs would write the same files, and the record of one of them would be lost.
        with self._saving:
            for camera, result in results.items():
                self.method.save_masks(self.capture, camera, result.labels(), result.doubt, result.marks)
                with self._lock:
                    if self._results.get(camera) is result:
                        self._results[camera] = replace(result, saved=True)
        return list(results)

    def saved_cameras(self) -> list[str]:
        """Cameras with a mask in the capture."""
        frames = range(self.capture.frame_count)
        return [c for c in self.capture.cameras if any(self.capture.path("mask", c, frame).exists() for frame in frames)]


def digest(values: dict[str, Any], camera: str) -> str:
    """Digest of the marks of a camera."""
    return hashlib.sha256(json.dumps(values["cameras"].get(camera, []), sort_keys=True).encode()).hexdigest()


def encode(labels: np.ndarray) -> bytes:
    """A gray PNG."""
    return cv2.imencode(".png", np.ascontiguousarray(labels), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def decode(image: bytes) -> np.ndarray:
    """Labels [H, W] of a gray PNG."""
    return np.asarray(cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_UNCHANGED))
