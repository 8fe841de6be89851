"""Checkpoints from which a killed stage continues: named arrays and plain values, valid for one key.

The key says what a checkpoint was made with: inputs, settings, kind of device, code. One with another key is left alone.
"""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.core import provenance
from neuspring.core.npz import DamagedFile, read_npz, write_npz
from neuspring.core.records import canonical


@dataclass(frozen=True)
class Checkpoint:
    """What a stage needs to go on."""

    arrays: Mapping[str, Mapping[str, np.ndarray]]
    """Arrays by group and name. A group's name has no dot. Of a loaded checkpoint, a group without arrays is empty."""
    values: dict[str, Any]
    """Plain JSON values."""

    def save(self, path: Path, key: str) -> None:
        """Write `path` (.npz) atomically."""
        arrays = {f"{group}.{name}": array for group, members in self.arrays.items() for name, array in members.items()}
        write_npz(path, arrays, json.dumps({"key": key, "values": self.values}), compress=False)

    @classmethod
    def load(cls, path: Path | None, key: str, what: str) -> Checkpoint | None:
        """The checkpoint of `what` (in words: `the fit`). None if there is none with this key, and a line that says why."""
        if path is None or not path.is_file():
            return None
        try:
            stored, meta = read_npz(path)
        except DamagedFile as error:
            print(f"{path}: unreadable ({error}); {what} starts afresh")
            return None
        if meta.get("key") != key:
            print(f"{path}: made with other inputs or settings; {what} starts afresh")
            return None
        arrays: dict[str, dict[str, np.ndarray]] = defaultdict(dict)
        for label, array in stored.items():
            group, _, name = label.partition(".")
            arrays[group][name] = array
        return cls(arrays, meta["values"])


def checkpoint_key(inputs: Mapping[str, str], settings: Mapping[str, Any], device: str, module: str) -> str:
    """What a checkpoint must match to be continued from: inputs, settings, device kind and the code of a module."""
    values = [dict(inputs), dict(settings), device.partition(":")[0], provenance.code_digest(module)]
    return hashlib.sha256(canonical(values).encode()).hexdigest()
