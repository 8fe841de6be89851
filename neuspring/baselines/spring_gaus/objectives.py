"""Losses of the anchors of a frame: on silhouettes of the splats that follow them, or on points that do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from neuspring.baselines.spring_gaus.graph import Binding
from neuspring.baselines.spring_gaus.silhouettes import SilhouetteLoss
from neuspring.splats.model import Gaussians
from neuspring.splats.rasterize import Backend, rasterize
from neuspring.splats.view import View
from neuspring.twin.losses import FrameLoss

Masks = dict[tuple[str, int], tuple[torch.Tensor, torch.Tensor | None]]
"""(camera, frame) -> two masks [H, W], bool: the object, and the pixels that count (None: all)."""


class Follower:
    """Points that follow anchors by fixed weights, on a device."""

    def __init__(self, binding: Binding, device: str) -> None:
        self.indices = torch.tensor(binding.indices, device=device).long()
        self.weights = torch.tensor(binding.weights, device=device)

    def __call__(self, anchors: torch.Tensor) -> torch.Tensor:
        """Weighted means [P, 3] of anchors [N, 3]."""
        # The gradient of a bag of rows needs no [P, k, 3] in memory.
        weights = self.weights.to(anchors.dtype)
        return torch.nn.functional.embedding_bag(self.indices, anchors, per_sample_weights=weights, mode="sum")


@dataclass(frozen=True, eq=False)
class Silhouettes:
    """Compares the splats, white on black, with the object's mask in one random camera per frame and epoch."""

    splats: Gaussians
    follower: Follower
    views: Mapping[str, View]
    masks: Masks
    loss: SilhouetteLoss
    backend: Backend
    seed: int

    def __call__(self, epoch: int, frame: int, anchors: torch.Tensor) -> torch.Tensor | None:
        """Loss of anchors [N, 3], m; None where no camera has the frame."""
        cameras = [name for name in self.views if (name, frame) in self.masks]
        if not cameras:
            return None
        # Stateless, so that a continued training draws the same cameras.
        name = cameras[int(np.random.default_rng([self.seed, epoch, frame]).integers(len(cameras)))]
        mask, counts = self.masks[name, frame]
        drawn, target = self.cover(anchors, self.views[name]), mask.float()
        return self.loss(drawn, target) if counts is None else self.loss(drawn * counts, target * counts)

    def cover(self, anchors: torch.Tensor, view: View) -> torch.Tensor:
        """Coverage [H, W] of the splats in a view: their picture in white on black."""
        splats, means = self.splats, self.follower(anchors)
        white = torch.ones_like(means)
        return rasterize(means, splats.quaternions, splats.scales, splats.opacities, white, view, backend=self.backend).alpha


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
        return self.loss(frame, self.moved(anchors))

    def moved(self, anchors: torch.Tensor) -> torch.Tensor:
        """Structure points [P, 3], m."""
        return self.nodes + self.follower(anchors - self.rest)
