"""The model of Spring-Gaus: its anchors and trained parameters, and the rollout of structure points and splat centers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from scipy.spatial import cKDTree

from neuspring.baselines.results import DIVERGENCE_RADIUS, Prediction
from neuspring.core.artifacts import Observations, Trajectory, array
from neuspring.extensions.spring_gaus.physics import AnchorGraph, AnchorParameters, AnchorPhysics, AnchorSolver
from neuspring.extensions.spring_gaus.settings import SpringGaus
from neuspring.twin.rollout import left_scene

ANCHOR_CELL_SIZES = (0.01, 0.001)
"""Cell sizes of the grids from which anchors are sampled, m."""
BOUND_ANCHORS = 16
"""Number of nearest anchors that a splat or a structure point follows."""
MIN_ANCHOR_DISTANCE = 1e-12
"""Minimum distance to anchors in weights, m."""
GROUND_LOGIT = -1.0
"""Initial value of rho."""


@dataclass(frozen=True, kw_only=True)
class SpringGausTraining(SpringGaus):
    """The settings and the constants of the public code."""

    neighbors: int = 20
    """Number K of nearest anchors whose springs pull an anchor."""
    full_neighbors: int = 16
    """Number n_c of nearest anchors with full weight; the soft vector weights the others."""
    stiffness: float = 2000.0
    """Initial stiffness 10^kappa, N at 1 kg."""
    damping: float = 0.2
    """Initial damping zeta, N s at 1 kg."""
    substeps: int = 50
    """Initial number of substeps per frame."""
    max_substeps: int = 1000
    """Maximum number of substeps; if a frame fails with this number, the run fails."""
    stiffness_rate: float = 1e-3
    """Adam's learning rate of kappa."""
    damping_rate: float = 1e-4
    """Adam's learning rate of exp(zeta)."""
    velocity_rate: float = 2.5e-4
    """Adam's learning rate of the initial velocity, m/s, which all anchors share."""


