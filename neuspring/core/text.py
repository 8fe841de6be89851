"""Text for the terminal: URIs without passwords, lists of names, numbers with units, the progress line."""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path


def masked(text: str) -> str:
    """The text with user and password of every URI replaced by ***."""
    return re.sub(r"://[^/@\s]+@", "://***@", text)


def program(name: str) -> str:
    """Path of a program of the current environment, relative to the current folder if possible."""
    path, here = Path(sys.executable).parent / name, Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)


def listed(names: Iterable[object], most: int = 12) -> str:
    """The names, separated by commas; beyond `most` names, only the number of the others."""
    texts = [str(name) for name in names]
    return ", ".join(texts) if len(texts) <= most else f"{', '.join(texts[:most])} and {len(texts) - most} more"


def spans(numbers: Sequence[int]) -> str:
    """Ascending numbers as ranges: `6, 13, 20 to 25`."""
    runs = [[number for _, number in part] for _, part in groupby(enumerate(numbers), key=lambda pair: pair[1] - pair[0])]
    return listed((f"{run[0]} to {run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs), 6)


def readable(value: float, unit: str) -> tuple[float, str]:
    """A value and its unit for display: four significant digits, lengths in mm."""
    value, unit = (1e3 * value, "mm") if unit == "m" else (value, unit)
    return float(f"{value:.4g}"), unit


def duration(seconds: float) -> str:
    """A duration as text, in s, min or h."""
    if not math.isfinite(seconds):
        return "–"
    minutes = f"{seconds / 60:.1f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
    return f"{seconds:.1f} s" if seconds < 100 else minutes


def refuse_password(key: str, uri: str, instead: str) -> None:
    """Raise ValueError if a URI contains a password, because command lines and logs of jobs would show it."""
    if ":" in uri.partition("://")[2].partition("/")[0].rpartition("@")[0]:
        raise ValueError(f"{key}: must not contain a password, because ps and logs would show it; set {instead} instead")


class Progress:
    """Prints `label done/total` with elapsed and remaining time, at most every `every` seconds."""

    def __init__(self, label: str, total: int, every: float | None = None) -> None:
        self._label, self._total = label, total
        self._terminal = sys.stderr.isatty()
        self._every = every if every is not None else (0.2 if self._terminal else 10.0)
        self._start = time.monotonic()
        self._last = 0.0
        self._first: int | None = None

    def of(self, done: int, total: int) -> None:
        """Set the total, then `update`: for work whose size is unknown before it starts."""
        self._total = total
        self.update(done)

    def update(self, done: int, note: str = "") -> None:
        """Report that `done` of `total` steps are finished."""
        moment = time.monotonic()
        if self._first is None:
            self._first = done - 1
        final = done >= self._total
        if moment - self._last < self._every and not final:
            return
        self._last = moment
        elapsed = moment - self._start
        left = elapsed / max(done - self._first, 1) * (self._total - done)
        text = f"{self._label} {done}/{self._total} [{elapsed:.0f} s, {left:.0f} s left] {note}".rstrip()
        end = "\n" if final or not self._terminal else ""
        print(f"\r\x1b[K{text}" if self._terminal else text, end=end, file=sys.stderr, flush=True)
