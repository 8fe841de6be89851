"""`python -m neuspring.experiments.jobs.wrapper ... -- COMMAND`: run one job of the workflow.

Holds the GPUs that the job needs, keeps its output in its log, watches its time and memory, and writes its record
(`job_records`), with the cause if it fails. A job that failed for a reason that trying again cannot mend is not tried again.
Imports nothing heavy: this is the start of every job.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import os
import platform
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from neuspring.core.errors import InputError
from neuspring.core.job_records import LOGS, Attempt, JobRecord, alone, this_run
from neuspring.experiments.jobs import faults, gpus, warm
from neuspring.experiments.jobs.watch import Watch

GIVEN = "given"
POOL, SHARE = "NEUSPRING_GPUS", "NEUSPRING_JOBS_PER_GPU"
"""Environment: the devices that jobs share (or `given`: a cluster has chosen this job's), how many jobs a device takes."""
KEPT = 200
"""Lines of output that are kept to find a cause in."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status (1 if a signal ended it)."""
    parser = argparse.ArgumentParser(
        prog="python -m neuspring.experiments.jobs.wrapper", description="Run one job of the workflow."
    )
    parser.add_argument("--log", type=Path, required=True, help="its log, under <results>/logs/<rule>/")
    parser.add_argument("--gpus", type=int, default=0, help="GPUs that it needs")
    parser.add_argument("--scenario", default="", help="its scenario; jobs of one prefer the same GPU")
    parser.add_argument("--work", type=float, default=1.0, help="how much it has to do, in units of its rule")
    parser.add_argument("--quiet", action="store_true", help="output goes to the log alone, unless it fails")
    parser.add_argument("command", nargs=argparse.REMAINDER)
    a = parser.parse_args(arguments)
    command = a.command[1:] if a.command[:1] == ["--"] else a.command
    if not command:
        parser.error("a command is required after --")
    try:
        results = _results(a.log)
        job = Job(
            command=tuple(command),
            record=JobRecord.of_log(results, a.log, a.scenario, a.work),
            results=results,
            log=a.log,
            gpus=a.gpus,
            quiet=a.quiet,
        )
        return run(job)
    except (InputError, TimeoutError) as error:
        print(f"neuspring: error: {error}", file=sys.stderr)
        return faults.BAD_INPUT


@dataclass(frozen=True, kw_only=True)
class Job:
    """A command of the workflow and where its traces go."""

    command: tuple[str, ...]
    record: JobRecord
    """Without attempts."""
    results: Path
    log: Path
    gpus: int = 0
    quiet: bool = False


def run(job: Job) -> int:
    """Run a job; returns its exit status (1 if a signal ended it). Raises InputError if it needs more GPUs than there are.

    One run of a job at a time: a wrapper and its command may outlive Snakemake, and meet those of the next run at the same files.
    """
    with alone(job.record.path(job.results), _say) as lock:
        return _run(job, lock)


def _run(job: Job, lock: IO[str] | None) -> int:
    # Only now: an earlier run may just have written them.
    record = replace(job.record, attempts=_earlier(job.record.path(job.results)))
    this = this_run(job.results)
    if this and record.attempts and record.last.outcome == "permanent" and record.last.run == this:
        # The workflow cannot tell causes apart; its second try ends here.
        print(f"not tried again ({record.last.cause}): {record.last.message}", file=sys.stderr)
        return record.last.exit or 1
    try:
        lease = _lease(job)
    except (InputError, TimeoutError) as error:
        refused = Attempt(
            started=_moment(), run=this, outcome="permanent", cause="no GPU", message=str(error), exit=faults.BAD_INPUT
        )
        _save(record, refused, job.results)
        raise
    try:
        devices, waited = (list(lease.devices), round(lease.waited, 3)) if lease else (_given(job), 0.0)
        begun = Attempt(started=_moment(), run=this, host=platform.node(), devices=devices, waited=waited)
        _save(record, begun, job.results)
        # The command holds lock and slots too: they are free when it has ended, even if this process dies first.
        held = [*([lock] if lock else []), *(lease.files if lease else ())]
        ended, fault = _execute(job, held, _environment(job, lease), begun)
        _save(record, ended, job.results)
        if lease:
            _judge(lease, fault)
    finally:
        if lease:
            lease.release()
    assert ended.exit is not None
    return ended.exit if ended.exit >= 0 else 1


def _results(log: Path) -> Path:
    """The results folder of a log."""
    for parent in log.parents:
        if parent.name == LOGS:
            return parent.parent
    raise InputError(log, f"the log of a job must lie in a folder {LOGS} of the results")


def _earlier(path: Path) -> list[Attempt]:
    try:
        return JobRecord.load(path).attempts
    except InputError:
        return []  # none yet, or a record that a full disk cut short


def _save(record: JobRecord, attempt: Attempt, results: Path) -> None:
    """The earlier attempts and this one. A record that cannot be written must not fail the job that it is about."""
    try:
        replace(record, attempts=[*record.attempts, attempt]).save(results)
    except (OSError, InputError) as error:
        print(f"warning: the record of this job could not be written: {error}", file=sys.stderr)


def _lease(job: Job) -> gpus.Lease | None:
    """GPUs of this machine; None where none is needed or a cluster has chosen them."""
    pool = os.environ.get(POOL, "")
    if not job.gpus or pool == GIVEN:
        return None
    names = [name for name in pool.split(",") if name] or gpus.visible_devices()

    def waiting() -> None:
        _say(f"waiting for {job.gpus} of the GPUs {', '.join(names)}")

    def passing(marks: Mapping[str, gpus.Mark]) -> None:
        _say("passed over: " + ", ".join(f"GPU {device} ({mark})" for device, mark in marks.items()))

    share = int(os.environ.get(SHARE, "1"))
    affinity = job.record.scenario
    return gpus.acquire(job.gpus, names, jobs_per_gpu=share, affinity=affinity, waiting=waiting, passing=passing)


def _judge(lease: gpus.Lease, fault: faults.Fault | None) -> None:
    """Note what the end of a job says about its GPUs, for the jobs after it."""
    try:
        if fault is None:
            lease.worked()
        elif fault.device:
            lease.lost(gone=fault.device == "lost")
    except OSError as error:
        _say(f"warning: what became of GPU {', '.join(lease.devices)} could not be noted: {error}")


def _say(text: str) -> None:
    """Tell whoever watches the workflow; the log is the command's."""
    with contextlib.suppress(OSError):  # a terminal that is gone must not end the job
        print(text, file=sys.stderr, flush=True)


def _moment() -> str:
    """UTC, with milliseconds: leases follow one another closely."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _given(job: Job) -> list[str]:
    return list(gpus.visible_devices()) if job.gpus else []


def _environment(job: Job, lease: gpus.Lease | None) -> dict[str, str]:
    """The command's: its GPUs alone; none where it asked for none, whatever a library would take by itself."""
    if lease:
        return os.environ | lease.environment()
    return dict(os.environ) if job.gpus else os.environ | {gpus.VISIBLE: ""}


def _execute(
    job: Job, held: Sequence[IO[str]], environment: Mapping[str, str], begun: Attempt
) -> tuple[Attempt, faults.Fault | None]:
    """Run the command, its output into the log and our own; returns the finished attempt, and why it failed if it did."""
    with _Log(job.log) as log:
        log.write(f"# {begun.started} {shlex.join(job.command)}\n")
        start = time.monotonic()
        try:
            process = _start(job.command, held, environment)
        except OSError as error:
            status, reason = faults.not_started(error)
            log.write(f"{error}\n")
            _say(f"{reason.cause}: {error}. {reason.remedy}".strip())
            return replace(begun, outcome=reason.outcome, cause=reason.cause, message=str(error), exit=status), reason
        with Watch(process.pid, begun.devices) as watch:
            status, kept = _follow(process, log, quiet=job.quiet)
    ended = replace(begun, outcome="ok", exit=status, seconds=round(time.monotonic() - start, 3), **watch.facts())
    fault = faults.diagnose(status, kept)
    if fault is None:
        return ended, None
    if job.quiet:
        _tell("".join(kept))
    again = " (may be tried again)" if fault.outcome == "transient" else ""
    _say(f"{fault.cause}{again}. {fault.remedy}".strip())
    return replace(ended, outcome=fault.outcome, cause=fault.cause, message=faults.last_words(kept)), fault


def _start(
    command: Sequence[str], held: Sequence[IO[str]], environment: Mapping[str, str]
) -> subprocess.Popen[str] | warm.WarmProcess:
    """Start a command, which inherits `held`; signals that we get are passed on to it. Raises OSError."""
    process = warm.start(command, held, environment) or subprocess.Popen(
        command,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        bufsize=1,
        pass_fds=[file.fileno() for file in held],
        preexec_fn=warm.die_with_parent,
    )
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda received, frame: process.send_signal(received))
    return process


