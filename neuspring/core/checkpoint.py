"""Checkpoints from which a killed stage continues, and what every resumable training shares: its epochs with a history, and Adam's
state as arrays.

A checkpoint is named arrays and plain values, valid for one key, which says what it was made with: inputs, settings, kind of
device, code. One with another key is left alone.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neuspring.core import provenance
from neuspring.core.files import DamagedFile, read_npz, write_npz
from neuspring.core.records import canonical
from neuspring.core.text import Progress

if TYPE_CHECKING:
    import torch


CHECKPOINT_FORMAT = 3
"""Raise it where what checkpoints hold changes: those of another version are refused by name."""


@dataclass(frozen=True)
class Checkpoint:
    """State from which a stage continues after a kill."""

    arrays: Mapping[str, Mapping[str, np.ndarray]]
    """Arrays by group and name. A group's name has no dot. Of a loaded checkpoint, a group without arrays is empty."""
    values: dict[str, Any]
    """Plain JSON values."""

    def save(self, path: Path, key: str) -> None:
        """Write `path` (.npz) atomically."""
        arrays = {f"{group}.{name}": array for group, members in self.arrays.items() for name, array in members.items()}
        write_npz(path, arrays, json.dumps({"format": CHECKPOINT_FORMAT, "key": key, "values": self.values}), compress=False)

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
        if (version := meta.get("format")) != CHECKPOINT_FORMAT:
            print(f"{path}: a checkpoint of format {version}, this version reads {CHECKPOINT_FORMAT}; {what} starts afresh")
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
    """SHA-256 of inputs, settings, kind of device and the code of a module: a checkpoint with another key is not continued from."""
    values = [dict(inputs), dict(settings), device.partition(":")[0], provenance.code_digest(module)]
    return hashlib.sha256(canonical(values).encode()).hexdigest()


CHECKPOINT_EVERY = 5
"""Epochs between checkpoints from which a killed training continues."""


class TrainingLoop:
    """The epochs that are left of a training which may have been killed before.

    The user restores `restored`, iterates over the loop, and calls `record` and then `save` in each epoch. A continued training
    equals an uninterrupted one if its checkpoints hold all that an epoch depends on.
    """

    def __init__(self, what: str, label: str, epochs: int, partial: Path | None, key: str, *, share: float = 1.0) -> None:
        """`what` is the training in messages, `label` in the progress line. A checkpoint is written to `partial` after each
        CHECKPOINT_EVERY epochs and after the last; one that lies there is continued from if it has the same `key`. `share` is the
        part of the time that counts for this training, where several run together."""
        self._share, self._begun = share, time.monotonic()
        self._epochs, self._partial, self._key = epochs, partial, key
        self._progress = Progress(label, epochs)
        self.history: list[dict[str, Any]] = []
        """A row per epoch."""
        self.attempts = 1
        """1, plus one for every time that the training continued from a checkpoint of a killed one."""
        self.earlier_seconds = 0.0
        """Wall time of earlier attempts, up to their last checkpoint; this training's share of what it had together with others."""
        self.restored = Checkpoint.load(partial, key, what)
        """The checkpoint to continue from."""
        if self.restored:
            run = self.restored.values.pop("run")
            self.history, self.earlier_seconds = run["history"], run["seconds"]
            self.attempts = run["attempts"] + 1
            print(f"continuing {what} after epoch {len(self.history) - 1}")

    def __iter__(self) -> Iterator[int]:
        """Numbers of the epochs that are left."""
        while len(self.history) < self._epochs:
            yield len(self.history)

    def record(self, row: dict[str, Any], note: str) -> None:
        """Add the row of a finished epoch to the history, and show progress."""
        self.history.append(row)
        self._progress.update(len(self.history), note)

    def save(self, checkpoint: Callable[[], Checkpoint]) -> None:
        """Save the training's own state, with the history, if a checkpoint is due."""
        done = len(self.history)
        if self._partial is None or (done % CHECKPOINT_EVERY and done < self._epochs):
            return
        state = checkpoint()
        seconds = self.earlier_seconds + self._share * (time.monotonic() - self._begun)
        run = {"history": self.history, "attempts": self.attempts, "seconds": seconds}
        Checkpoint(state.arrays, {**state.values, "run": run}).save(self._partial, self._key)


def adam_arrays(optimizer: torch.optim.Optimizer) -> dict[str, np.ndarray]:
    """Adam's state as copied arrays named `<index of the parameter>.<moment>`; none before the first step."""
    state = optimizer.state_dict()["state"]
    return {f"{index}.{moment}": value.cpu().numpy().copy() for index, slots in state.items() for moment, value in slots.items()}


def restore_adam(optimizer: torch.optim.Optimizer, arrays: Mapping[str, np.ndarray]) -> None:
    """Set Adam's state to that of `adam_arrays`; learning rates and other options stay."""
    import torch

    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, array in arrays.items():
        index, _, moment = name.partition(".")
        state.setdefault(int(index), {})[moment] = torch.from_numpy(array.copy())
    optimizer.load_state_dict(optimizer.state_dict() | {"state": state})
