"""Run the command of a job: its output goes to the log, signals are passed on, its use of the machine is sampled from outside."""

from __future__ import annotations

import collections
import contextlib
import os
import resource
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import psutil

from neuspring.core.job_records import Attempt
from neuspring.experiments.jobs import faults, gpus, warm

TAIL = 200
"""Lines of output that are searched for a cause of failure."""
INTERVAL, MOST = 1.0, 120
"""s between the first samples; the number of rows at which every second one is dropped and the interval doubles."""
MIB = 2**20


def execute(
    command: Sequence[str],
    log: Path,
    begun: Attempt,
    *,
    environment: Mapping[str, str],
    locks: Sequence[IO[str]] = (),
    quiet: bool = False,
) -> tuple[Attempt, faults.Fault | None]:
    """Run a command, which inherits `locks`, to its end: (the finished attempt, why it failed if it did).

    `quiet`: the output goes to the log alone, unless the command fails.
    """
    with contextlib.closing(_Log(log)) as file:
        file.write(f"# {begun.started} {shlex.join(command)}\n")
        start = time.monotonic()
        try:
            process = _start(command, locks, environment)
        except OSError as error:
            status, refused = faults.not_started(error)
            file.write(f"{error}\n")
            say(f"{refused.cause}: {error}. {refused.remedy}".strip())
            return replace(begun, outcome=refused.outcome, cause=refused.cause, message=str(error), exit=status), refused
        tail: collections.deque[str] = collections.deque(maxlen=TAIL)
        assert process.stdout is not None
        with Watch(process.pid, begun.devices) as watch:
            for line in process.stdout:
                tail.append(line)
                file.write(line)
                if not quiet:
                    _print(line)
            status = process.wait()
    ended = replace(begun, outcome="ok", exit=status, seconds=round(time.monotonic() - start, 3), **watch.facts())
    fault = faults.diagnose(status, list(tail))
    if fault is None:
        return ended, None
    if quiet:
        _print("".join(tail))
    again = " (may be tried again)" if fault.outcome == "transient" else ""
    say(f"{fault.cause}{again}. {fault.remedy}".strip())
    return replace(ended, outcome=fault.outcome, cause=fault.cause, message=faults.last_words(list(tail))), fault


def say(text: str) -> None:
    """Tell whoever watches the workflow; the log is the command's."""
    with contextlib.suppress(OSError):  # a terminal that is gone must not end the job
        print(text, file=sys.stderr, flush=True)


def _start(
    command: Sequence[str], locks: Sequence[IO[str]], environment: Mapping[str, str]
) -> subprocess.Popen[str] | warm.WarmProcess:
    """Start a command; signals that this process receives are passed on to it. Raises OSError."""
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
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda received, frame: process.send_signal(received))
    return process


def _print(text: str) -> None:
    """Print; a terminal that is gone, or a full disk behind our own output, must not end the job."""
    try:
        print(text, end="", flush=True)
    except OSError:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - for as long as this process lives


class _Log:
    """The log, appended to. A log that cannot be written is a warning: on a full disk the job's own error counts."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: IO[bytes] = path.open("ab", buffering=0)  # unbuffered: nothing is left to fail when it is closed
        except OSError as error:
            self._drop(error)

    def write(self, text: str) -> None:
        try:
            self._file.write(text.encode())
        except OSError as error:
            self._file.close()
            self._drop(error)

    def _drop(self, error: OSError) -> None:
        print(f"warning: {self._path}: {error.strerror}", file=sys.stderr)
        self._file = open(os.devnull, "wb")  # noqa: SIM115 - closed by `close`

    def close(self) -> None:
        self._file.close()


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
        memory = [row[4] for row in self._rows if row[4] is not None]
        return {
            "peak_memory_mb": round(max(self._peak, largest), 1),
            "cpu_seconds": round(sum(self._cpu.values()), 2),
            "samples": self._rows,
            "device_names": self._names,
            "peak_gpu_memory_mb": max(memory) if memory else None,
            "gpu_utilization": round(sum(shares) / len(shares), 1) if shares else None,
        }

    def _sample(self) -> None:
        start = last = time.monotonic()
        interval, before = INTERVAL, 0.0
        with gpus.nvml() if self._devices else contextlib.nullcontext() as library:
            handles = self._handles(library)
            while True:
                # A short first wait, so that jobs of a second are seen too.
                ended = self._stop.wait(interval if self._rows else 0.1)
                moment = time.monotonic()
                memory, cpu = self._tree()
                self._peak = max(self._peak, memory)
                share = 100 * (cpu - before) / max(moment - last, 1e-3)
                if not ended or not self._rows:
                    gpu = _gpu(library, handles)
                    self._rows.append([round(moment - start, 2), round(max(share, 0.0), 1), round(memory, 1), *gpu])
                last, before = moment, cpu
                if ended:
                    return
                if len(self._rows) >= MOST:
                    del self._rows[::2]
                    interval *= 2

    def _handles(self, library: Any) -> list[Any]:
        if library is None:
            return []
        handles = []
        for device in self._devices:
            with contextlib.suppress(Exception):  # a MIG slice: NVML does not measure it by this name
                handle = gpus.handle_of(library, device)
                self._names.append(str(library.nvmlDeviceGetName(handle)))
                handles.append(handle)
        return handles

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


def _gpu(library: Any, handles: Sequence[Any]) -> tuple[float | None, float | None]:
    """(mean utilization %, memory in use MiB) of the leased devices."""
    if not handles:
        return None, None
    try:
        rates = [library.nvmlDeviceGetUtilizationRates(handle).gpu for handle in handles]
        memory = [library.nvmlDeviceGetMemoryInfo(handle).used / MIB for handle in handles]
    except Exception:  # a device may be lost while it is watched; the command will say so
        return None, None
    return sum(rates) / len(rates), round(sum(memory), 1)
