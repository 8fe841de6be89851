"""What a check of data found, for assertions."""

from __future__ import annotations

from neuspring.data.departure import Departure


def of_level(departures: list[Departure], *levels: str) -> list[str]:
    """Texts of the departures with one of these levels."""
    return [f"{d.file.name}: {d.message}" for d in departures if d.level in levels]


def serious(departures: list[Departure]) -> list[str]:
    """Texts of errors and warnings."""
    return of_level(departures, "error", "warning")


def holds(departures: list[Departure], level: str, file: str, *words: str) -> bool:
    """Whether one departure of this level and file has all `words` in its message."""
    return any(d.level == level and d.file.name == file and all(w in d.message for w in words) for d in departures)
