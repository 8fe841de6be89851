"""Drawing with gsplat (Apache-2.0), on CUDA. Its thresholds of coverage cannot be set: since version 1.5 no splat covers more than
0.99, ours 0.999 (`Limits.alpha_max`)."""

from __future__ import annotations

import torch

from neuspring.core.errors import InputError
from neuspring.splats.rasterize import Rendered
from neuspring.splats.view import LIMITS, Limits, View


def rasterize(
    means: torch.Tensor,
    quaternions: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    view: View,
    degree: int | None,
    background: tuple[float, float, float],
    limits: Limits,
) -> Rendered:
    """As `neuspring.splats.rasterize.rasterize`; raises InputError for thresholds that gsplat would not keep."""
    from gsplat import rasterization

    own = (limits.alpha_min, limits.alpha_max, limits.transmittance_min)
    if own != (LIMITS.alpha_min, LIMITS.alpha_max, LIMITS.transmittance_min):
        raise InputError("splats, limits", "gsplat keeps its own thresholds of coverage", own, "Take backend: warp.")
    picture, alpha, facts = rasterization(
        means,
        torch.nn.functional.normalize(quaternions, dim=-1),
        scales,
        opacities,
        colors,
        view.world_to_camera[None].to(means),
        view.intrinsics[None].to(means),
        view.width,
        view.height,
        near_plane=limits.near,
        far_plane=limits.far,
        eps2d=limits.blur,
        sh_degree=degree,
        packed=False,
        render_mode="RGB+ED",
    )
    flat = facts["means2d"]
    if flat.requires_grad:
        flat.retain_grad()
    # Radii are one per axis since gsplat 1.5, one before.
    radii = facts["radii"][0].float()
    radii = radii.amax(-1) if radii.ndim == 2 else radii
    index = torch.nonzero(radii > 0).squeeze(1)
    cover = alpha[0, ..., 0]
    rgb = picture[0, ..., :3] + (1 - cover)[..., None] * picture.new_tensor(background)
    return Rendered(rgb, cover, picture[0, ..., 3], index, flat, radii[index], "gsplat")
