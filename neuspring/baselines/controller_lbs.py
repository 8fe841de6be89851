"""The object skinned to the controllers: what is not better than this has learned nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from neuspring.baselines.results import Prediction
from neuspring.core.artifacts import Observations, Trajectory
from neuspring.splats.skinning import Skin


def predict(
    observations: Observations, model: Path | None = None, splats: np.ndarray | None = None, device: str = "cpu"
) -> Prediction:
    """Nodes follow the controllers from frame to frame, as splats follow nodes (`neuspring.splats.skinning`).

    Each node has the 16 nearest controllers, with weights 1 / distance, and their local rotations.
    """
    hands = observations.controller_points
    nodes = torch.tensor(observations.nodes, dtype=torch.float32, device=device)
    unturned = torch.zeros((len(nodes), 4), device=device)
    unturned[:, 0] = 1.0
    skin = Skin(hands[0], device=device)
    positions = np.stack([means.cpu().numpy() for means, _ in skin.carry(hands, nodes, unturned)])
    return Prediction(Trajectory(positions=positions, frame_count=len(hands)))
