"""Settings of Spring-Gaus, as adapted to captures with hands; the defaults are those of the public adaptation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from neuspring.config.types import STRICT, Count, Finite, NonNegative, Positive


@dataclass(frozen=True, kw_only=True)
class SpringGaus:
    """Anchors with directed springs, trained on masks, or, as a variant, on points."""

    __pydantic_config__ = STRICT
    supervision: Literal["masks", "points"] = "masks"
    """masks: silhouettes of the splats, as published. points: the Chamfer and track losses of the other methods, with anchors drawn
    from the structure points; needs no images."""
    anchors: Count = 1024
    """N, drawn at random from the occupied cells of a grid of 1 cm, or of 1 mm where there are not enough."""
    neighbours: Count = 20
    """K: the nearest anchors that an anchor feels."""
    full_neighbours: Count = 16
    """n_c: so many of them with full weight, the others softly."""
    bound_anchors: Count = 16
    """Nearest anchors that a splat or a structure point follows."""
    exponent: NonNegative = 0.5
    """p in (1 + |e|)^p."""
    link_count: Count = 50
    """Most anchors that a controller is linked to, ..."""
    link_reach: Positive = 0.04
    """... none farther away in frame 0 than this, m."""
    link_stiffness: NonNegative = 3e4
    """N per unit strain at 1 kg, fixed."""
    stiffness: Positive = 2000.0
    """10^kappa at the start, N at 1 kg."""
    damping: Positive = 0.2
    """zeta at the start, N s at 1 kg."""
    ground_logit: Finite = -1.0
    """rho at the start: phi = clamp(1.2 sigmoid(rho) - 0.1, 0, 1) of the velocity along the ground is left after each substep."""
    substeps: Count = 50
    """Per frame at the start."""
    substeps_added: Count = 50
    """Further substeps at each of `substeps_raised`, and whenever a frame fails."""
    substeps_raised: tuple[Count, ...] = (25, 50)
    """Iterations from which there are more substeps."""
    max_substeps: Count = 1000
    """A frame that fails with so many ends training, as a failure of the run."""
    iterations: Count = 100
    """Passes over the training frames, an optimiser step per frame."""
    stiffness_rate: Positive = 1e-3
    """Adam's learning rate of kappa."""
    ground_rate: Positive = 1e-3
    """Of rho."""
    soft_rate: Positive = 1e-3
    """Of the soft vector's s."""
    damping_rate: Positive = 1e-4
    """Of exp(zeta)."""
    velocity_rate: Positive = 2.5e-4
    """Of the initial velocity, one for all anchors, m/s."""
    clip_gradient_norm: NonNegative = 1.0
    """Of each tensor by itself; 0 disables clipping."""
    l1: NonNegative = 0.2
    """Weight of the mean absolute difference of silhouettes."""
    dssim: NonNegative = 0.8
    """Weight of 1 - SSIM."""
    centroid: NonNegative = 1.0
    """Weight of the distance of the silhouettes' centroids, in widths of the picture."""
    features: NonNegative = 0.1
    """Weight of the mean squared difference of VGG16's features; without its weights the term is left out, and tables say so."""
    total_variation: NonNegative = 2.0
    """Weight of the mean squared differences of neighbouring pixels of the drawn silhouette."""
    ignore_hands: bool = False
    """Leave out what hands cover; as published, the object counts as absent there."""
    negative_damping: bool = False
    """Let zeta become negative, as published."""
    vgg16: str | None = None
    """Weights of torchvision's VGG16 (vgg16-397923af.pth); null: in torch hub's cache. Nothing is downloaded."""
    checkpoint_every: Annotated[int, Field(ge=1)] = 5
    """Iterations between checkpoints from which a killed job continues."""

    def __post_init__(self) -> None:
        if self.full_neighbours > self.neighbours:
            raise ValueError(f"full_neighbours: at most neighbours ({self.neighbours}), received {self.full_neighbours}")
        if self.max_substeps < self.substeps:
            raise ValueError(f"max_substeps: at least substeps ({self.substeps}), received {self.max_substeps}")
