"""What is read before it is trusted: sizes of arrays, and names that must stay inside their folder."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path

from neuspring.core.errors import InputError
from neuspring.core.files import META, DamagedFile, read_head

MOST_BYTES = 2 * 1024**3
"""Largest file, unpacked, that is opened."""
LARGEST_RECORD = 50_000_000
"""Bytes of a JSON record."""


def require_modest(path: Path, most: int = MOST_BYTES) -> None:
    """Raise InputError for an `.npz` file whose arrays would not fit `most` bytes, or whose headers promise more than it holds."""
    if not path.is_file():
        raise InputError(path, "this file must exist", "no such file", "Run the step that makes it first.")
    try:
        shapes, _ = read_head(path)
        with zipfile.ZipFile(path) as archive:
            sizes = {member.filename.removesuffix(".npy"): member.file_size for member in archive.infolist()}
    except (DamagedFile, zipfile.BadZipFile, OSError) as error:
        raise InputError(path, "this file must be readable", str(error), "Delete it and run its step again.") from error
    if sum(sizes.values()) > most:
        rule = f"at most {most / 1e9:.1f} GB are opened"
        raise InputError(path, rule, f"{sum(sizes.values()) / 1e9:.1f} GB", "Show a smaller run.")
    for name, shape in shapes.items():
        if name != META and math.prod(shape) > sizes[name]:
            rule = f"the header of {name} must agree with its content of {sizes[name]} bytes"
            raise InputError(path, rule, f"shape {shape}", "Delete it and run its step again.")


def require_small(path: Path, most: int = LARGEST_RECORD) -> None:
    """Raise InputError for a file that is larger than any of its kind that we write."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise InputError(path, "this record must be readable", error.strerror, "Run the step that makes it first.") from error
    if size > most:
        raise InputError(path, f"at most {most / 1e6:.0f} MB are opened", f"{size / 1e6:.0f} MB", "Run its step again.")


def inside(folder: Path, path: Path) -> Path:
    """The path, resolved. Raises InputError where it leads out of the folder."""
    resolved = path.resolve()
    if not resolved.is_relative_to(folder.resolve()):
        raise InputError(
            path, f"must lie inside {folder}", str(resolved), "A record of a results folder names files of its scenario."
        )
    return resolved
