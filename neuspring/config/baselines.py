"""Settings of the baseline models, which learn or need no spring-mass twin: `model` of a method row names one.

Both are adapted to captures with hands. The defaults are those of the public code where it says anything.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from neuspring.config.parse import Count, NonNegative, Positive, Section


@dataclass(frozen=True, kw_only=True)
class SpringGaus(Section):
    """Anchors with directed springs, trained on masks, or, as a variant, on points."""

    supervision: Literal["masks", "points"] = "masks"
    """masks: silhouettes of the splats, as published. points: the Chamfer and track losses of the other methods, with anchors drawn
    from the structure points; this needs no images."""
    anchors: Count = 1024
    """Number N of anchors, drawn at random from the occupied cells of a grid of 1 cm, or of 1 mm where there are too few cells."""
    neighbors: Count = 20
    """Number K of nearest anchors that an anchor feels."""
    full_neighbors: Count = 16
    """Number n_c of nearest anchors that are felt with full weight; the others are felt softly."""
    stiffness: Positive = 2000.0
    """Stiffness 10^kappa at the start, N at 1 kg."""
    damping: Positive = 0.2
    """Damping zeta at the start, N s at 1 kg."""
    substeps: Count = 50
    """Substeps per frame at the start."""
    max_substeps: Count = 1000
    """Largest number of substeps; if a frame fails with so many, training ends as a failure of the run."""
    iterations: Count = 100
    """Passes over the training frames, with an optimizer step per frame."""
    stiffness_rate: Positive = 1e-3
    """Adam's learning rate of kappa."""
    damping_rate: Positive = 1e-4
    """Adam's learning rate of exp(zeta)."""
    velocity_rate: Positive = 2.5e-4
    """Adam's learning rate of the initial velocity, which all anchors share, m/s."""
    vgg16: str | None = None
    """Path of torchvision's weights of VGG16 (vgg16-397923af.pth); null: they are looked for in torch hub's cache. Nothing is
    downloaded."""

    def __post_init__(self) -> None:
        if self.full_neighbors > self.neighbors:
            raise ValueError(f"full_neighbors: at most neighbors ({self.neighbors}), received {self.full_neighbors}")
        if self.max_substeps < self.substeps:
            raise ValueError(f"max_substeps: at least substeps ({self.substeps}), received {self.max_substeps}")


@dataclass(frozen=True, kw_only=True)
class GsDynamics(Section):
    """A graph network that moves particles by what the hands do next, with a step per centimeter of hand motion.

    Keys that are null have the values of a public configuration, by the scenario's category: rope and DLO cables take rope, cloth
    and package take cloth, all others take animals.
    """

    radius: Positive | None = None
    """Distance below which nodes feel each other, m. rope 0.08, animals 0.08, cloth 0.075."""
    neighbors: Count | None = None
    """Number k of nearest particles that a particle feels, itself included. rope 5, animals 6, cloth 6."""
    particles: Count | None = None
    """Largest number of particles of a graph. rope 100, animals 100, cloth 150."""
    noise: NonNegative | None = None
    """Half width of the uniform noise that training adds to positions in the history, m. rope 0.003, animals 0.003, cloth 0.002."""
    length_weight: NonNegative | None = None
    """Weight lambda of the length loss. rope 0.1, animals 0.05, cloth 0.1."""
    batch: Count | None = None
    """Windows per update. rope 16, animals 64, cloth 64."""
    width: Count = 512
    """Units of all hidden layers."""
    future: Count = 5
    """Steps that training predicts in a row."""
    step: Positive = 0.01
    """Motion of the tools that makes a step, m."""
    outlier_deviations: NonNegative = 3.0
    """Median absolute deviations by which the path length of a track may differ from the median before the track is dropped; 0
    drops none."""
    yaw: bool = True
    """Turn each training window by a random angle about the vertical."""
    epochs: Count = 50
    """Passes of training. The released predictions are of 50; the public code trains 500 to 1000."""
    updates_per_epoch: Count = 100
    """Optimizer steps per epoch, each on windows drawn at random."""
    learning_rate: Positive = 1e-3
    """Adam's learning rate."""


@dataclass(frozen=True, kw_only=True)
class Baselines(Section):
    """The models of the baselines; a method's own `settings` go on top."""

    spring_gaus: SpringGaus = field(default_factory=SpringGaus)
    gs_dynamics: GsDynamics = field(default_factory=GsDynamics)
