"""Checkpoints of killed stages, the epoch loop of resumable trainings, and Adam's state as arrays.

A checkpoint contains named arrays, plain values and a key: the digest of inputs, settings, kind of device and code. A stage
ignores a checkpoint with another key.
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
"""Format version. Increase it when the content of checkpoints changes; other versions are rejected."""


@dataclass(frozen=True)
class Checkpoint:
    """State from which a killed stage resumes."""

    arrays: Mapping[str, Mapping[str, np.ndarray]]
    """Group -> name -> array. Group names contain no dot. In a loaded checkpoint, missing groups are empty."""
    values: dict[str, Any]
    """Plain JSON values."""

    def save(self, path: Path, key: str) -> None:
        """Write `path` (.npz) atomically."""
        arrays = {f"{group}.{name}": array for group, members in self.arrays.items() for name, array in members.items()}
        write_npz(path, arrays, json.dumps({"format": CHECKPOINT_FORMAT, "key": key, "values": self.values}), compress=False)

    @classmethod
    def load(cls, path: Path | None, key: str, what: str) -> Checkpoint | None:
        """The checkpoint of `what` (in words: `the fit`); None if no checkpoint has this key. Prints why one is not used."""
        if path is None or not path.is_file():
            return None
        try:
            stored, meta = read_npz(path)
        except DamagedFile as error:
            print(f"{path}: unreadable ({error}); {what} starts over")
            return None
        if (version := meta.get("format")) != CHECKPOINT_FORMAT:
            print(f"{path}: format {version}, but this version reads format {CHECKPOINT_FORMAT}; {what} starts over")
            return None
        if meta.get("key") != key:
            print(f"{path}: made with other inputs or settings; {what} starts over")
            return None
        arrays: dict[str, dict[str, np.ndarray]] = defaultdict(dict)
        for label, array in stored.items():
            group, _, name = label.partition(".")
            arrays[group][name] = array
        return cls(arrays, meta["values"])


def checkpoint_key(inputs: Mapping[str, str], settings: Mapping[str, Any], device: str, module: str) -> str:
    """SHA-256 of inputs, settings, kind of device and the code of a module. Only a checkpoint with the same key is resumed."""
    values = [dict(inputs), dict(settings), device.partition(":")[0], provenance.code_digest(module)]
    return hashlib.sha256(canonical(values).encode()).hexdigest()


CHECKPOINT_EVERY = 5
"""Epochs between two checkpoints of a training."""


class TrainingLoop:
    """The remaining epochs of a training, which resumes from its checkpoint.

    The caller restores `restored`, iterates over the loop, and calls `record` and then `save` in each epoch. A resumed training
    equals an uninterrupted one if its checkpoints contain everything that an epoch depends on.
    """

    def __init__(self, what: str, label: str, epochs: int, partial: Path | None, key: str, *, share: float = 1.0) -> None:
        """Load the checkpoint at `partial` if it has this `key`; `save` writes it every CHECKPOINT_EVERY epochs and at the end.

        `what` names the training in messages, `label` in the progress line. `share` is the fraction of the wall time that counts
        for this training if several run together.
        """
        self._share, self._begun = share, time.monotonic()
        self._epochs, self._partial, self._key = epochs, partial, key
        self._progress = Progress(label, epochs)
        self.history: list[dict[str, Any]] = []
        """One row per epoch."""
        self.attempts = 1
        """1, plus the number of times that the training resumed from a checkpoint."""
        self.earlier_seconds = 0.0
        """Wall time of earlier attempts up to their last checkpoint, s, scaled by `share`."""
        self.restored = Checkpoint.load(partial, key, what)
        """The checkpoint to resume from."""
        if self.restored:
            run = self.restored.values.pop("run")
            self.history, self.earlier_seconds = run["history"], run["seconds"]
            self.attempts = run["attempts"] + 1
            print(f"resuming {what} after epoch {len(self.history) - 1}")

    def __iter__(self) -> Iterator[int]:
        """Yield the numbers of the remaining epochs."""
        while len(self.history) < self._epochs:
            yield len(self.history)

    def record(self, row: dict[str, Any], note: str) -> None:
        """Append the row of a finished epoch to the history and show progress."""
        self.history.append(row)
        self._progress.update(len(self.history), note)

    def save(self, checkpoint: Callable[[], Checkpoint]) -> None:
        """Save the training's state and history if a checkpoint is due."""
        done = len(self.history)
        if self._partial is None or (done % CHECKPOINT_EVERY and done < self._epochs):
            return
        state = checkpoint()
        seconds = self.earlier_seconds + self._share * (time.monotonic() - self._begun)
        run = {"history": self.history, "attempts": self.attempts, "seconds": seconds}
        Checkpoint(state.arrays, {**state.values, "run": run}).save(self._partial, self._key)


def adam_arrays(optimizer: torch.optim.Optimizer) -> dict[str, np.ndarray]:
    """Adam's state as copied arrays named `<parameter index>.<moment>`; empty before the first step."""
    state = optimizer.state_dict()["state"]
    return {f"{index}.{moment}": value.cpu().numpy().copy() for index, slots in state.items() for moment, value in slots.items()}


def restore_adam(optimizer: torch.optim.Optimizer, arrays: Mapping[str, np.ndarray]) -> None:
    """Restore the state that `adam_arrays` returned; learning rates and other options do not change."""
    import torch

    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, array in arrays.items():
        index, _, moment = name.partition(".")
        state.setdefault(int(index), {})[moment] = torch.from_numpy(array.copy())
    optimizer.load_state_dict(optimizer.state_dict() | {"state": state})
