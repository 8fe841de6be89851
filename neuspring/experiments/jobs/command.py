"""Run the command of a job: its output goes to the log, signals are passed on, its use of the machine is measured."""

from __future__ import annotations

import collections
import contextlib
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO

from neuspring.core.job_records import Attempt
from neuspring.experiments.jobs import faults, warm
from neuspring.experiments.jobs.watch import Watch

TAIL = 200
"""Lines of output that are searched for a cause of failure."""


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
            status, fault = faults.not_started(error)
            file.write(f"{error}\n")
            say(f"{fault.cause}: {error}. {fault.remedy}".strip())
            return replace(begun, outcome=fault.outcome, cause=fault.cause, message=str(error), exit=status), fault
        with Watch(process.pid, begun.devices) as watch:
            status, tail = _follow(process, file, quiet=quiet)
    ended = replace(begun, outcome="ok", exit=status, seconds=round(time.monotonic() - start, 3), **watch.facts())
    cause = faults.diagnose(status, tail)
    if cause is None:
        return ended, None
    if quiet:
        _print("".join(tail))
    again = " (may be tried again)" if cause.outcome == "transient" else ""
    say(f"{cause.cause}{again}. {cause.remedy}".strip())
    return replace(ended, outcome=cause.outcome, cause=cause.cause, message=faults.last_words(tail)), cause


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


def _follow(process: subprocess.Popen[str] | warm.WarmProcess, log: _Log, *, quiet: bool) -> tuple[int, list[str]]:
    """(exit status, last lines of the output) of a command, once it has ended."""
    tail: collections.deque[str] = collections.deque(maxlen=TAIL)
    assert process.stdout is not None
    for line in process.stdout:
        tail.append(line)
        log.write(line)
        if not quiet:
            _print(line)
    return process.wait(), list(tail)


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
