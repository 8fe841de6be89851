"""What training and prediction of a baseline return."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
import pandas as pd

from neuspring.core.artifacts import Artifact, Trajectory

LIMIT = 10.0
"""m from the origin, on the table: what is farther away has exploded, as scenes are a metre or two wide."""
Model = TypeVar("Model", bound=Artifact)


@dataclass(frozen=True)
class Trained(Generic[Model]):
    """A trained model, and how it came to be."""

    model: Model
    history: pd.DataFrame
    """One row per epoch or iteration: column `step`, and a column per metric."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Plain values for the record."""
    failure: str = ""
    """Why training ended early; the model is then the last that was usable. Empty: it ended as it should."""
    attempts: int = 1
    """1, plus one for every time that training continued from a checkpoint."""
    earlier_seconds: float = 0.0
    """Wall time of the attempts that this one continued, up to their last checkpoint."""


@dataclass(frozen=True)
class Prediction:
    """An open-loop rollout over all frames."""

    trajectory: Trajectory
    """Of the structure points, in the order of `Observations.nodes`."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Plain values for the record."""
    centres: np.ndarray | None = None
    """[F, G, 3] m: the model's own splat centres in every frame, where it draws with splats of its own; else the platform's splats
    are skinned to the trajectory."""
