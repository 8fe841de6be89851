"""A Spring-Gaus model: what is learned of anchors and saved, and its rollout: structure points, and the centers of its splats."""

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
"""Cell sizes of the grids that anchors are drawn from, m."""
BOUND_ANCHORS = 16
"""Nearest anchors that a splat or a structure point follows."""
MIN_ANCHOR_DISTANCE = 1e-12
"""Distances to anchors are floored here before a weight is computed from them, m."""
GROUND_LOGIT = -1.0
"""rho at the start."""


@dataclass(frozen=True, kw_only=True)
class SpringGausTraining(SpringGaus):
    """The settings with what the public code fixes."""

    neighbors: int = 20
    """Number K of nearest anchors that an anchor feels."""
    full_neighbors: int = 16
    """Number n_c of nearest anchors that are felt with full weight; the others are felt softly."""
    stiffness: float = 2000.0
    """Stiffness 10^kappa at the start, N at 1 kg."""
    damping: float = 0.2
    """Damping zeta at the start, N s at 1 kg."""
    substeps: int = 50
    """Substeps per frame at the start."""
    max_substeps: int = 1000
    """Largest number of substeps; if a frame fails with so many, training ends as a failure of the run."""
    stiffness_rate: float = 1e-3
    """Adam's learning rate of kappa."""
    damping_rate: float = 1e-4
    """Adam's learning rate of exp(zeta)."""
    velocity_rate: float = 2.5e-4
    """Adam's learning rate of the initial velocity, which all anchors share, m/s."""


@dataclass(frozen=True, kw_only=True)
class SpringGausModel(AnchorGraph, AnchorPhysics):
    """Anchors of frame 0 and the parameters of their motion, at 1 kg per anchor."""

    kind: ClassVar[str] = "spring_gaus"
    kappa: np.ndarray = array("N", np.float32, "log10 N", "stiffness of what anchor i feels")
    soft: np.ndarray = array("1", np.float32, "1", "s of the soft vector")
    theta: np.ndarray = array("1", np.float32, "1", "exp(zeta), zeta in N s")
    rho: np.ndarray = array("1", np.float32, "1", "logit of what the ground leaves of the velocity along it")
    velocity: np.ndarray = array("3", np.float32, "m/s", "of all anchors in frame 0")
    substeps: int
    """Per frame."""
    full_neighbors: int
    bound_anchors: int

    @classmethod
    def start(cls, graph: AnchorGraph, physics: AnchorPhysics, settings: SpringGausTraining) -> SpringGausModel:
        """Before training: a homogeneous body at rest."""
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
        """The parameters that are trained: kappa [N], soft [1], theta [1], rho [1], velocity [3]."""
        names = ("kappa", "soft", "theta", "rho", "velocity")
        return {name: torch.tensor(getattr(self, name), device=device, dtype=dtype) for name in names}

    def parameters(self, tensors: Mapping[str, torch.Tensor]) -> AnchorParameters:
        """Values named as in `tensors`, in the form that the forces use; differentiable."""
        return AnchorParameters(
            stiffness=10 ** tensors["kappa"],
            soft=soft_vector(tensors["soft"], self.neighbors.shape[1], self.full_neighbors),
            damping=torch.log(tensors["theta"].clamp(min=1.0)),
            friction=(1.2 * torch.sigmoid(tensors["rho"]) - 0.1).clamp(0.0, 1.0),
        )


def soft_vector(s: torch.Tensor, neighbors: int, full: int) -> torch.Tensor:
    """eta [K] by rank r: 1 below n_c = `full`, then clamp(2 - exp(softplus(s))^((r - n_c) / (K - n_c)), 0, 1), s [1]."""
    rank = torch.arange(neighbors, device=s.device, dtype=s.dtype)
    exponent = (rank - full) / max(neighbors - full, 1)
    eta = (2 - torch.exp(torch.nn.functional.softplus(s) * exponent)).clamp(0.0, 1.0)
    return torch.where(rank < full, torch.ones_like(eta), eta)


def choose_anchors(points: np.ndarray, count: int, draw: np.random.Generator) -> np.ndarray:
    """`count` random centers [N, 3] of occupied cells of a grid, m.

    The grid has the first of ANCHOR_CELL_SIZES with so many occupied cells. If none has, all centers of the last are returned.
    """
    for size in ANCHOR_CELL_SIZES:
        centers = (np.unique(np.floor(points / size).astype(np.int64), axis=0) + 0.5) * size
        if len(centers) >= count:
            return centers[np.sort(draw.choice(len(centers), count, replace=False))]
    return centers


class Follower:
    """Points [P, 3] that follow their `count` nearest anchors [N, 3] of frame 0, m: weighted means, w ~ distance^(-1/2) there."""

    def __init__(self, points: np.ndarray, anchors: np.ndarray, count: int, device: str) -> None:
        distance, index = cKDTree(anchors).query(points, k=min(count, len(anchors)))
        weights = np.maximum(distance.reshape(len(points), -1), MIN_ANCHOR_DISTANCE) ** -0.5
        weights /= weights.sum(axis=1, keepdims=True)
        self.indices = torch.tensor(index.reshape(weights.shape).astype(np.int64), device=device)
        self.weights = torch.tensor(weights.astype(np.float32), device=device)

    def __call__(self, anchors: torch.Tensor) -> torch.Tensor:
        """Places [P, 3] with the anchors at [N, 3]."""
        # The gradient of a bag of rows needs no [P, k, 3] in memory.
        weights = self.weights.to(anchors.dtype)
        return torch.nn.functional.embedding_bag(self.indices, anchors, per_sample_weights=weights, mode="sum")


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
        if reason := left_scene(x, frame, DIVERGENCE_RADIUS, "anchor"):
            return torch.stack(states), reason
        states.append(x)
    return torch.stack(states), ""


def contraction(centers: np.ndarray, bound: np.ndarray) -> dict[str, float]:
    """Change of centers [G, 3], m, in frame 0 by binding with absolute positions: mean shift, m, and ratio of sizes.

    The size is the root mean square distance from the mean.
    """
    before, after = (float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean())) for points in (centers, bound))
    shift = float(np.linalg.norm(bound - centers, axis=1).mean())
    return {"frame0_shift": shift, "frame0_size_ratio": after / before if before else 1.0}
