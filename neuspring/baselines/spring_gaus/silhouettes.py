"""The loss of Spring-Gaus: white splats on black against the object's mask, one camera at a time.

    L = l1 |A - M| + dssim (1 - SSIM(A, M)) + centroid |c(A) - c(M)| / W + features MSE(VGG16(A), VGG16(M)) + total_variation TV(A)

A the drawn coverage, M the mask, c the centroid in pixels, W the picture's width, TV the mean squared difference of neighbors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from neuspring.config.spring_gaus import SpringGaus
from neuspring.splats.ssim import ssim

Features = Callable[[torch.Tensor], torch.Tensor]
"""Pictures [B, 3, H, W] in 0..1 -> features."""
LEAST_COVER = 1e-6
"""Floor of a silhouette's area, px, where a centroid is divided by it."""


def centroid(silhouette: torch.Tensor) -> torch.Tensor:
    """Mean (column, row) [2] of a silhouette [H, W], px."""
    rows = torch.arange(silhouette.shape[0], device=silhouette.device, dtype=silhouette.dtype)
    columns = torch.arange(silhouette.shape[1], device=silhouette.device, dtype=silhouette.dtype)
    total = silhouette.sum().clamp(min=LEAST_COVER)
    return torch.stack([(silhouette.sum(dim=0) * columns).sum(), (silhouette.sum(dim=1) * rows).sum()]) / total


def total_variation(picture: torch.Tensor) -> torch.Tensor:
    """Mean squared difference of vertical neighbors plus that of horizontal ones, of a picture [H, W]."""
    return (picture[1:] - picture[:-1]).square().mean() + (picture[:, 1:] - picture[:, :-1]).square().mean()


@dataclass(frozen=True)
class SilhouetteLoss:
    """Compares a drawn silhouette with a mask."""

    settings: SpringGaus
    features: Features | None = None
    """None: the term is left out."""

    def __call__(self, drawn: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Loss of a drawn coverage [H, W] against a mask [H, W], both in 0..1."""
        settings = self.settings
        total = settings.l1 * (drawn - mask).abs().mean()
        if settings.dssim:
            total = total + settings.dssim * (1 - ssim(drawn[None], mask[None]))
        if settings.centroid and bool(mask.any()):
            total = total + settings.centroid * (centroid(drawn) - centroid(mask)).norm() / drawn.shape[1]
        if settings.features and self.features is not None:
            with torch.no_grad():
                target = self.features(mask.expand(1, 3, -1, -1))
            total = total + settings.features * (self.features(drawn.expand(1, 3, -1, -1)) - target).square().mean()
        return total + settings.total_variation * total_variation(drawn)
