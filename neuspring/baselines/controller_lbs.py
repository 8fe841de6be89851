"""The object skinned to the controllers: what is not better than this has learned nothing."""

from __future__ import annotations

from collections.abc import Iterator
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

    Each node has the 16 nearest controllers, with weights 1 / distance, and their local rotations. Only those that
    hold count (`Observations.controller_valid`); while none does, nodes stay where they are.
    """
    hands = observations.controller_points
    nodes = torch.tensor(observations.nodes, dtype=torch.float32, device=device)
    unturned = torch.zeros((len(nodes), 4), device=device)
    unturned[:, 0] = 1.0
    if observations.controller_valid.size:
        carried = _held(hands, observations.controller_valid, nodes, unturned, device)
    else:
        skin = Skin(hands[0], device=device)
        carried = (means for means, _ in skin.carry(hands, nodes, unturned))
    positions = np.stack([means.cpu().numpy() for means in carried])
    return Prediction(Trajectory(positions=positions, frame_count=len(hands)))


def _held(hands: np.ndarray, valid: np.ndarray, nodes: torch.Tensor, unturned: torch.Tensor, device: str) -> Iterator[torch.Tensor]:
    """Nodes [N, 3] in each frame, carried by those of hands [T, C, 3] that hold, `valid` [T, C], at both ends of a frame."""
    yield nodes
    skin, holding = None, np.zeros(hands.shape[1], dtype=bool)
    for frame in range(1, len(hands)):
        now = valid[frame - 1] & valid[frame]
        if now.any():
            if skin is None or (now != holding).any():
                skin, holding = Skin(hands[frame - 1, now], device=device), now
            nodes, _ = skin.step(hands[frame - 1, now], hands[frame, now], nodes, unturned)
        yield nodes
