"""Settings of appearance: how splats are trained on frame 0, how they are drawn in motion, and how pictures are scored."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from neuspring.core.section import Count, NonNegative, Positive, SettingsSection


@dataclass(frozen=True, kw_only=True)
class Appearance(SettingsSection):
    """Training of splats on frame 0; the defaults are those of the released training. Pixels are those of an image 848 wide."""

    iterations: Count = 10_000
    """Optimizer steps. Each takes one view, drawn without replacement."""
    fixed_radius: Positive | None = None
    """Standard deviation of every splat, m, which is then not trained; null: it is trained, and starts from the distance to the
    nearest splats."""
    start: Literal["seen", "shape_prior"] = "seen"
    """Places of the first splats: points that were seen, or the shape prior's surface. seen: points that were seen, and the shape
    prior's points where nothing was seen. shape_prior: the surface of the prior alone; without a prior, as for seen, and the run's
    notes say so."""
    degree: Annotated[int, Field(ge=0, le=3)] = 3
    """Degree of the spherical harmonics at the end."""
    spacing: NonNegative = 0.0
    """Width of a voxel in pixels of the camera, at the object; there is one first splat per voxel. 0: one per point that was seen,
    as released."""
    dssim: NonNegative = 0.4
    """Weight of 1 - SSIM; the released loss has this term twice, with 0.2 each."""
    mask: NonNegative = 0.8
    """Weight of the mean absolute difference of coverage and mask."""
    depth: NonNegative = 0.001
    """Weight of the mean absolute difference of depth, per m, where depth was measured on the object."""
    opacity_rate: Positive = 0.025
    """Learning rate of opacity logits."""


@dataclass(frozen=True, kw_only=True)
class Images(SettingsSection):
    """Appearance and the scores of pictures, for scenarios that have images."""

    enabled: bool = True
    """Training of splats, drawing and scoring of every method's prediction."""
    backend: Literal["auto", "warp", "gsplat"] = "auto"
    """Rasterizer; auto: gsplat on CUDA where it works (extra `gpu`), otherwise the platform's own (warp)."""
    views: Literal["first", "all"] = "first"
    """Cameras whose pictures are scored; the released evaluation takes the first."""
    video: bool = True
    """Videos: observed, predicted and error side by side, and a turntable of the twin."""
    appearance: Appearance = field(default_factory=Appearance)
