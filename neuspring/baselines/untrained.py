"""Two baselines that learn nothing and keep the others honest: what is not better than these has learned nothing either."""

from __future__ import annotations

import numpy as np
import torch

from neuspring.baselines.results import Prediction
from neuspring.core.artifacts import Observations, Trajectory
from neuspring.splats.skinning import Skin


def static(observations: Observations) -> Prediction:
    """Frame 0 held over all frames."""
    frames = observations.scenario.frame_count
    positions = np.repeat(observations.nodes[None], frames, axis=0)
    return Prediction(Trajectory(positions=positions, frame_count=frames))


def controller_lbs(observations: Observations, device: str) -> Prediction:
    """The object skinned to the controllers as splats are to nodes (`neuspring.splats.skinning`), from frame to frame.

    Each node follows its 16 nearest controllers, with weights 1 / distance, and their local rotations.
    """
    hands = observations.controller_points
    nodes = torch.tensor(observations.nodes, dtype=torch.float32, device=device)
    unturned = torch.zeros((len(nodes), 4), device=device)
    unturned[:, 0] = 1.0
    skin = Skin(hands[0], device=device)
    positions = np.stack([means.cpu().numpy() for means, _ in skin.carry(hands, nodes, unturned)])
    return Prediction(Trajectory(positions=positions, frame_count=len(hands)))
