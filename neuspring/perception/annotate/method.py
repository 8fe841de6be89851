"""The marks and masks of the masks mode: those of `neuspring.perception.marks`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from neuspring.config import parse, plain
from neuspring.config.perception import MarksSegmentation
from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.perception.marks import MARKS, Carried, Marks, frame_mask
from neuspring.perception.marks.sheet import save_sheet
from neuspring.perception.marks.store import Made, MadeCamera, carry_camera, film_of, save_masks, source_digest


@dataclass(frozen=True)
class FromMarks:
    """Masks from marks, with the settings of `perception.segment.marks`."""

    settings: MarksSegmentation = field(default_factory=MarksSegmentation)

    def load(self, capture: Capture) -> Marks:
        """The marks of a capture; none where there is no file. Raises InputError."""
        path = capture.folder / MARKS
        return Marks.load(path) if path.exists() else Marks()

    def read(self, values: Any, capture: Capture) -> Marks:
        """Marks from plain values. Half-done work is good too: the object may come last. Raises InputError."""
        if not isinstance(values, dict):
            raise InputError(MARKS, "a JSON object is required", type(values).__name__)
        marks = parse(Marks, values, MARKS)
        marks.require(capture, whole=False)
        return marks

    def plain(self, marks: Marks) -> dict[str, Any]:
        """Marks as plain values."""
        return plain(marks)

    def save(self, marks: Marks, capture: Capture) -> None:
        """Write marks.json."""
        marks.save(capture.folder / MARKS)

    def preview(self, capture: Capture, camera: str, frame: int, marks: Marks) -> np.ndarray:
        """Labels [H, W] of one marked frame. Raises InputError."""
        # A film lacks the frames that its camera missed.
        place = sum(capture.has(camera, before) for before in range(frame))
        own = [replace(mark, frame=place) for mark in marks.of(camera) if mark.frame == frame]
        return frame_mask(film_of(capture, camera), place, own, self.settings)

    def carry(
        self, capture: Capture, camera: str, marks: Marks, progress: Callable[[int, int], None]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Labels [T, H, W] and doubt [T]; nothing in frames that the camera missed. Raises InputError."""
        carried = carry_camera(capture, camera, marks.of(camera), self.settings, progress=progress)
        return carried.labels, carried.doubt

    def save_masks(self, capture: Capture, camera: str, labels: np.ndarray, doubt: np.ndarray, marks: Marks) -> None:
        """Write mask/<camera>/, a picture to look at, and what they were made from, as `neuspring mask` does. Raises InputError."""
        save_masks(capture, camera, labels)
        save_sheet(capture, camera, Carried(labels, doubt))
        source = source_digest(capture, camera, marks.of(camera), "marks", self.settings)
        made = MadeCamera(source=source, backend="marks", doubt=tuple(round(float(value), 4) for value in doubt))
        Made.of(capture).save(capture, camera, made)

    def doubt(self, capture: Capture) -> dict[str, list[float]]:
        """Doubt [T] of the masks that the capture has, by camera, where it is known. Raises InputError."""
        return {camera: list(made.doubt) for camera, made in Made.of(capture).cameras.items()}
