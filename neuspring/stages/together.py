"""Common parts of stages that do the jobs of another one together, with shared launches: `searches`, `fits`.

A job of theirs leaves what each of its members would leave behind if it were killed at its end, and the member's own job continues
from there: to its end, if nothing went wrong. So they make no result of their own, and an error in one member costs time alone.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from neuspring import config
from neuspring.config.parse import json_value
from neuspring.config.settings import read_settings
from neuspring.core.records import StageRecord
from neuspring.stages.stage import Job, Member, Rows, Stage

RowsText = Annotated[str, 'JSON list [{"jobs": {record: {input: path}}, "options": {}, "settings": as of each}, ...]']


@dataclass(frozen=True, kw_only=True)
class MemberRow:
    """Jobs with the same options and settings."""

    jobs: dict[str, dict[str, str | list[str]]]
    """Record to write -> input files by parameter."""
    options: dict[str, Any] = field(default_factory=dict)
    settings: str = "{}"


def rows_of(members: Sequence[Member]) -> dict[str, str]:
    """The option `rows` of a job with these members."""
    rows: dict[str, Any] = {}
    for one in members:
        row = {"options": one.options, "settings": one.settings}
        inputs = {name: paths for name, paths in one.inputs.items() if name != "also"}
        rows.setdefault(json.dumps(row, sort_keys=True), row | {"jobs": {}})["jobs"][one.output] = inputs
    return {"rows": json.dumps(list(rows.values()), sort_keys=True)}


def physics(rows: Rows) -> tuple[Any, ...]:
    """The physics, of which a launch has one, as the scenario table says it."""
    return rows.scenario.self_collision, rows.scenario.ground


def unfinished(stage: Stage, rows: str, device: str, errors: dict[str, str]) -> dict[str, Job]:
    """By record, the jobs of a stage that are still to be done; those whose inputs cannot be read are put into `errors`."""
    jobs: dict[str, Job] = {}
    for place, text in enumerate(json_value("--rows", rows, list)):
        row = config.parse(MemberRow, text, f"--rows, entry {place}")
        for output, inputs in row.jobs.items():
            try:
                job = stage.job(output=Path(output), settings=read_settings(row.settings), device=device, **row.options, **inputs)
            except Exception as error:
                note(errors, output, error)
                continue
            if not (job.failed or _is_done(job)):
                jobs[output] = job
    return jobs


def note(errors: dict[str, str], output: str, error: Exception) -> None:
    """Keep and print an error of one member, which its own job meets again."""
    errors[output] = f"{type(error).__name__}: {error}"
    print(f"{output}: {errors[output]}; its own job goes on from its last checkpoint")


def _is_done(job: Job) -> bool:
    """True where the record is there, made of the same inputs and settings."""
    own = job.record
    if not own.output.is_file():
        return False
    record = StageRecord.load(own.output)
    return (record.inputs, record.settings) == (own.inputs, json.loads(json.dumps(own.settings)))