@dataclass(frozen=True, kw_only=True)
class SpringGausModel(AnchorGraph, AnchorPhysics):
    """Anchors of frame 0 and the parameters of their motion, at 1 kg per anchor."""

    kind: ClassVar[str] = "spring_gaus"
    kappa: np.ndarray = array("N", np.float32, "log10 N", "stiffness of the springs that pull anchor i")
    soft: np.ndarray = array("1", np.float32, "1", "parameter s of the soft vector")
    theta: np.ndarray = array("1", np.float32, "1", "exp(zeta), zeta in N s")
    rho: np.ndarray = array("1", np.float32, "1", "logit of the velocity fraction that remains along the ground")
    velocity: np.ndarray = array("3", np.float32, "m/s", "velocity of all anchors in frame 0")
    substeps: int
    """Substeps per frame."""
    full_neighbors: int
    bound_anchors: int

    @classmethod
    def start(cls, graph: AnchorGraph, physics: AnchorPhysics, settings: SpringGausTraining) -> SpringGausModel:
        """The initial model: a homogeneous object at rest."""
        return cls(
            **vars(graph),
            **vars(physics),
            kappa=np.full(len(graph.anchors), np.log10(settings.stiffness)),
            soft=np.zeros(1),
            theta=np.full(1, np.exp(settings.damping)),
            rho=np.full(1, GROUND_LOGIT),
            velocity=np.zeros(3),
            substeps=settings.substeps,
            full_neighbors=settings.full_neighbors,
            bound_anchors=BOUND_ANCHORS,
        )

    def tensors(self, device: str, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
        """The trained parameters: kappa [N], soft [1], theta [1], rho [1], velocity [3]."""
        names = ("kappa", "soft", "theta", "rho", "velocity")
        return {name: torch.tensor(getattr(self, name), device=device, dtype=dtype) for name in names}

    def parameters(self, tensors: Mapping[str, torch.Tensor]) -> AnchorParameters:
        """The values that forces use, from parameters named as in `tensors`; differentiable."""
        return AnchorParameters(
            stiffness=10 ** tensors["kappa"],
            soft=soft_vector(tensors["soft"], self.neighbors.shape[1], self.full_neighbors),
            damping=torch.log(tensors["theta"].clamp(min=1.0)),
            friction=(1.2 * torch.sigmoid(tensors["rho"]) - 0.1).clamp(0.0, 1.0),
        )


def soft_vector(s: torch.Tensor, neighbors: int, full: int) -> torch.Tensor:
    """The soft vector eta [K] by rank r: 1 below n_c = `full`, else clamp(2 - exp(softplus(s))^((r - n_c) / (K - n_c)), 0, 1)."""
    rank = torch.arange(neighbors, device=s.device, dtype=s.dtype)
    exponent = (rank - full) / max(neighbors - full, 1)
    eta = (2 - torch.exp(torch.nn.functional.softplus(s) * exponent)).clamp(0.0, 1.0)
    return torch.where(rank < full, torch.ones_like(eta), eta)


def choose_anchors(points: np.ndarray, count: int, draw: np.random.Generator) -> np.ndarray:
    """`count` random centers [N, 3], m, of occupied cells of a grid.

    The cell size is the first of ANCHOR_CELL_SIZES with enough occupied cells. Without one, all centers of the last size are
    returned.
    """
    for size in ANCHOR_CELL_SIZES:
        centers = (np.unique(np.floor(points / size).astype(np.int64), axis=0) + 0.5) * size
        if len(centers) >= count:
            return centers[np.sort(draw.choice(len(centers), count, replace=False))]
    return centers


class Follower:
    """Points [P, 3], m, that follow their `count` nearest anchors [N, 3] of frame 0 by weighted means, w ~ distance^(-1/2)."""

    def __init__(self, points: np.ndarray, anchors: np.ndarray, count: int, device: str) -> None:
        distance, index = cKDTree(anchors).query(points, k=min(count, len(anchors)))
        weights = np.maximum(distance.reshape(len(points), -1), MIN_ANCHOR_DISTANCE) ** -0.5
        weights /= weights.sum(axis=1, keepdims=True)
        self.indices = torch.tensor(index.reshape(weights.shape).astype(np.int64), device=device)
        self.weights = torch.tensor(weights.astype(np.float32), device=device)

    def __call__(self, anchors: torch.Tensor) -> torch.Tensor:
        """Positions [P, 3] for anchors at [N, 3]."""
        # The gradient of embedding_bag needs no [P, k, 3] in memory.
        weights = self.weights.to(anchors.dtype)
        return torch.nn.functional.embedding_bag(self.indices, anchors, per_sample_weights=weights, mode="sum")


def predict(model: SpringGausModel, observations: Observations, splats: np.ndarray | None, device: str) -> Prediction:
    """Predict structure points and splat centers in all frames, from the centers of the splats in frame 0 [G, 3], m, if any."""
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
    # The loop handles one frame at a time, because all frames of all splats may not fit on the device.
    centers = np.stack([follow(frame).cpu().numpy() for frame in anchors])
    return Prediction(trajectory, facts | contraction(splats, centers[0]), centers)


@torch.no_grad()
def roll_out(model: SpringGausModel, controllers: np.ndarray, device: str) -> tuple[torch.Tensor, str]:
    """Anchors [F, N, 3], m, moved by controllers [T, C, 3], m, from frame 0 on, and the reason for F < T (empty if F = T)."""
    solver = AnchorSolver(model, model, model.substeps, device)
    parameters = model.parameters(model.tensors(device))
    start, hands = torch.tensor(model.velocity, device=device), torch.tensor(controllers, dtype=torch.float32, device=device)
    x = torch.tensor(model.anchors, device=device)
    v, states = torch.zeros_like(x), [x]
    for frame in range(1, len(hands)):
        # As in training, v0 is added at the start of a frame and removed at its end.
        x, v = solver.frame(parameters, x, v + start, hands[frame - 1], hands[frame])
        v = v - start
        if reason := left_scene(x, frame, DIVERGENCE_RADIUS, "anchor"):
            return torch.stack(states), reason
        states.append(x)
    return torch.stack(states), ""


def contraction(centers: np.ndarray, bound: np.ndarray) -> dict[str, float]:
    """Change of the centers [G, 3], m, in frame 0, because they follow absolute positions: mean shift, m, and ratio of sizes.

    The size is the root mean square distance from the mean.
    """
    before, after = (float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean())) for points in (centers, bound))
    shift = float(np.linalg.norm(bound - centers, axis=1).mean())
    return {"frame0_shift": shift, "frame0_size_ratio": after / before if before else 1.0}
