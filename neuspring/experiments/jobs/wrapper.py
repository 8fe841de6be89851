"""`python -m neuspring.experiments.jobs.wrapper ... -- COMMAND`: run one job of the workflow.

Leases the GPUs that the job needs, runs its command, and writes its record (`neuspring.core.job_records`), with the cause if it
fails. A job that failed for a reason that trying again cannot mend is not tried again. Imports nothing heavy: every job starts
here.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from neuspring.core.errors import InputError
from neuspring.core.job_records import FOLDER, GPU_NOTES, LOGS, Attempt, JobRecord, this_run
from neuspring.core.lock import try_lock
from neuspring.experiments.jobs import faults, gpus
from neuspring.experiments.jobs.command import execute, say

GIVEN = "given"
POOL, SHARE = "NEUSPRING_GPUS", "NEUSPRING_JOBS_PER_GPU"
"""Environment: the devices that jobs share (or `given`: a cluster has chosen this job's), how many jobs a device takes."""
POLL = 0.2
"""s between two looks whether an earlier run of a job has ended."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status (1 if a signal ended it)."""
    parser = argparse.ArgumentParser(
        prog="python -m neuspring.experiments.jobs.wrapper", description="Run one job of the workflow."
    )
    parser.add_argument("--log", type=Path, required=True, help="its log, under <results>/logs/<rule>/")
    parser.add_argument("--gpus", type=int, default=0, help="GPUs that it needs")
    parser.add_argument("--scenario", default="", help="its scenario; jobs of one scenario prefer the same GPU")
    parser.add_argument("--quiet", action="store_true", help="write output to the log alone, unless the command fails")
    parser.add_argument("command", nargs=argparse.REMAINDER)
    a = parser.parse_args(arguments)
    command = a.command[1:] if a.command[:1] == ["--"] else a.command
    if not command:
        parser.error("a command is required after --")
    try:
        results = next((folder.parent for folder in a.log.parents if folder.name == LOGS), None)
        if results is None:
            raise InputError(a.log, f"the log of a job must lie in a folder {LOGS} of the results")
        record = JobRecord.of_log(results, a.log, a.scenario)
        # A job runs once at a time: wrapper and command may outlive Snakemake, and meet those of the next run at the same files.
        with alone(record.path(results), say) as lock:
            return _run(command, record, results, lock, gpu_count=a.gpus, quiet=a.quiet)
    except (InputError, TimeoutError) as error:
        print(f"neuspring: error: {error}", file=sys.stderr)
        return faults.BAD_INPUT


@contextlib.contextmanager
def alone(record: Path, waiting: Callable[[str], object]) -> Iterator[IO[str] | None]:
    """Lock a job, whose record is at `record`, against other wrappers of it.

    If another wrapper holds the lock, `waiting` is told once which one, and we wait. Yields the locked file, for the command to
    inherit: the job stays locked until both have ended. Yields None, and locks nothing, where files cannot be made or locked.
    """
    # Snakemake removes a job's log before it starts the job, so the log cannot be the locked file.
    path = record.with_name(f"{record.name.removesuffix('.json')}.lock")
    try:
        file = _locked(path, waiting)
    except OSError:  # a full or read-only disk ends the job itself, with its name; some network file systems have no locks
        file = None
    try:
        yield file
    finally:
        if file:
            # Removed before it is unlocked: whoever opened it meanwhile sees that it is no longer the file at this path.
            with contextlib.suppress(OSError):
                path.unlink()
            file.close()


def _locked(path: Path, waiting: Callable[[str], object]) -> IO[str]:
    """Wait until the file at `path` is locked, and write into it who holds it. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    file = try_lock(path)
    if file is None:
        holder = ""
        with contextlib.suppress(FileNotFoundError):
            holder = path.read_text(encoding="utf-8").strip()
        waiting(
            f"an earlier run of this job still goes on ({holder or 'not known'}); waiting for its end. If it is gone, delete {path}"
        )
    while file is None:
        time.sleep(POLL)
        file = try_lock(path)
    with contextlib.suppress(OSError):  # unbuffered: the file's own close must not try again what a full disk refused
        os.ftruncate(file.fileno(), 0)
        os.write(file.fileno(), f"pid {os.getpid()} on {platform.node()}".encode())
    return file


def _run(command: Sequence[str], record: JobRecord, results: Path, lock: IO[str] | None, *, gpu_count: int, quiet: bool) -> int:
    """Run a job whose record has no attempts yet; returns its exit status (1 if a signal ended it).

    Raises InputError if it needs more GPUs than there are.
    """
    earlier: list[Attempt] = []
    with contextlib.suppress(InputError):  # none yet, or a record that a full disk cut short
        # Read under the lock: an earlier run may just have written them.
        earlier = JobRecord.load(record.path(results)).attempts
    this = this_run(results)
    if this and earlier and earlier[-1].outcome == "permanent" and earlier[-1].run == this:
        # Snakemake cannot tell causes apart; its second try ends here.
        print(f"not tried again ({earlier[-1].cause}): {earlier[-1].message}", file=sys.stderr)
        return earlier[-1].exit or 1

    def save(attempt: Attempt) -> None:
        try:
            replace(record, attempts=[*earlier, attempt]).save(results)
        except (OSError, InputError) as error:
            print(f"warning: the record of this job could not be written: {error}", file=sys.stderr)

    try:
        lease = _lease(gpu_count, record.scenario, results / FOLDER / GPU_NOTES if this else None)
    except (InputError, TimeoutError) as error:
        save(Attempt(started=_now(), run=this, outcome="permanent", cause="no GPU", message=str(error), exit=faults.BAD_INPUT))
        raise
    try:
        devices = list(lease.devices) if lease else list(gpus.visible_devices()) if gpu_count else []
        waited = round(lease.waited, 3) if lease else 0.0
        begun = Attempt(started=_now(), run=this, host=platform.node(), devices=devices, waited=waited)
        save(begun)
        # A job sees its own GPUs, and none if it asked for none.
        own = lease.environment() if lease else {} if gpu_count else {gpus.VISIBLE: ""}
        # The command holds lock and slots too: they are free when it has ended, even if this process dies first.
        locks = [*([lock] if lock else []), *(lease.files if lease else ())]
        log = results / record.log
        ended, fault = execute(command, log, begun, environment=os.environ | own, locks=locks, quiet=quiet)
        save(ended)
        if lease and (fault is None or fault.device):
            try:
                lease.note(fault.device if fault else "")
            except OSError as error:
                say(f"warning: what became of GPU {', '.join(lease.devices)} could not be noted: {error}")
    finally:
        if lease:
            lease.release()
    assert ended.exit is not None
    return ended.exit if ended.exit >= 0 else 1


def _lease(count: int, scenario: str, notes: Path | None) -> gpus.Lease | None:
    """GPUs of this machine; None where none is needed or a cluster has chosen them."""
    pool = os.environ.get(POOL, "")
    if not count or pool == GIVEN:
        return None
    names = [name for name in pool.split(",") if name] or gpus.visible_devices()
    share = int(os.environ.get(SHARE, "1"))
    return gpus.acquire(count, names, jobs_per_gpu=share, affinity=scenario, notes=notes, say=say)


def _now() -> str:
    """UTC, with milliseconds: leases follow one another closely."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


if __name__ == "__main__":
    raise SystemExit(main())
