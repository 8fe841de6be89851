"""Readers of PhysTwin's released results: searched parameters, checkpoint and prediction of a case.

Every reader raises InputError with the name of the file. No reader runs code that a file contains.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.unpickle import load_pickle

SPRING_KEYS = ("object_radius", "object_max_neighbours", "controller_radius", "controller_max_neighbours")


@dataclass(frozen=True)
class Released:
    """The files of one case in the folder of the unpacked archives."""

    root: Path
    name: str

    @property
    def folder(self) -> Path:
        """The processed case."""
        return self.root / "data" / "different_types" / self.name

    @property
    def parameters(self) -> Path:
        """The searched parameters."""
        return self.root / "experiments_optimization" / self.name / "optimal_params.pkl"

    @property
    def checkpoint(self) -> Path:
        """best_{epoch}.pth of the highest epoch; best_0.pth if there is none."""
        folder = self.root / "experiments" / self.name / "train"
        return max(folder.glob("best_*.pth"), key=epoch, default=folder / "best_0.pth")

    @property
    def prediction(self) -> Path:
        """Node positions of all frames."""
        return self.root / "experiments" / self.name / "inference.pkl"


def epoch(checkpoint: Path) -> int:
    """The epoch in the name of a checkpoint; -1 for another name."""
    number = checkpoint.stem.removeprefix("best_")
    return int(number) if number.isdecimal() else -1


def read_parameters(path: Path) -> dict[str, float]:
    """The numbers in optimal_params.pkl that define springs (`SPRING_KEYS`): radii, m, and counts."""
    parameters = load_pickle(path)
    try:
        read = {key: float(parameters[key]) for key in SPRING_KEYS}
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise InputError(path, f"must have the numbers {', '.join(SPRING_KEYS)}", f"{type(error).__name__}: {error}") from error
    if not all(0 < value < np.inf for value in read.values()):
        raise InputError(path, f"{', '.join(SPRING_KEYS)} must be positive and finite", read)
    return read


def read_checkpoint(path: Path) -> tuple[np.ndarray, int]:
    """Stiffness of every spring [S] and the number of springs between object nodes, of best_{epoch}.pth."""
    import torch  # Slow to import, and only this file needs it.

    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
        return stored["spring_Y"].detach().numpy(), int(stored["num_object_springs"])
    except Exception as error:  # Torch documents no set of exceptions for damaged or refused files.
        reason = f"{type(error).__name__}: {error}".partition("\n")[0]
        rule = "must be a checkpoint with spring_Y and num_object_springs (read with weights_only)"
        raise InputError(path, rule, reason) from error


def read_prediction(path: Path, frames: int, nodes: int) -> np.ndarray:
    """Node positions [T, N, 3], m, float32, of inference.pkl."""
    positions = load_pickle(path)
    if not isinstance(positions, np.ndarray) or positions.dtype.kind != "f" or positions.shape != (frames, nodes, 3):
        received = f"{positions.shape} {positions.dtype}" if isinstance(positions, np.ndarray) else type(positions).__name__
        raise InputError(path, f"must have floating-point positions of shape {(frames, nodes, 3)}", received)
    return np.asarray(positions, dtype=np.float32)
