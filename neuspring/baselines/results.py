"""Results of a baseline's training and prediction, and the training loop that baselines share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import pandas as pd

from neuspring.core.artifacts import Artifact, Trajectory
from neuspring.core.checkpoint import Checkpoint, TrainingLoop

DIVERGENCE_RADIUS = 10.0
"""Distance from the origin, m, beyond which a point counts as diverged; scenes are one or two meters wide."""
Model = TypeVar("Model", bound=Artifact)
TrainedModel = TypeVar("TrainedModel", bound=Artifact, covariant=True)


@dataclass(frozen=True)
class Trained(Generic[Model]):
    """A trained model and its training."""

    model: Model
    history: pd.DataFrame
    """One row per epoch: column `step`, and a column per metric."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Plain values for the record."""
    failure: str = ""
    """Reason why training ended early; the model is then the last usable one. Empty: training is complete."""
    attempts: int = 1
    """1, plus one for every time that training resumed from a checkpoint."""
    earlier_seconds: float = 0.0
    """Wall time of the earlier attempts, up to their last checkpoint, s."""


@dataclass(frozen=True)
class Prediction:
    """An open-loop rollout over all frames."""

    trajectory: Trajectory
    """Motion of the structure points, in the order of `Observations.nodes`."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Plain values for the record."""
    centers: np.ndarray | None = None
    """Centers of the model's own splats in every frame [F, G, 3], m. None: the common splats follow the trajectory."""


class TrainingStopped(ArithmeticError):
    """Training cannot continue. The text is the reason."""


class Training(Protocol[TrainedModel]):
    """The interface of a training for `run_epochs`. `epoch` returns metrics; `facts` receives the number of complete epochs."""

    def epoch(self, number: int) -> dict[str, float]: ...
    def model(self) -> TrainedModel: ...
    def facts(self, epochs: int) -> dict[str, Any]: ...
    def checkpoint(self) -> Checkpoint: ...
    def restore(self, checkpoint: Checkpoint) -> None: ...


def run_epochs(
    training: Training[Model], metrics: Sequence[str], epochs: int, partial: Path | None, key: str, failure: str = ""
) -> Trained[Model]:
    """Train for `epochs` epochs, or until `epoch` raises TrainingStopped, whose text becomes the failure.

    Resumes from the file `partial` if it contains a checkpoint with the same key.
    """
    loop = TrainingLoop("the training", "train", epochs, partial, key)
    if loop.restored:
        training.restore(loop.restored)
    for number in loop:
        try:
            row = training.epoch(number)
        except TrainingStopped as reason:
            failure = f"training ended early: {reason}"
            break
        loop.record({"step": number, **row}, ", ".join(f"{name} {value:.4g}" for name, value in row.items()))
        loop.save(training.checkpoint)
    history = pd.DataFrame(loop.history, columns=["step", *metrics])
    facts = training.facts(len(loop.history))
    return Trained(training.model(), history, facts, failure, loop.attempts, loop.earlier_seconds)
