"""Settings of the baseline models, which learn or need no spring-mass twin: `model` of a method row names one.

Both are adapted to captures with hands. The defaults are those of the public code where it says anything, and so are the constants
beside their users (`neuspring.baselines.spring_gaus.model`, `neuspring.baselines.gs_dynamics.model`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from neuspring.config.parse import Count, Positive, SettingsSection


@dataclass(frozen=True, kw_only=True)
class SpringGaus(SettingsSection):
    """Anchors with directed springs, trained on masks, or, as a variant, on points."""

    supervision: Literal["masks", "points"] = "masks"
    """Training on silhouettes of the splats, as published, or on points. points: the Chamfer and track losses of the other
    methods, with anchors drawn from the structure points; this needs no images."""
    anchors: Count = 1024
    """Number N of anchors, drawn at random from the occupied cells of a grid of 1 cm, or of 1 mm where there are too few cells."""
    iterations: Count = 100
    """Passes over the training frames, with an optimizer step per frame."""


@dataclass(frozen=True, kw_only=True)
class GsDynamics(SettingsSection):
    """A graph network that moves particles by what the hands do next, with a step per centimeter of hand motion."""

    batch: Count | None = None
    """Windows per update; null: 16 for ropes, 64 for others, as published."""
    width: Count = 512
    """Units of all hidden layers."""
    step: Positive = 0.01
    """Motion of the tools that makes a step, m."""
    epochs: Count = 50
    """Passes of training. The released predictions are of 50; the public code trains 500 to 1000."""
    updates_per_epoch: Count = 100
    """Optimizer steps per epoch, each on windows drawn at random."""


@dataclass(frozen=True, kw_only=True)
class Baselines(SettingsSection):
    """The models of the baselines; a method's own `settings` go on top."""

    spring_gaus: SpringGaus = field(default_factory=SpringGaus)
    gs_dynamics: GsDynamics = field(default_factory=GsDynamics)
