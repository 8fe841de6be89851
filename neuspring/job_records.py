"""What happened to a job of the workflow: its attempts, causes of failure, time, memory, GPU. Written by `neuspring.job`.

One JSON file per job at results/jobs/<rule>/<wildcards>.json, beside its log at results/logs/<rule>/<wildcards>.log.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter, ValidationError

from neuspring.config_types import STRICT
from neuspring.errors import InputError
from neuspring.files import write_text
from neuspring.records import RECORD_FORMAT, read_json

FOLDER, LOGS = "jobs", "logs"
STARTED = ".started"
"""File in FOLDER that is as old as the run of the workflow that goes on, or went on last."""
Outcome = Literal["ok", "transient", "permanent", "killed", "running"]
"""How an attempt ended. transient: may be tried again. running: it runs, or its wrapper was killed before it could say more."""


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """One run of a job's command."""

    __pydantic_config__ = STRICT
    started: str
    """UTC, ISO 8601."""
    seconds: float = 0.0
    """Wall time of the command, without waiting."""
    waited: float = 0.0
    """s waited for a GPU."""
    outcome: Outcome = "running"
    cause: str = ""
    """Why it failed, in words; empty if it did not."""
    message: str = ""
    """The last line of the output that says something; empty if it did not fail."""
    exit: int | None = None
    """Exit status; negative: the signal that ended it."""
    host: str = ""
    devices: list[str] = field(default_factory=list)
    """GPUs held, as in CUDA_VISIBLE_DEVICES; empty on the CPU."""
    device_names: list[str] = field(default_factory=list)
    peak_memory_mb: float = 0.0
    """Resident memory of all its processes, MiB."""
    peak_gpu_memory_mb: float | None = None
    """Memory in use on the held GPUs, MiB; None where it cannot be read."""
    gpu_utilisation: float | None = None
    """Mean over time and held GPUs, %."""
    cpu_seconds: float = 0.0
    samples: list[list[float | None]] = field(default_factory=list)
    """[s since the start, CPU %, resident MiB, GPU %, GPU MiB], at most 120 rows."""


@dataclass(frozen=True, kw_only=True)
class JobRecord:
    """All attempts of a job."""

    __pydantic_config__ = STRICT
    rule: str
    name: str
    """<rule>/<wildcards joined by />."""
    log: str
    """Relative to the results folder."""
    attempts: list[Attempt]
    scenario: str = ""
    work: float = 1.0
    """How much it had to do, in units of its rule (see `neuspring.plan`)."""

    @property
    def last(self) -> Attempt:
        """The newest attempt."""
        return self.attempts[-1]

    @property
    def failed(self) -> bool:
        """Whether the newest attempt ended without success."""
        return self.last.outcome not in ("ok", "running")

    @property
    def seconds(self) -> float:
        """Wall time of all attempts."""
        return sum(attempt.seconds for attempt in self.attempts)

    @classmethod
    def of_log(cls, results: Path, log: Path, scenario: str = "", work: float = 1.0) -> JobRecord:
        """A new record of the job that logs to `log`, which must lie under results/logs. Raises InputError."""
        try:
            name = log.relative_to(results / LOGS).with_suffix("").as_posix()
        except ValueError as error:
            raise InputError(log, f"logs of jobs must lie in {results / LOGS}") from error
        where = {"name": name, "log": log.relative_to(results).as_posix()}
        return cls(rule=name.partition("/")[0], attempts=[], scenario=scenario, work=work, **where)

    def path(self, results: Path) -> Path:
        """Where the record lies."""
        return Path(results) / FOLDER / f"{self.name}.json"

    def save(self, results: Path) -> None:
        """Write as JSON, atomically."""
        write_text(self.path(results), json.dumps({"format": RECORD_FORMAT, **asdict(self)}, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: Path) -> JobRecord:
        """Read a record. Raises InputError if it is missing or damaged."""
        try:
            return _adapter().validate_json(json.dumps(read_json(path, RECORD_FORMAT)), strict=True)
        except ValidationError as error:
            raise InputError(path, "must be a job record", error.errors()[0]["msg"], "Delete it.") from error


@functools.cache
def _adapter() -> TypeAdapter[JobRecord]:
    """Building it takes longer than using it for a thousand records."""
    return TypeAdapter(JobRecord)


def failure_lines(records: Iterable[JobRecord], results: Path) -> list[str]:
    """What failed and why, a line a job, and where its log lies. A job that still says that it runs has lost its wrapper."""
    lines = []
    for record in records:
        last = record.last
        cause, message = (last.cause, last.message) if record.failed else ("its wrapper or machine vanished", f"on {last.host}")
        if last.outcome != "ok":
            lines.append(f"{record.name}: {cause} (attempt {len(record.attempts)}): {message}; {results / record.log}")
    return lines


def read_jobs(results: Path, damaged: list[str] | None = None) -> list[JobRecord]:
    """The records of all jobs of a results folder, by name.

    What is wrong with damaged ones is added to `damaged`. Raises InputError for a damaged one where that is not given.
    """
    records = []
    for path in sorted((Path(results) / FOLDER).rglob("*.json")):
        try:
            records.append(JobRecord.load(path))
        except InputError as error:
            if damaged is None:
                raise
            damaged.append(str(error))
    return records
