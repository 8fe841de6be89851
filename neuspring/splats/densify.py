"""Adaptive density of splats: small ones are cloned, large ones split, where the picture pulls at them; faint and huge ones go.

After Kerbl et al. 2023, section 5.2: a splat whose place in the picture has a mean gradient above a threshold is too coarse.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from neuspring.config.images import Appearance
from neuspring.splats.project import rotations
from neuspring.splats.rasterize import Rendered

CHILDREN = 2
SHRINK = 1.6
"""A child of a split is smaller than its parent by this factor."""
REFERENCE_WIDTH = 848
"""Lengths in pixels in the settings refer to an image this wide."""


@dataclass
class Statistics:
    """What pictures showed of each splat since their number last changed."""

    pull: torch.Tensor
    """[N] sum of gradients of the place in the picture, per half picture."""
    seen: torch.Tensor
    """[N] number of pictures that show it."""
    radius: torch.Tensor
    """[N] largest, as a part of the picture's width."""

    @classmethod
    def empty(cls, like: torch.Tensor) -> Statistics:
        """For splats with means `like` [N, 3]."""
        return cls(like.new_zeros(len(like)), like.new_zeros(len(like)), like.new_zeros(len(like)))

    @torch.no_grad()
    def add(self, rendered: Rendered, width: int, height: int) -> None:
        """Account for a picture after its backward pass."""
        gradient = rendered.means.grad
        if gradient is None:
            return
        if rendered.backend == "gsplat":
            gradient = gradient[0, rendered.index]
        half = gradient.new_tensor([width / 2, height / 2])
        self.pull.index_add_(0, rendered.index, (gradient * half).norm(dim=1))
        self.seen.index_add_(0, rendered.index, torch.ones_like(rendered.radii))
        self.radius[rendered.index] = torch.maximum(self.radius[rendered.index], rendered.radii / width)


@torch.no_grad()
def densify(
    splats: Mapping[str, torch.Tensor],
    statistics: Statistics,
    settings: Appearance,
    extent: float,
    after_reset: bool,
    generator: torch.Generator,
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Which splats stay [N] bool, and the new ones, with the keys of `splats` (those of `Gaussians`).

    `extent`, m, is the size of the scene; `after_reset` also removes splats that are huge.
    """
    size = torch.exp(splats["log_scales"]).amax(1)
    mean_pull = statistics.pull / statistics.seen.clamp_min(1)
    coarse = mean_pull > settings.densify_gradient
    room = max(settings.most_splats - len(size), 0)
    # The coarsest ones first where there is no room for all.
    if int(coarse.sum()) > room:
        coarse = torch.zeros_like(coarse).index_fill_(0, torch.topk(mean_pull, room).indices, True) & coarse
    # A split makes smaller splats, so splats of a fixed radius are cloned.
    split = coarse & (size > settings.split_size * extent) & (settings.fixed_radius is None)
    added = {name: tensor[coarse & ~split] for name, tensor in splats.items()}
    if split.any():
        children = {name: tensor[split].repeat_interleave(CHILDREN, 0) for name, tensor in splats.items()}
        noise = torch.randn(children["means"].shape, generator=generator).to(children["means"])
        offsets = noise * torch.exp(children["log_scales"])
        children["means"] = children["means"] + torch.einsum("nij,nj->ni", rotations(children["quaternions"]), offsets)
        children["log_scales"] = children["log_scales"] - torch.log(size.new_tensor(SHRINK))
        added = {name: torch.cat([added[name], children[name]]) for name in added}
    gone = split | _superfluous(splats, settings, extent, after_reset)
    if after_reset and settings.fixed_radius is None:
        gone |= statistics.radius > settings.prune_radius / REFERENCE_WIDTH
    stay = ~_superfluous(added, settings, extent, after_reset)
    return ~gone, {name: tensor[stay] for name, tensor in added.items()}


def _superfluous(splats: Mapping[str, torch.Tensor], settings: Appearance, extent: float, after_reset: bool) -> torch.Tensor:
    """Faint splats [N], after a reset also huge ones."""
    faint = torch.sigmoid(splats["opacity_logits"]) < settings.prune_opacity
    if not after_reset or settings.fixed_radius:
        return faint
    return faint | (torch.exp(splats["log_scales"]).amax(1) > settings.prune_size * extent)
