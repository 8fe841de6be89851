"""Marks and masks for tests of the page: boxes become masks, in all frames alike."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.data.capture import Capture
from neuspring.data.json_file import load_json

LABELS = {"object": 1, "hand": 2, "ignore": 0}


class Painted:
    """Stands in for `FromMarks`. `gate` holds `carry` back after its first report until it is set."""

    def __init__(self) -> None:
        self.gate = Event()
        self.gate.set()
        self.written: dict[str, np.ndarray] = {}

    def load(self, capture: Capture) -> Any:
        path = capture.folder / "marks.json"
        return load_json(path) if path.exists() else {"format": 1, "cameras": {}}

    def read(self, values: Any, capture: Capture) -> Any:
        if not isinstance(values, dict) or set(values) != {"format", "cameras"}:
            raise InputError("marks.json", "a JSON object of format and cameras is required")
        return values

    def plain(self, marks: Any) -> dict[str, Any]:
        result: dict[str, Any] = json.loads(json.dumps(marks))
        return result

    def save(self, marks: Any, capture: Capture) -> None:
        write_text(Path(capture.folder) / "marks.json", json.dumps(marks))

    def preview(self, capture: Capture, camera: str, frame: int, marks: Any) -> np.ndarray:
        own = [mark for mark in marks["cameras"].get(camera, []) if mark["frame"] == frame]
        if not own:
            raise InputError(f"frame {frame}", "an object or a hand must be marked on it")
        labels = np.zeros((capture.cameras[camera].height, capture.cameras[camera].width), np.uint8)
        for mark in own:
            (x0, y0), (x1, y1) = np.round([np.min(mark["points"], axis=0), np.max(mark["points"], axis=0)]).astype(int)
            labels[y0 : y1 + 1, x0 : x1 + 1] = LABELS[mark["label"]]
        return labels

    def carry(
        self, capture: Capture, camera: str, marks: Any, progress: Callable[[int, int], None]
    ) -> tuple[np.ndarray, np.ndarray]:
        first = min(mark["frame"] for mark in marks["cameras"][camera])
        labels = self.preview(capture, camera, first, marks)
        for frame in range(capture.frame_count):
            progress(frame + 1, capture.frame_count)
            assert self.gate.wait(30)
        return np.repeat(labels[None], capture.frame_count, axis=0), np.linspace(0, 1, capture.frame_count)

    def save_masks(self, capture: Capture, camera: str, labels: np.ndarray, doubt: np.ndarray, marks: Any) -> None:
        self.written[camera] = labels

    def doubt(self, capture: Capture) -> dict[str, list[float]]:
        return {}
