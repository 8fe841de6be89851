"""Open-loop rollout of a Spring-Gaus model, and its two outputs: structure points, and the centers of its splats."""

from __future__ import annotations

import numpy as np
import torch

from neuspring.baselines.results import LIMIT, Prediction
from neuspring.baselines.spring_gaus.model import Follower, SpringGausModel
from neuspring.baselines.spring_gaus.physics import AnchorSolver
from neuspring.core.artifacts import Observations, Trajectory


def predict(model: SpringGausModel, observations: Observations, splats: np.ndarray | None, device: str) -> Prediction:
    """Both outputs in all frames. `splats` [G, 3], m, are the centers of the splats in frame 0 (None: the model has none)."""
    anchors, reason = roll_out(model, observations.controller_points, device)
    nodes = torch.tensor(observations.nodes, device=device)
    follow = Follower(observations.nodes, model.anchors, model.bound_anchors, device)
    positions = np.stack([(nodes + follow(frame - anchors[0])).cpu().numpy() for frame in anchors])
    frames = len(observations.controller_points)
    diverged = len(anchors) if reason else None
    trajectory = Trajectory(positions=positions, frame_count=frames, diverged_frame=diverged, reason=reason)
    facts = {"anchors": len(model.anchors), "substeps": model.substeps}
    if splats is None:
        return Prediction(trajectory, facts)
    follow = Follower(splats, model.anchors, model.bound_anchors, device)
    # Frame by frame, because all frames of hundreds of thousands of splats may not fit on the device.
    centers = np.stack([follow(frame).cpu().numpy() for frame in anchors])
    return Prediction(trajectory, facts | contraction(splats, centers[0]), centers)


@torch.no_grad()
def roll_out(model: SpringGausModel, controllers: np.ndarray, device: str) -> tuple[torch.Tensor, str]:
    """Anchors [F, N, 3], m, under controllers [T, C, 3], m, from frame 0, and why F < T (empty where F = T)."""
    solver = AnchorSolver(model, model, model.substeps, device)
    parameters = model.parameters(model.tensors(device))
    start, hands = torch.tensor(model.velocity, device=device), torch.tensor(controllers, dtype=torch.float32, device=device)
    x = torch.tensor(model.anchors, device=device)
    v, states = torch.zeros_like(x), [x]
    for frame in range(1, len(hands)):
        # As in training: v0 is added on entering a frame and removed on leaving it.
        x, v = solver.frame(parameters, x, v + start, hands[frame - 1], hands[frame])
        v = v - start
        near = (x.abs() < LIMIT).all(dim=1)
        if not bool(near.all()):
            return torch.stack(states), f"anchor {int((~near).nonzero()[0])} left the scene in frame {frame}"
        states.append(x)
    return torch.stack(states), ""


def contraction(centers: np.ndarray, bound: np.ndarray) -> dict[str, float]:
    """How binding by absolute positions changes centers [G, 3], m, in frame 0: mean shift, m, and ratio of sizes.

    The size is the root mean square distance from the mean.
    """
    before, after = (float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean())) for points in (centers, bound))
    shift = float(np.linalg.norm(bound - centers, axis=1).mean())
    return {"frame0_shift": shift, "frame0_size_ratio": after / before if before else 1.0}
