"""Two reference points that learn nothing. A method that is not better than these has learned nothing either."""

from __future__ import annotations

import numpy as np
import torch

from neuspring.baselines.results import Prediction
from neuspring.core.artifacts import Observations, Trajectory
from neuspring.splats.skinning import Skin


def static(observations: Observations) -> Prediction:
    """Repeat frame 0 in all frames."""
    frames = observations.scenario.frame_count
    positions = np.repeat(observations.nodes[None], frames, axis=0)
    return Prediction(Trajectory(positions=positions, frame_count=frames))


def controller_lbs(observations: Observations, device: str) -> Prediction:
    """Skin the object to the controllers as splats are skinned to nodes (`neuspring.splats.skinning`), from frame to frame.

    Each node follows its 16 nearest controllers and their local rotations, with weights 1 / distance.
    """
    hands = observations.controller_points
    nodes = torch.tensor(observations.nodes, dtype=torch.float32, device=device)
    identity = torch.zeros((len(nodes), 4), device=device)
    identity[:, 0] = 1.0
    skin = Skin(hands[0], device=device)
    positions = np.stack([means.cpu().numpy() for means, _ in skin.carry(hands, nodes, identity)])
    return Prediction(Trajectory(positions=positions, frame_count=len(hands)))
