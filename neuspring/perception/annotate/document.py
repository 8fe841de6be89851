"""A JSON file that several browser tabs edit: every write names the state that it started from, and a stale one is refused."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import Any, Generic, TypeVar

T = TypeVar("T")
NOTHING = "none"
"""The revision of a file that is not there."""


class Stale(Exception):
    """The file changed since the state that a write started from."""


class Document(Generic[T]):
    """A file, read and written whole. Its revision is a digest of its bytes, so that changes by other programs count too."""

    def __init__(self, path: Path, load: Callable[[], T], save: Callable[[T], object]) -> None:
        self.path, self._load, self._save, self._lock = path, load, save, Lock()

    def read(self) -> tuple[str, T]:
        """Its revision and its value. Raises InputError for a damaged file."""
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
        return hashlib.sha256(self.path.read_bytes()).hexdigest()[:16] if self.path.exists() else NOTHING
