"""Atomic file writes: a temporary file is written, flushed and renamed, so no partial file exists.

Text, tables, JSON, and `.npz` files with named arrays and one JSON text, without pickle. Readers report how a file is damaged.
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
    """Call `write` with a temporary path in the same folder, flush the file to disk, then rename it to `path`.

    Raises InputError if the folder is not writable.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    except OSError as error:
        raise InputError(
            path.parent, "this folder must be writable", error.strerror, "Fix its permissions or choose another results folder."
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
        # The OSError of a failed write names no file.
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
    """Write metrics per step in MLflow's long format (step, metric, value), without missing values; returns the path."""
    import pandas as pd

    parts = [pd.DataFrame({"step": np.asarray(steps), "metric": name, "value": v.to_numpy(float)}) for name, v in columns.items()]
    return write_table(pd.concat(parts).dropna().reset_index(drop=True), path)


META = "meta"
"""Name of the array with the JSON text."""


NPZ_FAULTS = (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, KeyError, TypeError, RuntimeError)
"""Exceptions for damaged .npz files: zipfile raises RuntimeError for damaged flags, and an .npy file causes a TypeError."""


class DamagedFile(ValueError):
    """A file that is not a complete `.npz` file with a JSON mapping; the message states the fault."""


def write_npz(path: Path, arrays: Mapping[str, np.ndarray], meta: str, *, compress: bool) -> None:
    """Write arrays and a JSON text to `path` atomically."""
    save = np.savez_compressed if compress else np.savez

    def write(temporary: Path) -> None:
        with temporary.open("wb") as stream:
            save(stream, **arrays, **{META: np.frombuffer(meta.encode(), dtype=np.uint8)})  # type: ignore[arg-type]

    write_atomically(path, write)


def read_npz(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the JSON mapping of an existing file. Raises DamagedFile."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        meta = json.loads(arrays.pop(META).tobytes().decode())
        if not isinstance(meta, dict):
            raise ValueError("`meta` contains no mapping")
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
            raise ValueError(f"`{META}` contains no mapping")
    except FileNotFoundError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, TypeError, RuntimeError) as error:
        raise DamagedFile(f"{type(error).__name__}: {error}") from error
    return shapes, mapping


FOREIGN = (
    (
        rb"\x76\x2f\x31\x01",
        "an OpenEXR image",
        "OpenCV's wheels do not read it. Convert it to .npy, in m: pip install OpenEXR; python -c \"import OpenEXR, numpy, sys; "
        "[numpy.save(f[:-4], numpy.atleast_3d(next(iter(OpenEXR.File(f).channels().values())).pixels)[..., 0]) "
        'for f in sys.argv[1:]]" *.exr',
    ),
    (
        rb"glTF",
        "a binary glTF model (GLB)",
        "Convert it to PLY: python -c \"import trimesh; trimesh.load('a.glb', force='mesh').export('nodes.ply')\"; y is up in "
        "glTF, so rotate the points into the world of the capture.",
    ),
    (
        rb"[\x01-\x7f]\x50",
        "a C3D file of a motion capture system",
        "Read it with ezc3d (pip install ezc3d) and write the points in meters; a marker with a residual below 0 was not seen.",
    ),
)
"""First bytes, name and conversion of other programs' files that users pass by mistake."""


def foreign(path: Path) -> tuple[str, str]:
    """The name and the conversion of a file in a format of `FOREIGN`; empty texts for any other file."""
    try:
        with path.open("rb") as stream:
            first = stream.read(16)
    except OSError:
        return "", ""
    return next(((name, remedy) for begin, name, remedy in FOREIGN if re.match(begin, first)), ("", ""))


def load_json(path: Path) -> Any:
    """Parse a JSON file of a data set. Raises InputError."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(path, "this file must be readable", error.strerror) from error
    except (ValueError, RecursionError) as error:
        name, remedy = foreign(path)
        raise InputError(path, "this file must be JSON", name or str(error), remedy) from error
