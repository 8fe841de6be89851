"""One piece of long work at a time, in the background, with progress, an end, and a way to stop it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from threading import Event, Lock, Thread
from time import monotonic
from typing import Any, Literal, TypeAlias

from neuspring.core.errors import InputError, NumericalFailure

Report: TypeAlias = Callable[[str, int, int], None]
"""What work calls: (what, done, of all). Raises Stopped when the user stopped the work."""


class Stopped(Exception):
    """The user stopped the work."""


class Busy(Exception):
    """Other work has not ended."""


@dataclass(frozen=True)
class State:
    """How the work stands."""

    state: Literal["idle", "running", "done", "failed", "stopped"] = "idle"
    what: str = ""
    done: int = 0
    total: int = 0
    seconds: float = 0.0
    message: str = ""


class Job:
    """At most one piece of work."""

    def __init__(self) -> None:
        self._lock, self._stop, self._state, self._start = Lock(), Event(), State(), 0.0
        self._thread: Thread | None = None

    def start(self, work: Callable[[Report], str]) -> None:
        """Begin; `work` returns the sentence that says what it did. Raises Busy."""
        with self._lock:
            if self._state.state == "running":
                raise Busy("Masks are being carried. Wait for the end, or stop it.")
            self._stop.clear()
            self._state, self._start = State("running"), monotonic()
            self._thread = Thread(target=self._run, args=(work,), daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Ask the work to end at its next report."""
        self._stop.set()

    def join(self) -> None:
        """Wait for the end."""
        if self._thread:
            self._thread.join()

    def plain(self) -> dict[str, Any]:
        """The state as plain JSON values."""
        with self._lock:
            state = self._state
            seconds = monotonic() - self._start if state.state == "running" else state.seconds
        return asdict(replace(state, seconds=seconds))

    @property
    def running(self) -> bool:
        """Whether work goes on."""
        with self._lock:
            return self._state.state == "running"

    def _run(self, work: Callable[[Report], str]) -> None:
        try:
            self._set(state="done", message=work(self._report))
        except Stopped:
            self._set(state="stopped", message="Stopped. Earlier results are kept.")
        except (InputError, NumericalFailure) as error:
            self._set(state="failed", message=str(error))
        except Exception as error:  # the thread's end: the page must hear of it, and the terminal gets the trace
            logging.getLogger(__name__).exception("the work failed")
            self._set(state="failed", message=f"{type(error).__name__}: {error}. The terminal shows where.")

    def _report(self, what: str, done: int, total: int) -> None:
        if self._stop.is_set():
            raise Stopped
        self._set(what=what, done=done, total=total)

    def _set(self, **changes: Any) -> None:
        with self._lock:
            self._state = replace(self._state, seconds=monotonic() - self._start, **changes)
