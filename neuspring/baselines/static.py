"""Frame 0, frozen: what is not better than this has learned nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neuspring.baselines.results import Prediction
from neuspring.core.artifacts import Observations, Trajectory


def predict(
    observations: Observations, model: Path | None = None, splats: np.ndarray | None = None, device: str = "cpu"
) -> Prediction:
    """Frame 0 in all frames."""
    frames = observations.scenario.frame_count
    positions = np.repeat(observations.nodes[None], frames, axis=0)
    return Prediction(Trajectory(positions=positions, frame_count=frames))
