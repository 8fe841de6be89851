"""Settings of appearance: how splats are trained on frame 0, how they are drawn in motion, and how pictures are scored."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from neuspring.config.types import STRICT, Count, NonNegative, Positive

Fraction = Annotated[float, Field(gt=0, lt=1)]


@dataclass(frozen=True, kw_only=True)
class Appearance:
    """Training of splats on frame 0; the defaults are those of the released training. Pixels are those of an image 848 wide."""

    __pydantic_config__ = STRICT
    iterations: Count = 10_000
    """Optimiser steps, one view each, views drawn without replacement."""
    isotropic: bool = True
    """One scale per splat; false: one per axis."""
    fixed_radius: Positive | None = None
    """Standard deviation of every splat, m, which is not trained; null: trained, from the distance to the nearest others."""
    start: Literal["seen", "shape_prior", "alpha"] = "seen"
    """First splats. seen: points that were seen, and the shape prior's where nothing was. shape_prior: the prior's surface alone;
    without a prior, as seen, which the run's notes say. alpha: grey, at random within the alpha shape of the seen points."""
    degree: Annotated[int, Field(ge=0, le=3)] = 3
    """Of the harmonics at the end."""
    degree_every: Count = 1000
    """Steps after which the degree in use rises by one, from 0."""
    spacing: NonNegative = 0.0
    """First splats: one per voxel as wide at the object as this many pixels of the camera's own; 0: one per point that was seen, as
    released."""
    opacity: Fraction = 0.1
    """Of the first splats."""
    l1: NonNegative = 0.8
    """Weight of the mean absolute difference of colours."""
    dssim: NonNegative = 0.4
    """Weight of 1 - SSIM; the released loss has it twice, 0.2 each."""
    mask: NonNegative = 0.8
    """Weight of the mean absolute difference of coverage and mask."""
    depth: NonNegative = 0.001
    """Weight of the mean absolute difference of depth, per m, where it was measured on the object."""
    hand_margin: NonNegative = 8.0
    """Side of the square, pixels, by which the hands' masks are dilated; what lies in them is not compared."""
    position_rate: Positive = 1.6e-4
    """Learning rate of means, per extent: 1.1 times the largest distance of a camera from their middle."""
    position_rate_end: Positive = 1.6e-6
    """The same after `position_steps`, log-linear between."""
    position_steps: Count = 30_000
    """See position_rate_end."""
    colour_rate: Positive = 2.5e-3
    """Learning rate of the first harmonic; the others' is a twentieth."""
    opacity_rate: Positive = 0.025
    """Learning rate of opacity logits."""
    scale_rate: Positive = 5e-3
    """Learning rate of log scales."""
    rotation_rate: Positive = 1e-3
    """Learning rate of quaternions; without effect on isotropic splats."""
    densify_from: Annotated[int, Field(ge=0)] = 500
    """Steps before splats are first cloned, split and pruned."""
    densify_until: Annotated[int, Field(ge=0)] = 15_000
    """Steps after which they are not any more."""
    densify_every: Count = 100
    """Steps between."""
    densify_gradient: Positive = 2e-4
    """Mean gradient of the place in the picture, per half picture, from which a splat is cloned or split."""
    split_size: Positive = 0.01
    """Part of the extent from which a splat is split, not cloned."""
    prune_opacity: Fraction = 0.005
    """Fainter splats are removed."""
    prune_radius: Positive = 20.0
    """Pixels; after the first reset, splats that ever were larger are removed, ..."""
    prune_size: Positive = 0.1
    """... and those larger than this part of the extent."""
    reset_every: Count = 3000
    """Steps between resets of all opacities to at most 0.01."""
    most_splats: Count = 300_000
    """No more are made."""

    def __post_init__(self) -> None:
        if self.fixed_radius is not None and not self.isotropic:
            raise ValueError("fixed_radius: splats of one radius are isotropic, received isotropic: false")


@dataclass(frozen=True, kw_only=True)
class ImageQuirks:
    """Behaviours of the released evaluation of pictures that are not right; all off by default."""

    __pydantic_config__ = STRICT
    second_camera_intrinsics: bool = False
    """Draw every view with the intrinsics of the second camera."""
    any_alpha: bool = False
    """Count every pixel as object whose 8-bit coverage is not zero; else coverage of a half."""
    unit_lpips: bool = False
    """Leave LPIPS' inputs in [0, 1]; else [-1, 1], as its networks were trained."""
    corner_pixels: bool = False
    """Take calibrated intrinsics as they are, half a pixel off."""
    degenerate_skinning: bool = False
    """One node on a line of neighbours turns all nodes as itself, several turn none."""


@dataclass(frozen=True, kw_only=True)
class LpipsWeights:
    """Where the weights of LPIPS lie. Nothing is downloaded; without them LPIPS is not computed, and tables say so."""

    __pydantic_config__ = STRICT
    backbone: str | None = None
    """AlexNet of torchvision (alexnet-owt-7be5be79.pth); null: in torch hub's cache."""
    heads: str | None = None
    """Linear heads, version 0.1 (alex.pth); null: in torch hub's cache (lpips_alex_v0.1.pth), in package lpips or torchmetrics."""


@dataclass(frozen=True, kw_only=True)
class Images:
    """Appearance and the scores of pictures, for scenarios that have images."""

    __pydantic_config__ = STRICT
    enabled: bool = True
    """Train splats, draw every method's prediction and score it."""
    backend: Literal["auto", "warp", "gsplat"] = "auto"
    """Rasteriser. auto: gsplat on CUDA where it works (extra `gpu`), else ours."""
    views: Literal["first", "all"] = "first"
    """Cameras that are scored; the released evaluation takes the first."""
    opacity: NonNegative = 0.1
    """Splats not above this opacity are left out when the twin moves, as released."""
    frozen_skinning: bool = False
    """Keep the nodes that each splat follows from the first frame on, as for real time."""
    video: bool = True
    """Write observed, predicted and error side by side, and a turntable of the twin."""
    appearance: Appearance = field(default_factory=Appearance)
    """See [images.appearance](#imagesappearance)."""
    lpips: LpipsWeights = field(default_factory=LpipsWeights)
    """See [images.lpips](#imageslpips)."""
    released_quirks: ImageQuirks = field(default_factory=ImageQuirks)
    """See [images.released_quirks](#imagesreleased_quirks)."""
