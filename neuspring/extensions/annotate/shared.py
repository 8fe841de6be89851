"""State that all tabs share: a file that each tab may edit, and one background job at a time."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from pathlib import Path
from threading import Event, Lock, Thread
from time import monotonic
from typing import Any, Generic, TypeVar

from neuspring.core.errors import InputError, NumericalFailure

T = TypeVar("T")


class Stale(Exception):
    """The file changed after the revision on which a write is based."""


class Document(Generic[T]):
    """A file that is read and written as one value. Each write names the revision on which it is based; stale writes are refused.

    The revision is a digest of the file's bytes, so that changes by other programs count too. It is "none" without a file.
    """

    def __init__(self, path: Path, load: Callable[[], T], save: Callable[[T], object]) -> None:
        self.path, self._load, self._save, self._lock = path, load, save, Lock()

    def read(self) -> tuple[str, T]:
        """Revision and value of the file. Raises InputError for a damaged file."""
        with self._lock:
            return self._revision(), self._load()

    def write(self, revision: Any, value: T) -> str:
        """Replace the value that had `revision`; returns the new revision. Raises Stale."""
        with self._lock:
            if revision != self._revision():
                raise Stale(self.path.name)
            self._save(value)
            return self._revision()

    def _revision(self) -> str:
        return hashlib.sha256(self.path.read_bytes()).hexdigest()[:16] if self.path.exists() else "none"


Report = Callable[[str, int, int], None]
"""Progress callback of a job: (step, done, total). Raises Stopped after the user stopped the job."""


class Stopped(Exception):
    """The user stopped the job."""


class Busy(Exception):
    """Another job is running."""


IDLE = {"state": "idle", "what": "", "done": 0, "total": 0, "seconds": 0.0, "message": ""}
"""State of a job: idle, running, done, failed or stopped; its step, progress and final message."""


class BackgroundJob:
    """At most one job in a thread, with progress and a stop request."""

    def __init__(self) -> None:
        self._lock, self._stop, self._began = Lock(), Event(), 0.0
        self._state: dict[str, Any] = IDLE
        self._thread: Thread | None = None

    def start(self, work: Callable[[Report], str]) -> None:
        """Start `work`, which returns its final message. Raises Busy."""
        with self._lock:
            if self._state["state"] == "running":
                raise Busy("A job is already carrying masks. Wait for its end, or stop it.")
            self._stop.clear()
            self._began = monotonic()
            self._state = IDLE | {"state": "running"}
            self._thread = Thread(target=self._run, args=(work,), daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Request the job to end at its next report."""
        self._stop.set()

    def join(self) -> None:
        """Wait for the end of the job."""
        if self._thread:
            self._thread.join()

    def plain(self) -> dict[str, Any]:
        """The state as plain JSON values."""
        with self._lock:
            running = self._state["state"] == "running"
            return self._state | ({"seconds": monotonic() - self._began} if running else {})

    def _run(self, work: Callable[[Report], str]) -> None:
        try:
            self._set(state="done", message=work(self._report))
        except Stopped:
            self._set(state="stopped", message="Stopped. Earlier masks are kept.")
        except (InputError, NumericalFailure) as error:
            self._set(state="failed", message=str(error))
        except Exception as error:  # the page shows the error, the terminal its traceback
            logging.getLogger(__name__).exception("the work failed")
            self._set(state="failed", message=f"{type(error).__name__}: {error}. The terminal shows the traceback.")

    def _report(self, what: str, done: int, total: int) -> None:
        if self._stop.is_set():
            raise Stopped
        self._set(what=what, done=done, total=total)

    def _set(self, **changes: Any) -> None:
        with self._lock:
            self._state = self._state | {"seconds": monotonic() - self._began, **changes}
