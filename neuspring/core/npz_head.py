"""What an `.npz` file of `neuspring.core.npz` holds, without its arrays: a millisecond, however large they are."""

from __future__ import annotations

import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.core.npz import META, DamagedFile


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
