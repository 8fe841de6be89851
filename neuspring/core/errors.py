"""The errors a caller can cause. Each message names the file or field, the rule, the value received and the next move."""

from __future__ import annotations

import shutil
from pathlib import Path


class InputError(ValueError):
    """Bad input: `where` broke `rule`; we received `value`; do `remedy` next.

    Exit status 2 on the command line: only another input can help.
    """

    def __init__(self, where: object, rule: str, value: object = None, remedy: str = "") -> None:
        parts = [f"{where}: {rule}"]
        if value is not None:
            parts.append(f"received {value}")
        text = "; ".join(parts)
        super().__init__(f"{text}. {remedy}".rstrip() if remedy else f"{text}.")


class NumericalFailure(RuntimeError):
    """A computation that ended outside its physical range (for example: every candidate of a search diverged).

    This is a result, not a crash: stages record it as `status: failed` with this reason, and tables show it.
    """


def full_disk(path: Path) -> InputError:
    """The error of a file that does not fit on its disk."""
    disk = next(folder for folder in [path.absolute(), *path.absolute().parents] if folder.is_mount())
    free, whole = (size / 1e9 for size in (shutil.disk_usage(disk).free, shutil.disk_usage(disk).total))
    rule = f"no space left on device: the disk at {disk} has {free:.1f} of {whole:.1f} GB free"
    return InputError(path, rule, None, "Free some space there; the same command continues, and what is finished is kept.")
