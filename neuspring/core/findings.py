"""Findings: faults and oddities of a data set, or those that a step notices in its own result.

A step's own finding is implausible, but no reason to stop: it is kept in the record, printed, and reported.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from neuspring.core.errors import InputError
from neuspring.core.records import StageRecord

Level = Literal["note", "warning", "error"]
FACT = "findings"
"""The fact of a stage's record that holds them."""
RECORDS = ("perception/*/masks.json", "perception/*/tracks.json", "perception/lifted.json", "observations.json")
"""The records, in a scenario's folder, of the steps that look at their own results; in their order."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One finding.

    `error`: a reader refuses it, numbers would be wrong, or no method can work with it. `warning`: readable, but not as released,
    or results are probably worse for it. `note`: a measurement, a check that was skipped, worth knowing.
    """

    name: str
    """Subject in a few words, the same for every occurrence: the name of the check, where a `Check` found it."""
    level: Level
    where: str
    """The file, the camera, or what else was looked at."""
    text: str
    """The value, the rule that it departs from, and the next move."""
    remedy: str = ""
    """The next move alone, where it is known apart."""
    title: str | None = None
    """Beginning of the message before the text: the key of a file, or nothing; None: the name."""
    value: Any = None
    """The measured value, where that is one number or word."""
    limit: tuple[float | None, float | None] | None = None
    """Lowest and highest value that is fine; None: no bound on that side."""
    frames: tuple[int, ...] = ()
    """Frames that it is about, where it is about some."""

    @property
    def message(self) -> str:
        """All but level and place."""
        head = self.name if self.title is None else self.title
        return f"{head}: {self.text}" if head else self.text

    def __str__(self) -> str:
        return f"{self.level}: {self.where}: {self.message}"


def finding(name: str, level: Level, where: str, value: str, rule: str, remedy: str = "") -> Finding:
    """A finding whose text is `value` (what was received), the `rule`, and the next move."""
    return Finding(name=name, level=level, where=where, text=f"{value}; {rule}. {remedy}".rstrip(), remedy=remedy)


def broken(file: Path, key: str, rule: str, value: object = None) -> Finding:
    """An error: `key` of `file` breaks `rule`; `value` was received."""
    return _of_file(file, "error", key, rule, value)


def note(file: Path, message: str) -> Finding:
    """A measurement or a skipped check."""
    return _of_file(file, "note", "", message, None)


def _of_file(file: Path, level: Level, key: str, rule: str, value: object) -> Finding:
    return Finding(name=key, level=level, where=str(file), text=rule if value is None else f"{rule}; received {value}")


def refusal(error: InputError | str) -> Finding:
    """The error of a reader, or its text, which begins with the file."""
    file, _, message = str(error).partition(": ")
    return Finding(name="", level="error", where=file, text=message)


def refused(findings: Iterable[Finding]) -> bool:
    """True where some finding is an error."""
    return any(one.level == "error" for one in findings)


def refuse(findings: Iterable[Finding]) -> None:
    """Raise the errors among findings about a data set as one InputError, naming file and key; else print warnings."""
    listed = list(findings)
    errors = [one for one in listed if one.level == "error"]
    if errors:
        raise InputError(errors[0].where, errors[0].message.rstrip("."), remedy=" ".join(map(str, errors[1:])))
    for one in listed:
        if one.level == "warning":
            print(one)


def findings_as_facts(findings: Sequence[Finding]) -> dict[str, Any]:
    """Print findings in the job's log; returns them as a fact of its record (none: no fact)."""
    for one in findings:
        print(one, flush=True)
    return (
        {FACT: [{key: value for key, value in asdict(one).items() if value not in (None, ())} for one in findings]}
        if findings
        else {}
    )


def refuse_errors(findings: Iterable[Finding]) -> None:
    """Raise InputError with the first finding that is an error."""
    for one in findings:
        if one.level == "error":
            raise InputError(one.where, one.message.rstrip("."))


def warnings_of(results: Path, scenarios: Iterable[str]) -> tuple[tuple[str, Finding], ...]:
    """Scenario and finding of all steps of scenarios, notes left out."""
    return tuple((name, one) for name in scenarios for one in findings_of(results, name) if one.level != "note")


def findings_of(results: Path, scenario: str) -> list[Finding]:
    """The findings of all steps of a scenario, in the order of the steps; records that cannot be read have none."""
    found = []
    for pattern in RECORDS:
        for path in sorted((Path(results) / scenario).glob(pattern)):
            try:
                listed = StageRecord.load(path).facts.get(FACT, [])
                found += [Finding(**values) for values in listed if values["level"] in get_args(Level)]
            except (InputError, TypeError, KeyError):
                continue
    return found
