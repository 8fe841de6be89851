"""A recording of markers along a cable, [T, 3, n] m: its form, and distances between neighbors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.core.checks import Check

MIN_MARKERS = 6
"""Two controllers at either end and at least two observed markers."""
MIN_FRAMES = 4
MIN_DISTANCE = 1e-4
"""Nodes must be farther apart than this, m; otherwise their spring would have no length."""
RELEASED_SAMPLES = 500
MAX_STRETCH = 0.5
"""Relative change of a marker distance from its median above which markers may be swapped or lost. The released cables stay
below a third."""


@dataclass(frozen=True, eq=False)
class CableRecording:
    """The content of a file."""

    where: Path
    raw: Any

    @cached_property
    def form(self) -> tuple[str, object] | np.ndarray:
        """Positions [T, 3, n]; or the rule that they break, and what was there."""
        if not isinstance(self.raw, (np.ndarray, list, tuple)):
            return "positions [T, 3, n] are required", type(self.raw).__name__
        try:
            data = np.asarray(self.raw)
        except ValueError:
            return "positions [T, 3, n] are required", "nested lists of different lengths"
        if data.ndim != 3 or data.shape[1] != 3:
            return "the shape must be [T, 3, n]", data.shape
        return data if data.dtype.kind == "f" else ("the dtype must be floating point", data.dtype)

    @cached_property
    def positions(self) -> np.ndarray | None:
        """[T, 3, n], m, where they are as required."""
        data = self.form
        if not isinstance(data, np.ndarray) or data.shape[2] < MIN_MARKERS or len(data) < MIN_FRAMES or not np.isfinite(data).all():
            return None
        return data

    @cached_property
    def lengths(self) -> np.ndarray | None:
        """Distances [T, n - 1], m, of neighbors."""
        return None if self.positions is None else np.linalg.norm(np.diff(self.positions, axis=2), axis=1)


def sized(recording: CableRecording, axis: int) -> int | None:
    """Frames (0) or markers (2)."""
    return recording.form.shape[axis] if isinstance(recording.form, np.ndarray) else None


def not_finite(recording: CableRecording) -> dict[str, Any] | None:
    """The first coordinate that is not finite, and how many there are."""
    if not isinstance(data := recording.form, np.ndarray) or not len(bad := np.argwhere(~np.isfinite(data))):
        return None
    t, axis, marker = (int(i) for i in bad[0])
    return {"value": float(data[t, axis, marker]), "frame": t, "marker": marker, "count": len(bad), "frames": (t,)}


def too_near(recording: CableRecording) -> dict[str, Any] | None:
    """The first marker of frame 0 that lies on its neighbor."""
    lengths = recording.lengths
    short = np.flatnonzero(lengths[0] < MIN_DISTANCE) if lengths is not None else np.zeros(0, int)
    return {"value": int(short[0]), "next": int(short[0]) + 1} if len(short) else None


def stretch(recording: CableRecording) -> dict[str, Any] | None:
    """The largest change of a distance of neighbors, as a part of its median."""
    if (lengths := recording.lengths) is None or too_near(recording):
        return None
    change = np.abs(lengths / np.median(lengths, axis=0) - 1)
    frame, segment = (int(i) for i in np.unravel_index(int(change.argmax()), change.shape))
    told = {"value": float(change.max()), "length": lengths[frame, segment], "median": np.median(lengths[:, segment])}
    return told | {"frame": frame, "one": segment, "two": segment + 1, "frames": (frame,)}


def unlike_released(recording: CableRecording) -> list[dict[str, Any]]:
    """Type and number of samples that are not as released."""
    if (data := recording.positions) is None:
        return []
    found = [{"text": f"the released dtype is float64; received {data.dtype}"}] if data.dtype != np.float64 else []
    text = f"released recordings have {RELEASED_SAMPLES} samples; received {len(data)}"
    return found + ([{"text": text}] if len(data) != RELEASED_SAMPLES else [])


# fmt: off
CHECKS = (
    Check("form of a recording", CableRecording, lambda recording: None if isinstance(recording.form, np.ndarray) else
          {"rule": recording.form[0], "received": recording.form[1]}, None, "error", "{rule}; received {received}", title=""),
    Check("markers", CableRecording, lambda recording: sized(recording, 2), (MIN_MARKERS, np.inf), "error",
          "at least {low} markers are required (4 of them are controllers); received {value}", title=""),
    Check("samples", CableRecording, lambda recording: sized(recording, 0), (MIN_FRAMES, np.inf), "error",
          "at least {low} frames are required; received {value}", title=""),
    Check("finite positions", CableRecording, not_finite, None, "error",
          "every coordinate must be finite; received {value} at frame {frame}, marker {marker} ({count} in all)", title=""),
    Check("unlike the release", CableRecording, unlike_released, None, "warning", "{text}", title=""),
    Check("markers on one place", CableRecording, too_near, None, "error",
          f"neighboring markers must be {MIN_DISTANCE} m apart in frame 0; received markers {{value}} and {{next}}", title=""),
    Check("stretched cable", CableRecording, stretch, (0, MAX_STRETCH), "warning",
          "marker distances usually stay within {high:.0%} of their median {median:.3f} m; received {length:.3f} m between markers "
          "{one} and {two} in frame {frame}", title=""),
)
