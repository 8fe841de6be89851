"""Settings of Spring-Gaus, as adapted to captures with hands; the defaults are those of the public adaptation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from neuspring.config.types import Count, NonNegative, Positive, Section


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
    bound_anchors: Count = 16
    """Number of nearest anchors that a splat or a structure point follows."""
    link_stiffness: NonNegative = 3e4
    """Stiffness of the links, N per unit strain at 1 kg; it is not trained."""
    stiffness: Positive = 2000.0
    """Stiffness 10^kappa at the start, N at 1 kg."""
    damping: Positive = 0.2
    """Damping zeta at the start, N s at 1 kg."""
    substeps: Count = 50
    """Substeps per frame at the start."""
    substeps_added: Count = 50
    """Substeps that are added at each of `substeps_raised`, and whenever a frame fails."""
    substeps_raised: tuple[Count, ...] = (25, 50)
    """Iterations from which there are more substeps."""
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
    checkpoint_every: Annotated[int, Field(ge=1)] = 5
    """Iterations between checkpoints from which a killed job continues."""

    def __post_init__(self) -> None:
        if self.full_neighbors > self.neighbors:
            raise ValueError(f"full_neighbors: at most neighbors ({self.neighbors}), received {self.full_neighbors}")
        if self.max_substeps < self.substeps:
            raise ValueError(f"max_substeps: at least substeps ({self.substeps}), received {self.max_substeps}")
