"""What the platform calls of GS-Dynamics."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neuspring.baselines import TrainingRequest
from neuspring.baselines.gs_dynamics import predict as prediction
from neuspring.baselines.gs_dynamics import train as training
from neuspring.baselines.gs_dynamics.model import GsDynamicsModel
from neuspring.baselines.results import Prediction, Trained
from neuspring.core.artifacts import Observations


def train(request: TrainingRequest) -> Trained[GsDynamicsModel]:
    """Train the network on the tracks of the training frames."""
    settings = request.settings.baselines.gs_dynamics
    return training.run(request.observations, settings, request.seed, request.device, request.partial, request.key())


def predict(observations: Observations, model: Path | None, splats: np.ndarray | None, device: str) -> Prediction:
    """Roll a trained model out; it has no splats of its own."""
    assert model is not None, "stage predict requires the record of the training"
    return prediction.predict(GsDynamicsModel.load(model), observations, device)
