"""Settings of images: how splats are trained on frame 0, how they are rendered, and how images are scored."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from neuspring.core.section import Count, NonNegative, Positive, SettingsSection


@dataclass(frozen=True, kw_only=True)
class Appearance(SettingsSection):
    """Training of splats on frame 0. Defaults: the released training. Pixels refer to an image 848 pixels wide."""

    iterations: Count = 10_000
    """Optimizer steps. Each uses one view, drawn without replacement."""
    fixed_radius: Positive | None = None
    """Standard deviation of every splat, m, not trained; null: trained, starting from the distance to the nearest splats."""
    start: Literal["seen", "shape_prior"] = "seen"
    """Initial splats: observed points, or the shape prior's surface. seen: observed points, and points of the shape prior where
    nothing was observed. shape_prior: only the surface of the prior; without a prior, the same as seen, and the run notes it."""
    degree: Annotated[int, Field(ge=0, le=3)] = 3
    """Final degree of the spherical harmonics."""
    spacing: NonNegative = 0.0
    """Voxel width, in pixels at the object; one initial splat per voxel. 0: one per observed point, as released."""
    dssim: NonNegative = 0.4
    """Weight of 1 - SSIM; the released loss contains this term twice, with 0.2 each."""
    mask: NonNegative = 0.8
    """Weight of the mean absolute difference of coverage and mask."""
    depth: NonNegative = 0.001
    """Weight of the mean absolute depth error, per m, over measured object pixels."""
    opacity_rate: Positive = 0.025
    """Learning rate of opacity logits."""


@dataclass(frozen=True, kw_only=True)
class Images(SettingsSection):
    """Splats and image scores, for scenarios with images."""

    enabled: bool = True
    """Train splats, and render and score every method's prediction."""
    backend: Literal["auto", "warp", "gsplat"] = "auto"
    """Rasterizer; auto: gsplat if it works on CUDA (extra `gpu`), otherwise warp, which is built in."""
    views: Literal["first", "all"] = "first"
    """Cameras whose images are scored; the released evaluation uses the first."""
    video: bool = True
    """Write videos: observed, predicted and error side by side, and a turntable of the twin."""
    appearance: Appearance = field(default_factory=Appearance)
