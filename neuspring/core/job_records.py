"""What happened to a job of the workflow: its attempts, causes of failure, time, memory, GPU. Written by the wrapper of jobs.

One JSON file per job at results/jobs/<rule>/<wildcards>.json, beside its log at results/logs/<rule>/<wildcards>.log.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import json
import os
import platform
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Literal

from pydantic import TypeAdapter, ValidationError

from neuspring.config.types import STRICT
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.records import RECORD_FORMAT, read_json

FOLDER, LOGS = "jobs", "logs"
RUN = ".run"
"""File in FOLDER that names the run of the workflow that goes on, or went on last."""
POLL = 0.2
"""s between two looks whether an earlier run of a job has ended."""
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
    run: str = ""
    """The run of the workflow that it belongs to (`begin_run`); empty where a job ran by itself."""
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
    """How much it had to do, in units of its rule (see `neuspring.experiments.plan`)."""

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


def begin_run(results: Path) -> None:
    """Give the run of the workflow that begins a name, by which jobs tell its attempts from earlier ones.

    A name and not a time: clocks of machines differ.
    """
    write_text(Path(results) / FOLDER / RUN, uuid.uuid4().hex)


def this_run(results: Path) -> str:
    """The name of the run that goes on; empty where there has been none."""
    try:
        return (Path(results) / FOLDER / RUN).read_text().strip()
    except OSError:
        return ""


@contextlib.contextmanager
def alone(record: Path, waiting: Callable[[str], object]) -> Iterator[IO[str] | None]:
    """Hold a job against other wrappers of it while its record at `record` is read and written and its command runs.

    Where another one holds it, `waiting` is told once which, and we wait. Gives the file whose lock this is, for the command to
    inherit: the job is then held until both have ended. None where files cannot be made or locked: then nothing is held.
    """
    # Snakemake removes a job's log before it starts the job, so that the log cannot be what is locked.
    path = record.with_name(f"{record.name.removesuffix('.json')}.lock")
    file = _held(path, waiting)
    try:
        yield file
    finally:
        if file:
            # While it is held: whoever opened it meanwhile sees that it is no longer the one at this path.
            with contextlib.suppress(OSError):
                path.unlink()
            file.close()


def _held(path: Path, waiting: Callable[[str], object]) -> IO[str] | None:
    told = False
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = path.open("a+", encoding="utf-8")
        except OSError:  # a disk that is full or read-only ends the job itself, with its name
            return None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                _sign(file)
                return file
        except BlockingIOError:
            if not told:
                file.seek(0)
                holder = file.read().strip() or "not known"
                waiting(f"an earlier run of this job still goes on ({holder}); waiting for its end. If it is gone, delete {path}")
                told = True
            time.sleep(POLL)
        except FileNotFoundError:
            pass  # its holder has just ended and removed it
        except OSError:  # some file systems of a network have no such locks
            file.close()
            return None
        file.close()


def _sign(file: IO[str]) -> None:
    """Say who holds it."""
    with contextlib.suppress(OSError):  # unbuffered: what a full disk does not take must not come back when it is closed
        os.ftruncate(file.fileno(), 0)
        os.write(file.fileno(), f"pid {os.getpid()} on {platform.node()}".encode())


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
