"""Checkpoints from which a killed stage continues: named arrays and plain values, valid for one key.

The key says what a checkpoint was made with: inputs, settings, kind of device, code. One with another key is left alone.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.core import provenance
from neuspring.core.files import write_atomically
from neuspring.core.records import canonical


@dataclass(frozen=True)
class Checkpoint:
    """What a stage needs to go on."""

    arrays: dict[str, np.ndarray]
    values: dict[str, Any]
    """Plain JSON values."""

    def save(self, path: Path, key: str) -> None:
        """Write `path` (.npz) atomically."""
        meta = np.frombuffer(json.dumps({"key": key, "values": self.values}).encode(), np.uint8)

        def write(temporary: Path) -> None:
            with temporary.open("wb") as stream:
                np.savez(stream, meta=meta, **self.arrays)  # type: ignore[arg-type]

        write_atomically(path, write)

    @classmethod
    def load(cls, path: Path | None, key: str, what: str) -> Checkpoint | None:
        """The checkpoint of `what` (in words: `the fit`), or None, saying why, if there is none with this key."""
        if path is None or not path.is_file():
            return None
        try:
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            meta = json.loads(arrays.pop("meta").tobytes())
            found, values = meta["key"], meta["values"]
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            print(f"{path}: unreadable ({error}); {what} starts afresh")
            return None
        if found != key:
            print(f"{path}: made with other inputs or settings; {what} starts afresh")
            return None
        return cls(arrays, values)


def checkpoint_key(inputs: Mapping[str, str], settings: Mapping[str, Any], device: str, module: str) -> str:
    """What a checkpoint must match to be continued from: inputs, settings, device kind and the code of a module."""
    values = [dict(inputs), dict(settings), device.partition(":")[0], provenance.code_digest(module)]
    return hashlib.sha256(canonical(values).encode()).hexdigest()
