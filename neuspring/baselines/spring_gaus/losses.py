"""Losses of the anchors of a frame: on silhouettes of the splats that follow them, or on points that do.

Silhouettes are white splats on black against the object's mask, in one camera:

    L = 0.2 |A - M| + 0.8 (1 - SSIM(A, M)) + |c(A) - c(M)| / W + 0.1 MSE(VGG16(A), VGG16(M)) + 2 TV(A)

A the drawn coverage, M the mask, c the centroid in pixels, W the picture's width, TV the mean squared difference of neighbors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from neuspring.baselines.spring_gaus.model import Follower
from neuspring.splats.losses import ssim
from neuspring.splats.model import Gaussians
from neuspring.splats.rasterize import Backend, rasterize
from neuspring.splats.view import View
from neuspring.twin.losses import FrameLoss

Features = Callable[[torch.Tensor], torch.Tensor]
"""Pictures [B, 3, H, W] in 0..1 -> features."""
L1, DSSIM, FEATURES, VARIATION = 0.2, 0.8, 0.1, 2.0
"""Weights of the terms, as published."""
LEAST_COVER = 1e-6
"""Floor of a silhouette's area, px, where a centroid is divided by it."""


def silhouette_loss(drawn: torch.Tensor, mask: torch.Tensor, features: Features | None) -> torch.Tensor:
    """Loss of a drawn coverage [H, W] against a mask [H, W], both in 0..1; without features their term is left out."""
    total = L1 * (drawn - mask).abs().mean()
    total = total + DSSIM * (1 - ssim(drawn[None], mask[None]))
    if bool(mask.any()):
        total = total + (centroid(drawn) - centroid(mask)).norm() / drawn.shape[1]
    if features is not None:
        total = total + FEATURES * feature_error(drawn, mask, features)
    return total + VARIATION * total_variation(drawn)


def centroid(silhouette: torch.Tensor) -> torch.Tensor:
    """Mean (column, row) [2] of a silhouette [H, W], px."""
    rows = torch.arange(silhouette.shape[0], device=silhouette.device, dtype=silhouette.dtype)
    columns = torch.arange(silhouette.shape[1], device=silhouette.device, dtype=silhouette.dtype)
    total = silhouette.sum().clamp(min=LEAST_COVER)
    return torch.stack([(silhouette.sum(dim=0) * columns).sum(), (silhouette.sum(dim=1) * rows).sum()]) / total


def feature_error(drawn: torch.Tensor, mask: torch.Tensor, features: Features) -> torch.Tensor:
    """Mean squared difference of the features of a coverage and a mask [H, W]."""
    with torch.no_grad():
        target = features(mask.expand(1, 3, -1, -1))
    return (features(drawn.expand(1, 3, -1, -1)) - target).square().mean()


def total_variation(picture: torch.Tensor) -> torch.Tensor:
    """Mean squared difference of vertical neighbors plus that of horizontal ones, of a picture [H, W]."""
    return (picture[1:] - picture[:-1]).square().mean() + (picture[:, 1:] - picture[:, :-1]).square().mean()


@dataclass(frozen=True, eq=False)
class Silhouettes:
    """Compares the splats, white on black, with the object's mask in one random camera per frame and epoch."""

    splats: Gaussians
    follower: Follower
    views: Mapping[str, View]
    masks: Mapping[tuple[str, int], torch.Tensor]
    """(camera, frame) -> [H, W] bool: the object."""
    features: Features | None
    backend: Backend
    seed: int

    def __call__(self, epoch: int, frame: int, anchors: torch.Tensor) -> torch.Tensor | None:
        """Loss of anchors [N, 3], m; None where no camera has the frame."""
        cameras = [name for name in self.views if (name, frame) in self.masks]
        if not cameras:
            return None
        # Stateless, so that a continued training draws the same cameras.
        name = cameras[int(np.random.default_rng([self.seed, epoch, frame]).integers(len(cameras)))]
        splats, means = self.splats, self.follower(anchors)
        shape = (splats.quaternions, splats.scales, splats.opacities, torch.ones_like(means))
        drawn = rasterize(means, *shape, self.views[name], backend=self.backend).alpha
        return silhouette_loss(drawn, self.masks[name, frame].float(), self.features)


@dataclass(frozen=True, eq=False)
class Points:
    """Chamfer and track loss of structure points in displacement form: s_t = s_0 + sum w (a_t - a_0)."""

    nodes: torch.Tensor
    """[P, 3] m, in frame 0."""
    rest: torch.Tensor
    """Anchors [N, 3] m in frame 0."""
    follower: Follower
    loss: FrameLoss

    def __call__(self, epoch: int, frame: int, anchors: torch.Tensor) -> torch.Tensor:
        """Loss of anchors [N, 3], m."""
        return self.loss(frame, self.nodes + self.follower(anchors - self.rest))
