"""Named arrays and one JSON text in one `.npz` file: no pickle, written atomically, read with every sort of damage named."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.core.files import write_atomically

META = "meta"
"""Name of the array that holds the JSON text."""


class DamagedFile(ValueError):
    """A file that is no whole `.npz` file with a JSON mapping; says what is wrong."""


def write_npz(path: Path, arrays: Mapping[str, np.ndarray], meta: str, *, compress: bool) -> None:
    """Write arrays and a JSON text to `path` atomically."""
    save = np.savez_compressed if compress else np.savez

    def write(temporary: Path) -> None:
        with temporary.open("wb") as stream:
            save(stream, **arrays, **{META: np.frombuffer(meta.encode(), dtype=np.uint8)})  # type: ignore[arg-type]

    write_atomically(path, write)


def read_npz(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the JSON mapping of a file that exists. Raises DamagedFile."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        meta = json.loads(arrays.pop(META).tobytes().decode())
        if not isinstance(meta, dict):
            raise ValueError("`meta` holds no mapping")
    # zipfile raises RuntimeError for damaged flags, and np.load returns a bare array (TypeError) for an .npy file.
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise DamagedFile(f"{type(error).__name__}: {error}") from error
    return arrays, meta
