"""A trained Spring-Gaus model: anchors, whom they feel, and what was learned about them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from neuspring.baselines.spring_gaus.graph import AnchorGraph
from neuspring.baselines.spring_gaus.solver import AnchorParameters, AnchorPhysics
from neuspring.config.spring_gaus import SpringGaus
from neuspring.core.artifacts import Artifact, array
from neuspring.core.errors import InputError


@dataclass(frozen=True, kw_only=True)
class SpringGausModel(Artifact):
    """Anchors of frame 0 and the parameters of their motion, at 1 kg per anchor."""

    kind: ClassVar[str] = "spring_gaus"
    anchors: np.ndarray = array("N,3", np.float32, "m", "positions in frame 0")
    neighbours: np.ndarray = array("N,K", np.int32, "1", "nearest other anchors, nearest first")
    lengths: np.ndarray = array("N,K", np.float32, "m", "rest lengths")
    link_starts: np.ndarray = array("L", np.int32, "1", "links of anchor i: link_starts[i] to link_starts[i + 1]")
    links: np.ndarray = array("M", np.int32, "1", "controller of each link")
    link_lengths: np.ndarray = array("M", np.float32, "m", "rest lengths of links")
    kappa: np.ndarray = array("N", np.float32, "log10 N", "stiffness of what anchor i feels")
    soft: np.ndarray = array("1", np.float32, "1", "s of the soft vector")
    theta: np.ndarray = array("1", np.float32, "1", "exp(zeta), zeta in N s")
    rho: np.ndarray = array("1", np.float32, "1", "logit of what the ground leaves of the velocity along it")
    velocity: np.ndarray = array("3", np.float32, "m/s", "of all anchors in frame 0")
    substeps: int
    """Per frame."""
    frame_time: float
    """s."""
    up_sign: float
    gravity: float
    """m/s^2."""
    ground: bool
    exponent: float
    link_stiffness: float
    full_neighbours: int
    bound_anchors: int
    negative_damping: bool

    def check(self) -> None:
        anchors = len(self.anchors)
        if len(self.link_starts) != anchors + 1:
            raise InputError("spring_gaus.link_starts", f"{anchors + 1} entries are required", len(self.link_starts))
        if self.neighbours.size and not 0 <= self.neighbours.min() <= self.neighbours.max() < anchors:
            raise InputError("spring_gaus.neighbours", f"indices must lie in [0, {anchors})", int(self.neighbours.max()))
        if (self.lengths <= 0).any() or (self.link_lengths <= 0).any():
            raise InputError("spring_gaus.lengths", "every rest length must be positive", "0 or less")

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
            rho=np.full(1, settings.ground_logit),
            velocity=np.zeros(3),
            substeps=settings.substeps,
            frame_time=frame_time,
            up_sign=up_sign,
            gravity=gravity,
            ground=ground,
            exponent=settings.exponent,
            link_stiffness=settings.link_stiffness,
            full_neighbours=settings.full_neighbours,
            bound_anchors=settings.bound_anchors,
            negative_damping=settings.negative_damping,
        )

    @property
    def graph(self) -> AnchorGraph:
        """Who pulls whom."""
        return AnchorGraph(self.anchors, self.neighbours, self.lengths, self.link_starts, self.links, self.link_lengths)

    @property
    def physics(self) -> AnchorPhysics:
        """What was not trained."""
        return AnchorPhysics(self.frame_time, self.exponent, self.link_stiffness, self.gravity, self.up_sign, self.ground)

    def tensors(self, device: str, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
        """What is trained: kappa [N], soft [1], theta [1], rho [1], velocity [3]."""
        return {name: torch.tensor(getattr(self, name), device=device, dtype=dtype) for name in TRAINED}

    def parameters(self, tensors: Mapping[str, torch.Tensor]) -> AnchorParameters:
        """The tensors of `tensors` as forces take them, differentiably."""
        theta = tensors["theta"]
        return AnchorParameters(
            stiffness=10 ** tensors["kappa"],
            soft=soft_vector(tensors["soft"], self.neighbours.shape[1], self.full_neighbours),
            damping=torch.log(theta if self.negative_damping else theta.clamp(min=1.0)),
            friction=(1.2 * torch.sigmoid(tensors["rho"]) - 0.1).clamp(0.0, 1.0),
        )


TRAINED = ("kappa", "soft", "theta", "rho", "velocity")


def soft_vector(s: torch.Tensor, neighbours: int, full: int) -> torch.Tensor:
    """eta [K] by rank r: 1 below n_c = `full`, then clamp(2 - exp(softplus(s))^((r - n_c) / (K - n_c)), 0, 1), s [1]."""
    rank = torch.arange(neighbours, device=s.device, dtype=s.dtype)
    exponent = (rank - full) / max(neighbours - full, 1)
    eta = (2 - torch.exp(torch.nn.functional.softplus(s) * exponent)).clamp(0.0, 1.0)
    return torch.where(rank < full, torch.ones_like(eta), eta)
