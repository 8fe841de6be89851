"""Files that are whole or not there: each is written aside, flushed, and renamed when complete."""

from __future__ import annotations

import os
import tempfile
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
