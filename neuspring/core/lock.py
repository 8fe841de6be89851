"""File locks that a command can inherit.

A job's lock must last as long as its command, even if the wrapper dies. `filelock.FileLock` cannot do this: on release it unlocks
the file for all holders, and forked processes drop the lock. Here the same kernel lock belongs to an open file. Locks that end
with a `with` block use `FileLock`.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import IO

from filelock import lock_descriptor

LOCK_POLL = 0.01
"""Time between two attempts to lock, s."""


def try_lock(path: Path) -> IO[str] | None:
    """Lock the file at `path` and return it; None if it is locked already. Creates a missing file. Raises OSError.

    The lock is released when this process and all processes that inherited the descriptor have closed the file.
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
    """Wait until the lock is free, and return the file of `try_lock`."""
    while (file := try_lock(path)) is None:
        time.sleep(LOCK_POLL)
    return file


def _open(path: Path) -> IO[str]:
    try:
        return path.open("a+", encoding="utf-8")
    except PermissionError:
        # The file belongs to another user of a shared folder. On a local disk, read access suffices for a lock.
        return path.open(encoding="utf-8")


def _is_at(file: IO[str], path: Path) -> bool:
    """True if the file is still the one at `path`: its last holder may have removed it before it was locked here."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
