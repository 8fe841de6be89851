"""Two reference points that learn nothing. A method that is not better than these has learned nothing."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from neuspring.baselines.results import Prediction
from neuspring.core.artifacts import Observations, Trajectory
from neuspring.splats.skinning import Skin


def static(model: None, observations: Observations, splats: np.ndarray | None, device: str) -> Prediction:
    """Predict frame 0 in all frames."""
    frames = observations.scenario.frame_count
    positions = np.repeat(observations.nodes[None], frames, axis=0)
    return Prediction(Trajectory(positions=positions, frame_count=frames))


def controller_lbs(model: None, observations: Observations, splats: np.ndarray | None, device: str) -> Prediction:
    """Predict nodes that follow the controllers from frame to frame, as splats follow nodes (`neuspring.splats.skinning`).

    Each node follows the 16 nearest controllers that hold (`Observations.controller_valid`), with weights 1 / distance and local
    rotations. While no controller holds, nodes stay in place.
    """
    hands = observations.controller_points
    nodes = torch.tensor(observations.nodes, dtype=torch.float32, device=device)
    identity = torch.zeros((len(nodes), 4), device=device)
    identity[:, 0] = 1.0
    if observations.controller_valid.size:
        carried = _held(hands, observations.controller_valid, nodes, identity, device)
    else:
        carried = (means for means, _ in Skin(hands[0], device=device).carry(hands, nodes, identity))
    positions = np.stack([means.cpu().numpy() for means in carried])
    return Prediction(Trajectory(positions=positions, frame_count=len(hands)))


def _held(hands: np.ndarray, valid: np.ndarray, nodes: torch.Tensor, identity: torch.Tensor, device: str) -> Iterator[torch.Tensor]:
    """Nodes [N, 3] in each frame, which follow the controllers `hands` [T, C, 3] that are `valid` [T, C] at both ends of it."""
    yield nodes
    skin, holding = None, np.zeros(hands.shape[1], dtype=bool)
    for frame in range(1, len(hands)):
        if (now := valid[frame - 1] & valid[frame]).any():
            if skin is None or (now != holding).any():
                skin, holding = Skin(hands[frame - 1, now], device=device), now
            nodes, _ = skin.step(hands[frame - 1, now], hands[frame, now], nodes, identity)
        yield nodes
