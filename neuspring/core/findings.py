"""What a step noticed about its own result: implausible, but no reason to stop. It is kept in the record, printed, and reported."""

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
    """One finding. `note`: worth knowing. `warning`: results are probably worse for it. `error`: no method can work with this."""

    name: str
    """What it is about, in a few words; the same for every occurrence."""
    level: Level
    where: str
    """The camera, or what else was looked at."""
    text: str
    """The value, the rule that it departs from, and the next move."""

    def __str__(self) -> str:
        return f"{self.level}: {self.where}: {self.name}: {self.text}"


def finding(name: str, level: Level, where: str, value: str, rule: str, remedy: str = "") -> Finding:
    """A finding whose text is `value` (what was received), the `rule`, and the next move."""
    return Finding(name=name, level=level, where=where, text=f"{value}; {rule}. {remedy}".rstrip())


def told(findings: Sequence[Finding]) -> dict[str, Any]:
    """Print findings in the job's log; returns them as a fact of its record (none: no fact)."""
    for one in findings:
        print(one, flush=True)
    return {FACT: [asdict(one) for one in findings]} if findings else {}


def refuse_errors(findings: Iterable[Finding]) -> None:
    """Raise InputError with the first finding that is an error."""
    for one in findings:
        if one.level == "error":
            raise InputError(one.where, f"{one.name}: {one.text.rstrip('.')}")


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
