"""Whether a capture and its observations belong together."""

from __future__ import annotations

from pathlib import Path

from neuspring.core.errors import InputError
from neuspring.data.capture import CAPTURE, Capture


def require_length(capture: Capture, frames: int, observations_path: Path) -> None:
    """Raise InputError unless the capture has `frames` frames."""
    if capture.frame_count != frames:
        rule = f"must have as many frames as {observations_path}: {frames}"
        remedy = "Correct the data, or set images.enabled: false to go without pictures."
        raise InputError(capture.folder / CAPTURE, rule, capture.frame_count, remedy)
