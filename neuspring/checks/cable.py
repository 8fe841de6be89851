"""A recording of markers along a cable, [T, 3, n] m: its form, and distances between neighbors."""

from __future__ import annotations

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


def form(raw: Any) -> tuple[str, object] | np.ndarray:
    """Positions [T, 3, n]; or the rule that they break, and what was there."""
    if not isinstance(raw, (np.ndarray, list, tuple)):
        return "positions [T, 3, n] are required", type(raw).__name__
    try:
        data = np.asarray(raw)
    except ValueError:
        return "positions [T, 3, n] are required", "nested lists of different lengths"
    if data.ndim != 3 or data.shape[1] != 3:
        return "the shape must be [T, 3, n]", data.shape
    return data if data.dtype.kind == "f" else ("the dtype must be floating point", data.dtype)


def malformed(raw: Any) -> dict[str, Any] | None:
    """The rule that the form breaks."""
    return None if isinstance(data := form(raw), np.ndarray) else {"rule": data[0], "received": data[1]}


def positions(raw: Any) -> np.ndarray | None:
    """[T, 3, n], m, where they are as required."""
    data = form(raw)
    if not isinstance(data, np.ndarray) or data.shape[2] < MIN_MARKERS or len(data) < MIN_FRAMES or not np.isfinite(data).all():
        return None
    return data


def sized(raw: Any, axis: int) -> int | None:
    """Frames (0) or markers (2)."""
    return data.shape[axis] if isinstance(data := form(raw), np.ndarray) else None


def not_finite(raw: Any) -> dict[str, Any] | None:
    """The first coordinate that is not finite, and how many there are."""
    if not isinstance(data := form(raw), np.ndarray) or not len(bad := np.argwhere(~np.isfinite(data))):
        return None
    t, axis, marker = (int(i) for i in bad[0])
    return {"value": float(data[t, axis, marker]), "frame": t, "marker": marker, "count": len(bad), "frames": (t,)}


def too_near(raw: Any) -> dict[str, Any] | None:
    """The first marker of frame 0 that lies on its neighbor."""
    if (data := positions(raw)) is None:
        return None
    short = np.flatnonzero(np.linalg.norm(np.diff(data[0], axis=1), axis=0) < MIN_DISTANCE)
    return {"value": int(short[0]), "next": int(short[0]) + 1} if len(short) else None


def stretch(raw: Any) -> dict[str, Any] | None:
    """The largest change of a distance of neighbors, as a part of its median."""
    if (data := positions(raw)) is None or too_near(raw):
        return None
    lengths = np.linalg.norm(np.diff(data, axis=2), axis=1)
    change = np.abs(lengths / np.median(lengths, axis=0) - 1)
    frame, segment = (int(i) for i in np.unravel_index(int(change.argmax()), change.shape))
    told = {"value": float(change.max()), "length": lengths[frame, segment], "median": np.median(lengths[:, segment])}
    return told | {"frame": frame, "one": segment, "two": segment + 1, "frames": (frame,)}


def unlike_released(raw: Any) -> list[dict[str, Any]]:
    """Type and number of samples that are not as released."""
    if (data := positions(raw)) is None:
        return []
    found = [{"text": f"the released dtype is float64; received {data.dtype}"}] if data.dtype != np.float64 else []
    text = f"released recordings have {RELEASED_SAMPLES} samples; received {len(data)}"
    return found + ([{"text": text}] if len(data) != RELEASED_SAMPLES else [])


# fmt: off
checks = (
    Check("form of a recording", "cable", malformed, None, "error", "{rule}; received {received}", title=""),
    Check("markers", "cable", lambda raw: sized(raw, 2), (MIN_MARKERS, np.inf), "error",
          "at least {low} markers are required (4 of them are controllers); received {value}", title=""),
    Check("samples", "cable", lambda raw: sized(raw, 0), (MIN_FRAMES, np.inf), "error",
          "at least {low} frames are required; received {value}", title=""),
    Check("finite positions", "cable", not_finite, None, "error",
          "every coordinate must be finite; received {value} at frame {frame}, marker {marker} ({count} in all)", title=""),
    Check("unlike the release", "cable", unlike_released, None, "warning", "{text}", title=""),
    Check("markers on one place", "cable", too_near, None, "error",
          f"neighboring markers must be {MIN_DISTANCE} m apart in frame 0; received markers {{value}} and {{next}}", title=""),
    Check("stretched cable", "cable", stretch, (0, MAX_STRETCH), "warning",
          "marker distances usually stay within {high:.0%} of their median {median:.3f} m; received {length:.3f} m between "
          "markers {one} and {two} in frame {frame}", title=""),
)
