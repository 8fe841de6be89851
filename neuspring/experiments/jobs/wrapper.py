"""`python -m neuspring.experiments.jobs.wrapper ... -- COMMAND`: run one job of the workflow.

Leases the GPUs that the job needs, runs its command, and writes its record (`neuspring.core.job_records`), with the cause if it
fails. A job that failed for a reason that trying again cannot mend is not tried again. Imports nothing heavy: every job starts
here.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import os
import platform
import resource
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

import psutil

from neuspring.core.errors import InputError
from neuspring.core.job_records import FOLDER, GPU_NOTES, LOGS, Attempt, JobRecord, this_run
from neuspring.core.lock import try_lock
from neuspring.experiments.jobs import faults, gpus, warm

TAIL_LINES = 200
"""Lines of output that are searched for a cause of failure."""
INTERVAL, MOST_SAMPLES = 1.0, 120
"""s between the first samples; the number of rows at which every second one is dropped and the interval doubles."""
MIB = 2**20
GIVEN = "given"
POOL, GPU_SHARE = "NEUSPRING_GPUS", "NEUSPRING_JOBS_PER_GPU"
"""Environment: the devices that jobs share (or `given`: a cluster has chosen this job's), how many jobs a device takes."""
JOB_POLL = 0.2
"""s between two looks whether an earlier run of a job has ended."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status (1 if a signal ended it)."""
    program = "python -m neuspring.experiments.jobs.wrapper"
    parser = argparse.ArgumentParser(prog=program, description="Run one job of the workflow.")
    parser.add_argument("--log", type=Path, required=True, help="its log, under <results>/logs/<rule>/")
    parser.add_argument("--gpus", type=int, default=0, help="GPUs that it needs")
    parser.add_argument("--scenario", default="", help="its scenario")
    parser.add_argument("--quiet", action="store_true", help="write output to the log alone")
    parser.add_argument("--stamp", default="", help="what its record holds once it has succeeded")
    parser.add_argument("command", nargs=argparse.REMAINDER)
    a = parser.parse_args(arguments)
    command = a.command[1:] if a.command[:1] == ["--"] else a.command
    if not command:
        parser.error("a command is required after --")
    try:
        results = next((folder.parent for folder in a.log.parents if folder.name == LOGS), None)
        if results is None:
            raise InputError(a.log, f"the log of a job must lie in a folder {LOGS} of the results")
        record = replace(JobRecord.of_log(results, a.log, a.scenario), stamp=a.stamp)
        # A job runs once at a time: wrapper and command may outlive Snakemake, and meet those of the next run at the same files.
        with alone(record.path(results), say) as lock:
            return _run(command, record, results, lock, gpu_count=a.gpus, quiet=a.quiet)
    except (InputError, TimeoutError) as error:
        print(f"neuspring: error: {error}", file=sys.stderr)
        return faults.BAD_INPUT


@contextlib.contextmanager
def alone(record: Path, waiting: Callable[[str], object]) -> Iterator[IO[str] | None]:
    """Lock a job, whose record is at `record`, against other wrappers of it.

    If another wrapper holds the lock, `waiting` is told so once, and we wait. Yields the locked file, for the command to inherit:
    the job stays locked until both have ended. Yields None, and locks nothing, where files cannot be made or locked.
    """
    # Snakemake removes a job's log before it starts the job, so the log cannot be the locked file.
    path, file, told = record.with_suffix(".lock"), None, False
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while (file := try_lock(path)) is None:
            if not told:
                waiting(f"an earlier run of this job still goes on; waiting for its end. If it is gone, delete {path}")
            told = True
            time.sleep(JOB_POLL)
    except OSError:  # a full or read-only disk ends the job itself, with its name; some network file systems have no locks
        pass
    try:
        yield file
    finally:
        if file:
            # Removed before it is unlocked: whoever opened it meanwhile sees that it is no longer the file at this path.
            with contextlib.suppress(OSError):
                path.unlink()
            file.close()


def _run(command: Sequence[str], record: JobRecord, results: Path, lock: IO[str] | None, *, gpu_count: int, quiet: bool) -> int:
    """Run a job whose record has no attempts yet; returns its exit status (1 if a signal ended it). Its stamp is for success.

    Raises InputError if it needs more GPUs than there are.
    """
    earlier: list[Attempt] = []
    with contextlib.suppress(InputError):  # none yet, or a record that a full disk cut short
        # Read under the lock: an earlier run may just have written them.
        earlier = JobRecord.load(record.path(results)).attempts
    this = this_run(results)
    if this and earlier and earlier[-1].outcome == "permanent" and earlier[-1].run == this:
        # Snakemake cannot tell causes apart; its second try ends here.
        print(f"not tried again ({earlier[-1].cause}; said above)", file=sys.stderr)
        return earlier[-1].exit or 1

    def save(attempt: Attempt) -> None:
        try:
            replace(record, attempts=[*earlier, attempt], stamp=record.stamp if attempt.outcome == "ok" else "").save(results)
        except (OSError, InputError) as error:
            print(f"warning: the record of this job could not be written: {error}", file=sys.stderr)

    pool, lease = os.environ.get(POOL, ""), None
    try:
        if gpu_count and pool != GIVEN:
            names = [name for name in pool.split(",") if name] or gpus.visible_devices()
            share, notes = int(os.environ.get(GPU_SHARE, "1")), results / FOLDER / GPU_NOTES if this else None
            lease = gpus.acquire(gpu_count, names, jobs_per_gpu=share, notes=notes, say=say)
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
        ended, fault = execute(command, results / record.log, begun, os.environ | own, locks, quiet=quiet)
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


def _now() -> str:
    """UTC, with milliseconds: leases follow one another closely."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def execute(
    command: Sequence[str], log: Path, begun: Attempt, environment: Mapping[str, str], locks: Sequence[IO[str]], *, quiet: bool
) -> tuple[Attempt, faults.Fault | None]:
    """Run a command, which inherits `locks`, to its end: (the finished attempt, why it failed if it did).

    Its output goes to the log, signals are passed on to it, its use of the machine is sampled from outside. `quiet`: the output
    goes to the log alone.
    """
    write = _log(log)
    write(f"# {begun.started} {shlex.join(command)}\n")
    start = time.monotonic()
    try:
        process = warm.start(command, locks, environment) or subprocess.Popen(
            command,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            bufsize=1,
            pass_fds=[file.fileno() for file in locks],
            preexec_fn=warm.die_with_parent,
        )
    except OSError as error:
        status, refused = faults.not_started(error)
        write(f"{error}\n")
        say(f"{refused.cause}: {error}. {refused.remedy}".strip())
        return replace(begun, outcome=refused.outcome, cause=refused.cause, message=str(error), exit=status), refused
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda received, frame: process.send_signal(received))
    tail: collections.deque[str] = collections.deque(maxlen=TAIL_LINES)
    assert process.stdout is not None
    with Watch(process.pid, begun.devices) as watch:
        for line in process.stdout:
            tail.append(line)
            write(line)
            if not quiet:
                _print(line)
        status = process.wait()
    ended = replace(begun, outcome="ok", exit=status, seconds=round(time.monotonic() - start, 3), **watch.facts())
    if (fault := faults.diagnose(status, list(tail))) is None:
        return ended, None
    again, message = " (may be tried again)" if fault.outcome == "transient" else "", faults.last_words(list(tail))
    say(f"{fault.cause}{again}: {message} {fault.remedy}".rstrip() + f" (log: {log})")
    return replace(ended, outcome=fault.outcome, cause=fault.cause, message=message), fault


def say(text: str) -> None:
    """Tell whoever watches the workflow; the log is the command's."""
    with contextlib.suppress(OSError):  # a terminal that is gone must not end the job
        print(text, file=sys.stderr, flush=True)


def _print(text: str) -> None:
    """Print; a terminal that is gone, or a full disk behind our own output, must not end the job."""
    try:
        print(text, end="", flush=True)
    except OSError:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - for as long as this process lives


def _log(path: Path) -> Callable[[str], None]:
    """Writer that appends to a log. A log that cannot be written is a warning: on a full disk the job's own error counts."""
    file: IO[bytes] | None = None

    def write(text: str) -> None:
        nonlocal file
        try:
            if file:
                file.write(text.encode())
        except OSError as error:
            say(f"warning: {path}: {error.strerror}")
            file = None

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("ab", buffering=0)  # unbuffered: nothing is left to fail when it is closed
    except OSError as error:
        say(f"warning: {path}: {error.strerror}")
    return write


class Watch:
    """Samples a process tree and GPUs in a thread, for the length of a `with` block."""

    def __init__(self, pid: int, devices: Sequence[str]) -> None:
        self._pid, self._devices = pid, tuple(devices)
        self._rows: list[list[float | None]] = []
        self._peak = 0.0
        self._cpu: dict[int, float] = {}
        self._names: list[str] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._sample, daemon=True)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def facts(self) -> dict[str, Any]:
        """The fields of an `Attempt` that describe the use of the machine. Call this after the block."""
        # Samples miss short peaks; the kernel remembers the peak of the largest ended process.
        largest = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / (1024 if sys.platform != "darwin" else MIB)
        shares = [row[3] for row in self._rows if row[3] is not None]
        return {
            "peak_memory_mb": round(max(self._peak, largest), 1),
            "cpu_seconds": round(sum(self._cpu.values()), 2),
            "samples": self._rows,
            "device_names": self._names,
            "peak_gpu_memory_mb": max((row[4] for row in self._rows if row[4] is not None), default=None),
            "gpu_utilization": round(sum(shares) / len(shares), 1) if shares else None,
        }

    def _sample(self) -> None:
        start = last = time.monotonic()
        interval, before = INTERVAL, 0.0
        handles: list[Any] = []
        library: Any
        with gpus.nvml() if self._devices else contextlib.nullcontext() as library:
            for device in self._devices if library else ():
                with contextlib.suppress(Exception):  # a MIG slice: NVML does not measure it by this name
                    handles.append(gpus.handle_of(library, device))
                    self._names.append(str(library.nvmlDeviceGetName(handles[-1])))
            while True:
                # A short first wait, so that jobs of a second are seen too.
                ended = self._stop.wait(interval if self._rows else 0.1)
                moment = time.monotonic()
                memory, cpu = self._tree()
                self._peak = max(self._peak, memory)
                share = 100 * (cpu - before) / max(moment - last, 1e-3)
                if not ended or not self._rows:
                    gpu: list[float | None] = [None, None]
                    with contextlib.suppress(Exception):  # a device may be lost while it is watched; the command will say so
                        rates = [library.nvmlDeviceGetUtilizationRates(handle).gpu for handle in handles]
                        used = [library.nvmlDeviceGetMemoryInfo(handle).used / MIB for handle in handles]
                        gpu = [sum(rates) / len(rates), round(sum(used), 1)] if handles else gpu
                    self._rows.append([round(moment - start, 2), round(max(share, 0.0), 1), round(memory, 1), *gpu])
                last, before = moment, cpu
                if ended:
                    return
                if len(self._rows) >= MOST_SAMPLES:
                    del self._rows[::2]
                    interval *= 2

    def _tree(self) -> tuple[float, float]:
        """(resident MiB, CPU seconds) of the process and its children. The seconds include ended children."""
        memory = 0.0
        with contextlib.suppress(psutil.Error):
            root = psutil.Process(self._pid)
            for process in (root, *root.children(recursive=True)):
                with contextlib.suppress(psutil.Error):
                    times = process.cpu_times()
                    self._cpu[process.pid] = times.user + times.system
                    memory += process.memory_info().rss / MIB
        return memory, sum(self._cpu.values())


if __name__ == "__main__":
    raise SystemExit(main())
