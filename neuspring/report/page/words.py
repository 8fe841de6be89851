"""Numbers and counts in words."""

from __future__ import annotations

import math
from collections.abc import Sequence

from neuspring.scores.metrics import DASH


def several(count: int, noun: str, plural: str = "") -> str:
    """`1 run`, `2 runs`."""
    return f"{count:,} {noun if count == 1 else plural or noun + 's'}"


def listed(names: Sequence[str], most: int = 8) -> str:
    """Names for a sentence. Of more than `most`, the rest is counted."""
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def duration(seconds: float) -> str:
    """A time for people."""
    if not math.isfinite(seconds):
        return DASH
    if seconds < 100:
        return f"{seconds:.1f} s"
    if seconds < 100 * 60:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.1f} h"


def hours(seconds: float) -> str:
    """Hours, with fewer decimals for larger values."""
    value = seconds / 3600
    if value < 0.01:
        return "< 0.01" if value else "0"
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 1 else f"{value:.2f}"


def memory(mebibytes: float | None) -> str:
    """Mebibytes; gibibytes from 1024 MiB."""
    if mebibytes is None or not math.isfinite(mebibytes):
        return DASH
    return f"{mebibytes / 1024:.1f} GiB" if mebibytes >= 1024 else f"{mebibytes:.0f} MiB"


def signed(value: float, digits: int) -> str:
    """A number with its sign, and a typographic minus. What rounds to zero has no sign."""
    text = f"{value:+.{digits}f}".replace("-", "−")
    return text if text.strip("+−0.") else text[1:]


def number(value: float, digits: int) -> str:
    """A number with a typographic minus; a dash for NaN."""
    return DASH if not math.isfinite(value) else f"{value:.{digits}f}".replace("-", "−")
