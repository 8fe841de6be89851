"""Files that are whole or not there: each is written aside, flushed, and renamed when complete. Text, tables, JSON, and `.npz`
files of named arrays and one JSON text, without pickle, read with every sort of damage named.
"""

from __future__ import annotations

import json
import os
import re
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


FOREIGN = (
    (
        rb"\x76\x2f\x31\x01",
        "an OpenEXR image",
        "OpenCV's wheels do not read it. Make .npy of it, in meters: pip install OpenEXR; python -c \"import OpenEXR, numpy, sys; "
        "[numpy.save(f[:-4], numpy.atleast_3d(next(iter(OpenEXR.File(f).channels().values())).pixels)[..., 0]) "
        'for f in sys.argv[1:]]" *.exr',
    ),
    (
        rb"glTF",
        "a binary glTF model (GLB)",
        "Make a PLY file of it: python -c \"import trimesh; trimesh.load('a.glb', force='mesh').export('nodes.ply')\"; y is up in "
        "glTF, so turn the points into the world of the capture.",
    ),
    (
        rb"[\x01-\x7f]\x50",
        "a C3D file of a motion capture system",
        "Read it by ezc3d (pip install ezc3d) and write the points in meters; a marker with a residual below 0 was not seen.",
    ),
)
"""First bytes of files of other programs that are given in place of ours, what they are, and how they are converted."""


def foreign(path: Path) -> tuple[str, str]:
    """The name of a file of `FOREIGN`, and its conversion; "" of any other."""
    try:
        with path.open("rb") as stream:
            first = stream.read(16)
    except OSError:
        return "", ""
    return next(((name, remedy) for begin, name, remedy in FOREIGN if re.match(begin, first)), ("", ""))


def load_json(path: Path) -> Any:
    """Parse a JSON file of the data set. Raises InputError."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(path, "this file must be readable", error.strerror) from error
    except (ValueError, RecursionError) as error:
        name, remedy = foreign(path)
        raise InputError(path, "this file must be JSON", name or str(error), remedy) from error
