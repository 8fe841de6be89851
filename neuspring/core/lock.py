"""Locks that a command can inherit.

`filelock.FileLock` is the lock of this package wherever a lock ends with a `with` block. It does not fit a job, whose lock must
last as long as its command even if the wrapper dies: `FileLock` unlocks the file for all holders on release, and drops it in
forked processes. Here the same kernel lock belongs to an open file.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import IO

from filelock import lock_descriptor

LOCK_POLL = 0.01
"""s between two attempts to lock."""


def try_lock(path: Path) -> IO[str] | None:
    """Lock the file at `path`, which is made if it is missing; None if it is locked. Raises OSError.

    The lock is free when the returned file is closed here and in every process that inherited its descriptor.
    """
    while True:
        file = _open(path)
        try:
            locked = lock_descriptor(file.fileno(), blocking=False)
            if locked and _is_at(file, path):
                return file
        except OSError:
            file.close()
            raise
        file.close()
        if not locked:
            return None


def wait_for_lock(path: Path) -> IO[str]:
    """The file of `try_lock`, after waiting until the lock is free."""
    while (file := try_lock(path)) is None:
        time.sleep(LOCK_POLL)
    return file


def _open(path: Path) -> IO[str]:
    try:
        return path.open("a+", encoding="utf-8")
    except PermissionError:
        # Another user's file in a shared folder. Reading is enough to lock it on a local disk.
        return path.open(encoding="utf-8")


def _is_at(file: IO[str], path: Path) -> bool:
    """True where the file is still the one at `path`: its last holder may have removed it before we locked it."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
