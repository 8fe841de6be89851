"""Files that are whole or not there: each is written aside, flushed, and renamed when complete. Text, tables, JSON, and `.npz`
files of named arrays and one JSON text, without pickle, read with every sort of damage named.
"""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neuspring.core.errors import InputError

if TYPE_CHECKING:
    import pandas as pd


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Call `write(temporary path)` beside `path`, flush it to disk, then rename it over `path`.

    Raises InputError if the folder cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    except OSError as error:
        raise InputError(
            path.parent, "this folder must be writable", error.strerror, "Choose another results folder or fix its permissions."
        ) from error
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        with temporary.open("rb") as stream:
            os.fsync(stream.fileno())
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:
        # A write that fails does not name its file.
        error.filename = error.filename or str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    write_atomically(path, lambda p: p.write_text(text, encoding="utf-8"))


def write_table(table: pd.DataFrame, path: Path) -> Path:
    """Write a Parquet file atomically; returns its path."""
    write_atomically(path, lambda temporary: table.to_parquet(temporary, index=False))
    return path


def write_history(steps: Any, columns: Mapping[str, pd.Series], path: Path) -> Path:
    """Write metrics over steps as MLflow takes them, long: step, metric, value; missing values are left out."""
    import pandas as pd

    parts = [pd.DataFrame({"step": np.asarray(steps), "metric": name, "value": v.to_numpy(float)}) for name, v in columns.items()]
    return write_table(pd.concat(parts).dropna().reset_index(drop=True), path)


META = "meta"
"""Name of the array that holds the JSON text."""


NPZ_FAULTS = (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, KeyError, TypeError, RuntimeError)
"""Exceptions of reading a damaged .npz file: zipfile raises RuntimeError for damaged flags, and np.load returns a bare array
(TypeError) for an .npy file."""


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
    except NPZ_FAULTS as error:
        raise DamagedFile(f"{type(error).__name__}: {error}") from error
    return arrays, meta


def read_head(path: Path) -> tuple[dict[str, tuple[int, ...]], dict[str, Any]]:
    """The shapes of the arrays, and the JSON mapping. Raises FileNotFoundError or DamagedFile."""
    shapes: dict[str, tuple[int, ...]] = {}
    mapping: Any = None
    try:
        with zipfile.ZipFile(path) as archive:
            for member in archive.namelist():
                with archive.open(member) as stream:
                    name = member.removesuffix(".npy")
                    if name == META:
                        mapping = json.loads(np.lib.format.read_array(stream, allow_pickle=False).tobytes().decode())
                    else:
                        first = np.lib.format.read_magic(stream) == (1, 0)
                        read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
                        shapes[name] = read(stream)[0]
        if not isinstance(mapping, dict):
            raise ValueError(f"`{META}` holds no mapping")
    except FileNotFoundError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, TypeError, RuntimeError) as error:
        raise DamagedFile(f"{type(error).__name__}: {error}") from error
    return shapes, mapping


def load_json(path: Path) -> Any:
    """Parse a JSON file of the data set. Raises InputError."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(path, "this file must be readable", error.strerror) from error
    except (ValueError, RecursionError) as error:
        raise InputError(path, "this file must be JSON", str(error)) from error
