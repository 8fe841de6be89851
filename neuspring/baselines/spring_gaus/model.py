"""A trained Spring-Gaus model: the graph of its anchors, and the parameters that were learned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from neuspring.baselines.spring_gaus.graph import AnchorGraph
from neuspring.baselines.spring_gaus.solver import AnchorParameters, AnchorPhysics
from neuspring.config.spring_gaus import SpringGaus
from neuspring.core.artifacts import array


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
    negative_damping: bool

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
            full_neighbors=settings.full_neighbors,
            bound_anchors=settings.bound_anchors,
            negative_damping=settings.negative_damping,
        )

    def tensors(self, device: str, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
        """The parameters that are trained: kappa [N], soft [1], theta [1], rho [1], velocity [3]."""
        return {name: torch.tensor(getattr(self, name), device=device, dtype=dtype) for name in TRAINED}

    def parameters(self, tensors: Mapping[str, torch.Tensor]) -> AnchorParameters:
        """Values named as in `tensors`, in the form that the forces use; differentiable."""
        theta = tensors["theta"]
        return AnchorParameters(
            stiffness=10 ** tensors["kappa"],
            soft=soft_vector(tensors["soft"], self.neighbors.shape[1], self.full_neighbors),
            damping=torch.log(theta if self.negative_damping else theta.clamp(min=1.0)),
            friction=(1.2 * torch.sigmoid(tensors["rho"]) - 0.1).clamp(0.0, 1.0),
        )


TRAINED = ("kappa", "soft", "theta", "rho", "velocity")


def soft_vector(s: torch.Tensor, neighbors: int, full: int) -> torch.Tensor:
    """eta [K] by rank r: 1 below n_c = `full`, then clamp(2 - exp(softplus(s))^((r - n_c) / (K - n_c)), 0, 1), s [1]."""
    rank = torch.arange(neighbors, device=s.device, dtype=s.dtype)
    exponent = (rank - full) / max(neighbors - full, 1)
    eta = (2 - torch.exp(torch.nn.functional.softplus(s) * exponent)).clamp(0.0, 1.0)
    return torch.where(rank < full, torch.ones_like(eta), eta)
