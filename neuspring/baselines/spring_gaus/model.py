"""A Spring-Gaus model: anchors in frame 0, their directed neighbors, the controllers' links, and what is learned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from scipy.spatial import cKDTree

from neuspring.config.baselines import SpringGaus
from neuspring.core.artifacts import Artifact, array
from neuspring.core.errors import InputError, NumericalFailure

CELLS = (0.01, 0.001)
"""Cell sizes of the grids that anchors are drawn from, m."""
LINK_COUNT, LINK_REACH = 50, 0.04
"""A controller is linked to at most so many anchors, as far from it in frame 0, m."""
SHORTEST_LINK = 1e-4
"""Rest lengths of controller links are floored here, m: a controller may lie on an anchor."""
NEAREST = 1e-12
"""Distances to anchors are floored here before a weight is computed from them, m."""
BOUND_ANCHORS = 16
"""Nearest anchors that a splat or a structure point follows."""
GROUND_LOGIT = -1.0
"""rho at the start."""


@dataclass(frozen=True, kw_only=True)
class AnchorGraph(Artifact):
    """Which anchors and controllers each anchor feels. Springs are directed: row i is what anchor i feels."""

    kind: ClassVar[str] = "anchor_graph"
    anchors: np.ndarray = array("N,3", np.float32, "m", "positions in frame 0")
    neighbors: np.ndarray = array("N,K", np.int32, "1", "the K nearest other anchors, nearest first")
    lengths: np.ndarray = array("N,K", np.float32, "m", "their distances in frame 0, the rest lengths")
    link_starts: np.ndarray = array("L", np.int32, "1", "links of anchor i: link_starts[i] to link_starts[i + 1]")
    links: np.ndarray = array("M", np.int32, "1", "controller of each link")
    link_lengths: np.ndarray = array("M", np.float32, "m", "rest lengths of links")

    def check(self) -> None:
        anchors = len(self.anchors)
        if len(self.link_starts) != anchors + 1:
            raise InputError("spring_gaus.link_starts", f"{anchors + 1} entries are required", len(self.link_starts))
        if self.neighbors.size and not 0 <= self.neighbors.min() <= self.neighbors.max() < anchors:
            raise InputError("spring_gaus.neighbors", f"indices must lie in [0, {anchors})", int(self.neighbors.max()))
        if (self.lengths <= 0).any() or (self.link_lengths <= 0).any():
            raise InputError("spring_gaus.lengths", "every rest length must be positive", "0 or less")

    @classmethod
    def between(cls, anchors: np.ndarray, controllers: np.ndarray, neighbors: int) -> AnchorGraph:
        """The graph of anchors [N, 3] and controllers [C, 3] of frame 0, m.

        Raises NumericalFailure if there are too few anchors, or two at one place.
        """
        if len(anchors) <= neighbors:
            raise NumericalFailure(f"more anchors than neighbors ({neighbors}) are required, and there are {len(anchors)}")
        tree = cKDTree(anchors)
        distance, index = tree.query(anchors, k=neighbors + 1)
        if distance[:, 1].min() <= 0:
            raise NumericalFailure(f"two anchors lie at one place: {int(distance[:, 1].argmin())}")
        link_distance, near = tree.query(controllers, k=min(LINK_COUNT, len(anchors)), distance_upper_bound=LINK_REACH)
        link_distance, near = link_distance.reshape(len(controllers), -1), near.reshape(len(controllers), -1)
        controller, slot = np.nonzero(np.isfinite(link_distance))
        anchor, length = near[controller, slot], np.maximum(link_distance[controller, slot], SHORTEST_LINK)
        order = np.lexsort((controller, anchor))
        return AnchorGraph(
            anchors=anchors,
            # The nearest is the anchor itself: distances of others are positive.
            neighbors=index[:, 1:],
            lengths=distance[:, 1:],
            link_starts=np.searchsorted(anchor[order], np.arange(len(anchors) + 1)),
            links=controller[order],
            link_lengths=length[order],
        )


@dataclass(frozen=True, kw_only=True)
class AnchorPhysics:
    """Constants of the motion: they are not trained."""

    frame_time: float
    """s."""
    exponent: float = 0.5
    """p in (1 + |e|)^p."""
    link_stiffness: float = 3e4
    """N per unit strain of the controllers' links, at 1 kg."""
    gravity: float = 9.8
    """m/s^2, against up."""
    up_sign: float = 1.0
    """+1 where +z is up, -1 where -z is."""
    ground: bool = True
    """A plane at z = 0."""


@dataclass(frozen=True)
class AnchorParameters:
    """What is trained, in the form that the forces use, at 1 kg per anchor."""

    stiffness: torch.Tensor
    """[N] s_i, N: 10^kappa."""
    soft: torch.Tensor
    """[K] eta, by rank."""
    damping: torch.Tensor
    """zeta, N s: divided by a spring's rest length it is the constant of its dashpot."""
    friction: torch.Tensor
    """phi: the fraction of the velocity along the ground that remains after each substep on it."""


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
    def start(
        cls, graph: AnchorGraph, settings: SpringGaus, *, frame_time: float, up_sign: float, gravity: float, ground: bool
    ) -> SpringGausModel:
        """Before training: a homogeneous body at rest."""
        return cls(
            **vars(graph),
            kappa=np.full(len(graph.anchors), np.log10(settings.stiffness)),
            soft=np.zeros(1),
            theta=np.full(1, np.exp(settings.damping)),
            rho=np.full(1, GROUND_LOGIT),
            velocity=np.zeros(3),
            substeps=settings.substeps,
            frame_time=frame_time,
            up_sign=up_sign,
            gravity=gravity,
            ground=ground,
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

    The grid has the first of the sizes CELLS with so many occupied cells. If none has, all centers of the last are returned.
    """
    for size in CELLS:
        centers = (np.unique(np.floor(points / size).astype(np.int64), axis=0) + 0.5) * size
        if len(centers) >= count:
            return centers[np.sort(draw.choice(len(centers), count, replace=False))]
    return centers


class Follower:
    """Points [P, 3] that follow their `count` nearest anchors [N, 3] of frame 0, m: weighted means, w ~ distance^(-1/2) there."""

    def __init__(self, points: np.ndarray, anchors: np.ndarray, count: int, device: str) -> None:
        distance, index = cKDTree(anchors).query(points, k=min(count, len(anchors)))
        weights = np.maximum(distance.reshape(len(points), -1), NEAREST) ** -0.5
        weights /= weights.sum(axis=1, keepdims=True)
        self.indices = torch.tensor(index.reshape(weights.shape).astype(np.int64), device=device)
        self.weights = torch.tensor(weights.astype(np.float32), device=device)

    def __call__(self, anchors: torch.Tensor) -> torch.Tensor:
        """Places [P, 3] with the anchors at [N, 3]."""
        # The gradient of a bag of rows needs no [P, k, 3] in memory.
        weights = self.weights.to(anchors.dtype)
        return torch.nn.functional.embedding_bag(self.indices, anchors, per_sample_weights=weights, mode="sum")
