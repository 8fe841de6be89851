"""How far a run of the workflow is: one line per rule when its last job has ended, and on a terminal a line that moves."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO

from neuspring.core.errors import InputError
from neuspring.core.job_records import JobRecord, this_run

EVERY = 1.0
"""s between two looks at the records of jobs."""


class Overview:
    """Watches the records of the jobs of one run, in a thread of its own, until `stop`."""

    def __init__(self, results: Path, logs: Iterable[Path], stream: IO[str] | None = None) -> None:
        self._results, self._stream = results, stream or sys.stdout
        self._waiting: dict[str, set[Path]] = {}
        for log in logs:
            record = JobRecord.of_log(results, log)
            self._waiting.setdefault(record.rule, set()).add(record.path(results))
        self._counts = {rule: len(paths) for rule, paths in self._waiting.items()}
        self._seconds = dict.fromkeys(self._counts, 0.0)
        self._begun, self._run = time.monotonic(), this_run(results)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def start(self) -> None:
        """Begin to watch."""
        self._thread.start()

    def stop(self) -> None:
        """Tell what has ended since the last look, and end."""
        self._stopped.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._stopped.wait(EVERY):
            self._look()
        self._look()
        self._clear()

    def _look(self) -> None:
        for rule in list(self._waiting):
            ended = {path: seconds for path in self._waiting[rule] if (seconds := self._ended(path)) is not None}
            self._waiting[rule] -= set(ended)
            self._seconds[rule] += sum(ended.values())
            if not self._waiting[rule]:
                del self._waiting[rule]
                count = self._counts[rule]
                self._print(f"{rule:<17} {count:>5} job{'s' if count > 1 else ' '} {self._seconds[rule]:>8.0f} s")
        if self._stream.isatty():
            self._move(_status_line(self._counts, {rule: len(paths) for rule, paths in self._waiting.items()}))

    def _ended(self, path: Path) -> float | None:
        """Seconds that a job of this run took; None while it has not succeeded."""
        try:
            last = JobRecord.load(path).last
        except (InputError, IndexError):
            return None
        return last.seconds if last.run == self._run and last.outcome == "ok" else None

    def _print(self, line: str) -> None:
        self._clear()
        print(line, file=self._stream, flush=True)

    def _move(self, text: str) -> None:
        minutes, seconds = divmod(round(time.monotonic() - self._begun), 60)
        print(f"\r\x1b[K{text}  {minutes}:{seconds:02}", end="", file=self._stream, flush=True)

    def _clear(self) -> None:
        if self._stream.isatty():
            print("\r\x1b[K", end="", file=self._stream, flush=True)


def _status_line(counts: Mapping[str, int], waiting: Mapping[str, int]) -> str:
    """Jobs that have ended, of all and of the rules that have begun."""
    total = sum(counts.values())
    begun = [f"{rule} {counts[rule] - left}/{counts[rule]}" for rule, left in waiting.items() if left < counts[rule]]
    return "  ".join([f"{total - sum(waiting.values())}/{total} jobs", *begun])
