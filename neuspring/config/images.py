"""Settings of appearance: how splats are trained on frame 0, how they are drawn in motion, and how pictures are scored."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from neuspring.config.parse import Count, NonNegative, Positive, Section

Fraction = Annotated[float, Field(gt=0, lt=1)]


@dataclass(frozen=True, kw_only=True)
class Appearance(Section):
    """Training of splats on frame 0; the defaults are those of the released training. Pixels are those of an image 848 wide."""

    iterations: Count = 10_000
    """Optimizer steps. Each takes one view, drawn without replacement."""
    isotropic: bool = True
    """Each splat has one scale; false: one scale per axis."""
    fixed_radius: Positive | None = None
    """Standard deviation of every splat, m, which is then not trained; null: it is trained, and starts from the distance to the
    nearest splats."""
    start: Literal["seen", "shape_prior"] = "seen"
    """Where the first splats are. seen: points that were seen, and the shape prior's points where nothing was seen. shape_prior:
    the surface of the prior alone; without a prior, as for seen, and the run's notes say so."""
    degree: Annotated[int, Field(ge=0, le=3)] = 3
    """Degree of the spherical harmonics at the end."""
    spacing: NonNegative = 0.0
    """Width of a voxel in pixels of the camera, at the object; there is one first splat per voxel. 0: one per point that was seen,
    as released."""
    l1: NonNegative = 0.8
    """Weight of the mean absolute difference of colors."""
    dssim: NonNegative = 0.4
    """Weight of 1 - SSIM; the released loss has this term twice, with 0.2 each."""
    mask: NonNegative = 0.8
    """Weight of the mean absolute difference of coverage and mask."""
    depth: NonNegative = 0.001
    """Weight of the mean absolute difference of depth, per m, where depth was measured on the object."""
    position_rate: Positive = 1.6e-4
    """Learning rate of means at the start, per extent of the scene. The extent is 1.1 times the largest distance of a camera from
    the cameras' center."""
    color_rate: Positive = 2.5e-3
    """Learning rate of the first harmonic; that of the others is a twentieth."""
    opacity_rate: Positive = 0.025
    """Learning rate of opacity logits."""
    scale_rate: Positive = 5e-3
    """Learning rate of log scales."""
    densify_from: Annotated[int, Field(ge=0)] = 500
    """Steps before splats are cloned, split and pruned for the first time."""
    densify_until: Annotated[int, Field(ge=0)] = 15_000
    """Steps after which splats are no longer cloned, split and pruned."""
    densify_every: Count = 100
    """Steps between two rounds of cloning, splitting and pruning."""
    densify_gradient: Positive = 2e-4
    """Smallest mean gradient of a splat's place in the picture, per half picture, for which it is cloned or split."""
    split_size: Positive = 0.01
    """Size, as part of the extent, above which a splat is split; smaller ones are cloned."""
    prune_opacity: Fraction = 0.005
    """Opacity below which splats are removed."""
    most_splats: Count = 300_000
    """Largest number of splats."""

    def __post_init__(self) -> None:
        if self.fixed_radius is not None and not self.isotropic:
            raise ValueError("fixed_radius: splats of one radius are isotropic, received isotropic: false")


@dataclass(frozen=True, kw_only=True)
class ImageQuirks(Section):
    """Errors of the released evaluation of pictures; all are off by default."""

    second_camera_intrinsics: bool = False
    """Draw every view with the intrinsics of the second camera."""
    any_alpha: bool = False
    """Count every pixel as object whose 8-bit coverage is not zero; otherwise the coverage must be at least a half."""
    unit_lpips: bool = False
    """Leave the inputs of LPIPS in [0, 1]; otherwise they are in [-1, 1], as its networks were trained."""
    corner_pixels: bool = False
    """Use calibrated intrinsics unchanged, which are half a pixel off."""
    degenerate_skinning: bool = False
    """Let one node on a line of neighbors turn all nodes as it turns; several such nodes turn none."""


@dataclass(frozen=True, kw_only=True)
class LpipsWeights(Section):
    """Weights of LPIPS. Nothing is downloaded; without the weights LPIPS is not computed, and tables say so."""

    backbone: str | None = None
    """Path of torchvision's AlexNet (alexnet-owt-7be5be79.pth); null: it is looked for in torch hub's cache."""
    heads: str | None = None
    """Path of the linear heads, version 0.1 (alex.pth); null: they are looked for in torch hub's cache (lpips_alex_v0.1.pth) and in
    the packages lpips and torchmetrics."""


@dataclass(frozen=True, kw_only=True)
class Images(Section):
    """Appearance and the scores of pictures, for scenarios that have images."""

    enabled: bool = True
    """Train splats, draw every method's prediction and score it."""
    backend: Literal["auto", "warp", "gsplat"] = "auto"
    """Rasterizer. auto: gsplat on CUDA where it works (extra `gpu`), otherwise the platform's own (warp)."""
    views: Literal["first", "all"] = "first"
    """Cameras whose pictures are scored; the released evaluation takes the first."""
    opacity: NonNegative = 0.1
    """Opacity that a splat must exceed to be drawn when the twin moves, as released."""
    frozen_skinning: bool = False
    """Each splat follows the same nodes as in the first frame, as for real time; false: nodes are chosen anew in each frame."""
    video: bool = True
    """Write videos: observed, predicted and error side by side, and a turntable of the twin."""
    appearance: Appearance = field(default_factory=Appearance)
    lpips: LpipsWeights = field(default_factory=LpipsWeights)
    released_quirks: ImageQuirks = field(default_factory=ImageQuirks)
