"""Departures of a data set from its described layout, and the inspection that collects them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from neuspring.core.errors import InputError
from neuspring.core.findings import Finding

Level = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Departure:
    """One departure. `error`: the reader refuses the file, or numbers would be wrong. `warning`: readable, but not as released.
    `note`: a measurement, or a check that was skipped."""

    file: Path
    level: Level
    message: str

    @classmethod
    def of_error(cls, error: InputError | str) -> Departure:
        """The error of a reader, or its text, which begins with the file."""
        file, _, message = str(error).partition(": ")
        return cls(Path(file), "error", message)

    @classmethod
    def of_finding(cls, file: Path, found: Finding) -> Departure:
        """What a look at the content of `file` found."""
        return cls(file, found.level, f"{found.where}: {found.name}: {found.text}")


def broken(file: Path, key: str, rule: str, value: object = None) -> Departure:
    """An error: `key` of `file` breaks `rule`; `value` was received."""
    return _departure(file, "error", key, rule, value)


def unusual(file: Path, key: str, rule: str, value: object = None) -> Departure:
    """A warning: `key` of `file` departs from `rule`; `value` was received."""
    return _departure(file, "warning", key, rule, value)


def note(file: Path, message: str) -> Departure:
    """A measurement or a skipped check."""
    return Departure(file, "note", message)


def _departure(file: Path, level: Level, key: str, rule: str, value: object) -> Departure:
    received = "" if value is None else f"; received {value}"
    return Departure(file, level, f"{key}: {rule}{received}" if key else f"{rule}{received}")


def refuse(departures: list[Departure]) -> None:
    """Raise the first error among `departures` as InputError, naming file and key; print warnings when there is none."""
    errors = [d for d in departures if d.level == "error"]
    if errors:
        more = f"{len(errors) - 1} more: " if len(errors) > 1 else ""
        raise InputError(errors[0].file, errors[0].message, remedy=f"{more}`neuspring check-data` lists every departure.")
    for departure in departures:
        if departure.level == "warning":
            print(f"warning: {departure.file}: {departure.message}")


@dataclass
class Inspection:
    """A folder under inspection and its departures so far."""

    folder: Path
    departures: list[Departure] = field(default_factory=list)

    def load(self, path: Path, reader: Callable[[Path], Any]) -> Any:
        """The content of `path`, or None (with a departure) if it is missing or damaged."""
        try:
            return reader(path)
        except InputError as error:
            self.departures.append(Departure(path, "error", str(error).removeprefix(f"{path}: ")))
            return None

    def load_optional(self, path: Path, reader: Callable[[Path], Any], skipped: str) -> Any:
        """As `load`, with a note if `path` is missing: what is therefore `skipped`, with its verb ("the check is")."""
        if path.exists():
            return self.load(path, reader)
        self.departures.append(note(path, f"not found: {skipped} skipped"))
        return None
