"""What the platform calls of Spring-Gaus."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neuspring.baselines import TrainingRequest
from neuspring.baselines.results import Prediction, Trained
from neuspring.baselines.spring_gaus import predict as prediction
from neuspring.baselines.spring_gaus import setup
from neuspring.baselines.spring_gaus import train as training
from neuspring.baselines.spring_gaus.model import SpringGausModel
from neuspring.core.artifacts import Observations


def train(request: TrainingRequest) -> Trained[SpringGausModel]:
    """Train on silhouettes, or on points."""
    pictures, settings, device = request.pictures, request.settings, request.device
    seen = setup.Seen.of(pictures.folder, pictures.masks, pictures.splats, settings, device) if pictures else None
    problem, facts = setup.problem(request.observations, seen, settings, request.seed, device)
    result = training.run(problem, request.partial, request.key(vgg16=facts.get("vgg16") == "computed"))
    result.facts.update(facts)
    return result


def predict(observations: Observations, model: Path | None, splats: np.ndarray | None, device: str) -> Prediction:
    """Roll a trained model out."""
    assert model is not None, "stage predict requires the record of the training"
    return prediction.predict(SpringGausModel.load(model), observations, splats, device)
