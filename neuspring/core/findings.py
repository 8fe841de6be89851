"""Findings: faults and oddities of a data set, or of a step's own result.

A finding about a step's own result does not stop the step. It is printed, stored in the record, and shown in the report.
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
"""The fact of a stage's record that contains its findings."""
RECORDS = ("perception/*/masks.json", "perception/*/tracks.json", "perception/lifted.json", "observations.json")
"""Records with findings in a scenario's folder, in the order of their steps."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One finding.

    `error`: a reader rejects the data, numbers would be wrong, or no method can use the data. `warning`: the data are readable,
    but differ from the released data or probably worsen results. `note`: a measurement, or a skipped check.
    """

    name: str
    """Subject in a few words, the same for every occurrence; for a `Check`, its name."""
    level: Level
    where: str
    """The examined file, camera or other subject."""
    text: str
    """The value, the violated rule, and the next move."""
    remedy: str = ""
    """The next move, if it is known separately."""
    title: str | None = None
    """Start of the message before the text: the key of a file, or empty; None: the name."""
    value: Any = None
    """The measured value, if it is a single number or word."""
    limit: tuple[float | None, float | None] | None = None
    """Lowest and highest accepted value; None: no bound on that side."""
    frames: tuple[int, ...] = ()
    """Frames that the finding concerns, if any."""

    @property
    def message(self) -> str:
        """The text with its title, without level and `where`."""
        head = self.name if self.title is None else self.title
        return f"{head}: {self.text}" if head else self.text

    def __str__(self) -> str:
        return f"{self.level}: {self.where}: {self.message}"


def finding(name: str, level: Level, where: str, value: str, rule: str, remedy: str = "") -> Finding:
    """A finding whose text consists of the received `value`, the `rule` and the next move."""
    return Finding(name=name, level=level, where=where, text=f"{value}; {rule}. {remedy}".rstrip(), remedy=remedy)


def broken(file: Path, key: str, rule: str, value: object = None) -> Finding:
    """An error: `key` of `file` violates `rule`; `value` was received."""
    return _of_file(file, "error", key, rule, value)


def note(file: Path, message: str) -> Finding:
    """A note about a file: a measurement or a skipped check."""
    return _of_file(file, "note", "", message, None)


def _of_file(file: Path, level: Level, key: str, rule: str, value: object) -> Finding:
    return Finding(name=key, level=level, where=str(file), text=rule if value is None else f"{rule}; received {value}")


def refusal(error: InputError | str) -> Finding:
    """The finding for a reader's error, or for its text, which starts with the file."""
    file, _, message = str(error).partition(": ")
    return Finding(name="", level="error", where=file, text=message)


def refused(findings: Iterable[Finding]) -> bool:
    """True if any finding is an error."""
    return any(item.level == "error" for item in findings)


def refuse(findings: Iterable[Finding]) -> None:
    """Raise all errors among findings about a data set as one InputError with file and key; without errors, print warnings."""
    listed = list(findings)
    errors = [item for item in listed if item.level == "error"]
    if errors:
        raise InputError(errors[0].where, errors[0].message.rstrip("."), remedy=" ".join(map(str, errors[1:])))
    for item in listed:
        if item.level == "warning":
            print(item)


def findings_as_facts(findings: Sequence[Finding]) -> dict[str, Any]:
    """Print findings to the job's log and return them as a fact for its record; empty without findings."""
    for item in findings:
        print(item, flush=True)
    return (
        {FACT: [{key: value for key, value in asdict(item).items() if value not in (None, ())} for item in findings]}
        if findings
        else {}
    )


def refuse_errors(findings: Iterable[Finding]) -> None:
    """Raise InputError for the first finding that is an error."""
    for item in findings:
        if item.level == "error":
            raise InputError(item.where, item.message.rstrip("."))


def warnings_of(results: Path, scenarios: Iterable[str]) -> tuple[tuple[str, Finding], ...]:
    """(scenario, finding) for the warnings and errors of all steps of these scenarios."""
    return tuple((name, item) for name in scenarios for item in findings_of(results, name) if item.level != "note")


def findings_of(results: Path, scenario: str) -> list[Finding]:
    """The findings of all steps of a scenario, in the order of the steps; unreadable records are skipped."""
    findings = []
    for pattern in RECORDS:
        for path in sorted((Path(results) / scenario).glob(pattern)):
            try:
                listed = StageRecord.load(path).facts.get(FACT, [])
                findings += [Finding(**values) for values in listed if values["level"] in get_args(Level)]
            except (InputError, TypeError, KeyError):
                continue
    return findings
