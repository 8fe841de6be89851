"""Errors that a caller can cause. Each message names the file or field, the rule, the received value and the next move."""

from __future__ import annotations

import shutil
from pathlib import Path


class InputError(ValueError):
    """Invalid input: `where` violates `rule`; `value` was received; `remedy` is the next move.

    The command line exits with status 2: the same input fails again.
    """

    def __init__(self, where: object, rule: str, value: object = None, remedy: str = "") -> None:
        parts = [f"{where}: {rule}"]
        if value is not None:
            parts.append(f"received {value}")
        text = "; ".join(parts)
        super().__init__(f"{text}. {remedy}".rstrip() if remedy else f"{text}.")


class NumericalFailure(RuntimeError):
    """A computation that left its physical range (for example: every candidate of a search diverged).

    Stages record it as `status: failed` with this reason, and tables show it.
    """


def full_disk(path: Path) -> InputError:
    """The error for a file that does not fit on its disk."""
    disk = next(folder for folder in [path.absolute(), *path.absolute().parents] if folder.is_mount())
    free, total = (size / 1e9 for size in (shutil.disk_usage(disk).free, shutil.disk_usage(disk).total))
    rule = f"no space left on device: the disk at {disk} has {free:.1f} of {total:.1f} GB free"
    return InputError(path, rule, None, "Free some space there, then rerun the same command to resume.")
