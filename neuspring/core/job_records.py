"""The record of a job of the workflow: its attempts, causes of failure, time, memory and GPU use. The wrapper of jobs writes it.

One JSON file per job at results/jobs/<rule>/<wildcards>.json, beside its log at results/logs/<rule>/<wildcards>.log.
"""

from __future__ import annotations

import functools
import json
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import ConfigDict, TypeAdapter, ValidationError

from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.records import RECORD_FORMAT, read_json

JOB_CONFIG = ConfigDict(extra="forbid", strict=True)
FOLDER, LOGS = "jobs", "logs"
RUN_FILE = ".run"
"""File in FOLDER that names the current run of the workflow, or the last one."""
ASKED = ".asked"
"""File in FOLDER that tells the command of that run, and the scenarios, methods and seeds that it was about."""
GPU_NOTES = ".gpus"
"""File in FOLDER in which the jobs of that run note which GPUs failed."""
Outcome = Literal["ok", "transient", "permanent", "killed", "running"]
"""End of an attempt. transient: trying again may help. running: it runs, or its wrapper was killed."""


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """One run of a job's command."""

    __pydantic_config__ = JOB_CONFIG
    started: str
    """UTC, ISO 8601."""
    seconds: float = 0.0
    """Wall time of the command, without waiting."""
    waited: float = 0.0
    """s waited for a GPU."""
    outcome: Outcome = "running"
    cause: str = ""
    """Cause of the failure, in words; empty where it did not fail."""
    message: str = ""
    """The line of the output that names the error; empty if it did not fail."""
    exit: int | None = None
    """Exit status; negative: the signal that ended it."""
    host: str = ""
    run: str = ""
    """The run of the workflow that it belongs to (`begin_run`); empty for a job started by hand."""
    devices: list[str] = field(default_factory=list)
    """GPUs of the job, as in CUDA_VISIBLE_DEVICES; empty on the CPU."""
    device_names: list[str] = field(default_factory=list)
    peak_memory_mb: float = 0.0
    """Resident memory of all its processes, MiB."""
    peak_gpu_memory_mb: float | None = None
    """Memory in use on its GPUs, MiB; None where it cannot be read."""
    gpu_utilization: float | None = None
    """Mean over time and GPUs, %."""
    cpu_seconds: float = 0.0
    samples: list[list[float | None]] = field(default_factory=list)
    """[s since the start, CPU %, resident MiB, GPU %, GPU MiB], at most 120 rows."""

    @property
    def kind(self) -> Literal["cpu", "gpu"]:
        """Kind of device that it ran on."""
        return "gpu" if self.devices else "cpu"


@dataclass(frozen=True, kw_only=True)
class JobRecord:
    """All attempts of a job."""

    __pydantic_config__ = JOB_CONFIG
    rule: str
    name: str
    """<rule>/<wildcards joined by />."""
    log: str
    """Relative to the results folder."""
    attempts: list[Attempt]
    scenario: str = ""
    stamp: str = ""
    """Digest of the options and the code of a job that is no stage, once it succeeded. Stages have records of their own."""

    @property
    def last(self) -> Attempt:
        """The newest attempt."""
        return self.attempts[-1]

    @property
    def failed(self) -> bool:
        """True where the newest attempt ended without success."""
        return self.last.outcome not in ("ok", "running")

    @property
    def seconds(self) -> float:
        """Wall time of all attempts."""
        return sum(attempt.seconds for attempt in self.attempts)

    @classmethod
    def of_log(cls, results: Path, log: Path, scenario: str = "") -> JobRecord:
        """A new record of the job that logs to `log`, which must lie under results/logs. Raises InputError."""
        try:
            name = log.relative_to(results / LOGS).with_suffix("").as_posix()
        except ValueError as error:
            raise InputError(log, f"logs of jobs must lie in {results / LOGS}") from error
        rule, place = name.partition("/")[0], log.relative_to(results).as_posix()
        return cls(rule=rule, name=name, log=place, attempts=[], scenario=scenario)

    def path(self, results: Path) -> Path:
        """Path of the record."""
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


def begin_run(results: Path, about: Mapping[str, Any] | None = None) -> None:
    """Name the run of the workflow that begins, so that its attempts can be told from earlier ones, and keep what it is `about`.

    A name and not a time: clocks of machines differ.
    """
    folder = Path(results) / FOLDER
    (folder / GPU_NOTES).unlink(missing_ok=True)
    write_text(folder / RUN_FILE, uuid.uuid4().hex)
    write_text(folder / ASKED, json.dumps(dict(about or {})) + "\n")


def asked(results: Path) -> dict[str, Any]:
    """The last run of the workflow: `command` (words), `only`, `scenarios`, `methods`, `seeds`; empty if unknown."""
    try:
        values = json.loads((Path(results) / FOLDER / ASKED).read_text())
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


def this_run(results: Path) -> str:
    """The name of the current run, or of the last one; empty where there was none."""
    try:
        return (Path(results) / FOLDER / RUN_FILE).read_text().strip()
    except OSError:
        return ""


@functools.cache
def _adapter() -> TypeAdapter[JobRecord]:
    """Building this takes longer than reading a thousand records with it."""
    return TypeAdapter(JobRecord)


def failure_lines(records: Iterable[JobRecord], results: Path) -> list[str]:
    """One line per failed job: its cause, and where its log lies. A job still marked as running counts: its wrapper was killed."""
    lines = []
    for record in records:
        last = record.last
        cause, message = (last.cause, last.message) if record.failed else ("its wrapper or machine vanished", f"on {last.host}")
        if last.outcome != "ok":
            lines.append(f"{record.name}: {cause} (attempt {len(record.attempts)}): {message}; {results / record.log}")
    return lines


def read_jobs(results: Path, damaged: list[str] | None = None) -> list[JobRecord]:
    """The records of all jobs of a results folder, by name.

    Errors of damaged records are added to `damaged`. Without that list, a damaged record raises InputError.
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
