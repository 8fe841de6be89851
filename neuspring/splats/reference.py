"""The specification of the rasterizer: every pixel looks at every splat, plain torch, meant for float64. Slow and memory-hungry."""

from __future__ import annotations

import torch

from neuspring.splats import harmonics
from neuspring.splats.project import project
from neuspring.splats.view import LIMITS, Limits, View


def rasterize(
    means: torch.Tensor,
    quaternions: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    view: View,
    *,
    degree: int | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    limits: Limits = LIMITS,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """rgb [H, W, 3], alpha [H, W] and depth [H, W]; arguments as `neuspring.splats.rasterize.rasterize`."""
    ellipses = project(means, quaternions, scales, view, limits)
    order = torch.sort(ellipses.depths.detach(), stable=True).indices
    index, flat, conics, depths = ellipses.index[order], ellipses.means[order], ellipses.conics[order], ellipses.depths[order]
    shade = colors[index]
    if degree is not None:
        shade = harmonics.colors(shade, means[index] - view.position.to(means), degree)
    rows, columns = torch.meshgrid(torch.arange(view.height), torch.arange(view.width), indexing="ij")
    pixels = torch.stack([columns, rows], dim=-1).reshape(-1, 1, 2).to(means) + 0.5
    offset = pixels - flat
    a, b, c = conics.unbind(-1)
    exponent = 0.5 * (a * offset[..., 0] ** 2 + c * offset[..., 1] ** 2) + b * offset[..., 0] * offset[..., 1]
    raw = opacities[index] * torch.exp(-exponent)
    alpha = torch.where(raw > limits.alpha_max, torch.full_like(raw, limits.alpha_max), raw)
    alpha = torch.where(alpha < limits.alpha_min, torch.zeros_like(alpha), alpha)
    after = torch.cumprod(1 - alpha, dim=1)
    # Transmittance only falls, so all splats behind the first that would leave too little are left out as well.
    alpha = torch.where(after > limits.transmittance_min, alpha, torch.zeros_like(alpha))
    through = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], dim=1), dim=1)
    weights = alpha * through[:, :-1]
    cover = 1 - through[:, -1]
    rgb = weights @ shade + through[:, -1:] * weights.new_tensor(background)
    depth = (weights @ depths) / cover.clamp_min(1e-10)
    size = (view.height, view.width)
    return rgb.reshape(*size, 3), cover.reshape(size), depth.reshape(size)