def _follow(process: subprocess.Popen[str] | warm.WarmProcess, log: _Log, *, quiet: bool) -> tuple[int, list[str]]:
    """(exit status, last lines of the output) of a command, once it has ended."""
    kept: collections.deque[str] = collections.deque(maxlen=KEPT)
    assert process.stdout is not None
    for line in process.stdout:
        kept.append(line)
        log.write(line)
        if not quiet:
            _tell(line)
    return process.wait(), list(kept)


def _tell(text: str) -> None:
    """Print; a terminal that is gone, or a full disk behind our own output, must not end the job."""
    try:
        print(text, end="", flush=True)
    except OSError:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - for as long as this process lives


class _Log:
    """The log, appended to. Where the disk is full the job's own error counts, not the log's."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> _Log:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._file: IO[str] | None = self._path.open("a", encoding="utf-8", buffering=1)
        except OSError as error:
            print(f"warning: {self._path}: {error.strerror}", file=sys.stderr)
            self._file = None
        return self

    def write(self, text: str) -> None:
        if self._file is None:
            return
        try:
            self._file.write(text)
        except OSError as error:
            print(f"warning: {self._path}: {error.strerror}", file=sys.stderr)
            self._drop()

    def _drop(self) -> None:
        file, self._file = self._file, None
        try:
            if file is not None:
                file.close()
        except OSError:
            pass  # what it still held could not be written either

    def __exit__(self, *_: object) -> None:
        self._drop()


if __name__ == "__main__":
    raise SystemExit(main())
