"""A trained GS-Dynamics model: the weights of its network, and how graphs are made for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import torch

from neuspring.baselines.gs_dynamics.network import Dynamics, weight_count
from neuspring.baselines.gs_dynamics.rules import Rules
from neuspring.core.artifacts import Artifact, array
from neuspring.core.errors import InputError


@dataclass(frozen=True, kw_only=True)
class GsDynamicsModel(Artifact):
    """Knows no object: it moves the structure points of any scenario."""

    kind: ClassVar[str] = "gs_dynamics"
    weights: np.ndarray = array("W", np.float32, "1", "parameters of network.Dynamics in their order")
    rules: Rules

    def check(self) -> None:
        count = weight_count(self.rules)
        if len(self.weights) != count:
            raise InputError("gs_dynamics.weights", f"{count} weights are required", len(self.weights))

    @classmethod
    def _build(cls, arrays: dict[str, np.ndarray], plain: dict[str, Any], prefix: str) -> Self:
        # Files of earlier versions hold this as well; it is a constant now.
        plain["rules"].pop("hand_gap", None)
        return super()._build(arrays, plain, prefix)

    def dynamics(self, device: str) -> Dynamics:
        """The network on a device."""
        return Dynamics.of(self.rules, torch.tensor(self.weights, device=device))
