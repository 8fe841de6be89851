"""Differentiable rendering of Gaussian splats: color, coverage and expected depth.

The backend `warp` runs the kernels of `blend` on CPU and CUDA. The backend `gsplat` (Apache-2.0, extra `gpu`) runs on CUDA.
`auto` selects gsplat where it works. Results name the backend.
"""

from __future__ import annotations

import functools
import importlib.util
from dataclasses import dataclass
from typing import Literal

import torch

from neuspring.core.errors import InputError
from neuspring.splats.blend import blend, tiles
from neuspring.splats.view import DEFAULT_LIMITS, Limits, View, boxes, harmonic_colors, project, radii

Backend = Literal["warp", "gsplat"]
LEAST_ALPHA = 1e-10
"""Floor of the divisor of expected depth."""


@dataclass(frozen=True, eq=False)
class Rendered:
    """A rendered image of splats."""

    rgb: torch.Tensor
    """Color over the background [H, W, 3], not clamped."""
    alpha: torch.Tensor
    """Coverage [H, W]: 1 - transmittance."""
    depth: torch.Tensor
    """Mean depth along the optical axis of the splats that cover a pixel [H, W], m; 0 where no splat does."""
    index: torch.Tensor
    """Indices of the splats that touch the image [M], int64."""
    means: torch.Tensor
    """Centers of these splats [M, 2], px; with gsplat those of all splats [1, N, 2].

    The tensor keeps its gradient after a backward pass; the gradient is large for splats that are too coarse."""
    radii: torch.Tensor
    """Three standard deviations of these splats [M], px."""
    backend: Backend


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
    limits: Limits = DEFAULT_LIMITS,
    backend: Backend = "warp",
) -> Rendered:
    """Render splats; differentiable in the first five arguments.

    - `means` [N, 3], m; `quaternions` [N, 4], w first, any length; `scales`: standard deviations [N, 3], m; `opacities` [N].
    - `colors`: RGB [N, 3], or, with `degree`, harmonics [N, K, 3], which are used up to that degree.

    Raises InputError for wrong shapes and for entries that are not finite.
    """
    view.require_valid()
    splats = {"means": means, "quaternions": quaternions, "scales": scales, "opacities": opacities, "colors": colors}
    _require_splats(splats, degree)
    if backend == "gsplat":
        return _by_gsplat(splats, view, degree, background, limits)
    ellipses = project(means, quaternions, scales, view, limits)
    touching, rectangles = boxes(ellipses, opacities.detach()[ellipses.index], view, limits)
    visible = torch.nonzero(touching).squeeze(1)
    index = ellipses.index[visible]
    flat, depths = ellipses.means[visible], ellipses.depths[visible]
    if flat.requires_grad:
        flat.retain_grad()
    shade = colors[index]
    if degree is not None:
        shade = harmonic_colors(shade, means[index] - view.position.to(means), degree)
    lists = tiles(depths.detach(), rectangles[visible], view)
    features = torch.cat([shade, depths[:, None]], dim=1)
    total, left = blend(lists, view, limits, flat, ellipses.conics[visible], opacities[index], features)
    alpha = 1 - left
    rgb = total[..., :3] + left[..., None] * total.new_tensor(background)
    depth = total[..., 3] / alpha.clamp_min(LEAST_ALPHA)
    return Rendered(rgb, alpha, depth, index, flat, radii(ellipses)[visible], "warp")


def _by_gsplat(
    splats: dict[str, torch.Tensor], view: View, degree: int | None, background: tuple[float, float, float], limits: Limits
) -> Rendered:
    """`rasterize` with gsplat, whose thresholds are fixed: a splat covers at most 0.99 from gsplat 1.5 on, here 0.999."""
    from gsplat import rasterization

    thresholds = (limits.alpha_min, limits.alpha_max, limits.transmittance_min)
    if thresholds != (DEFAULT_LIMITS.alpha_min, DEFAULT_LIMITS.alpha_max, DEFAULT_LIMITS.transmittance_min):
        raise InputError("splats, limits", "gsplat has fixed thresholds of coverage", thresholds, "Set backend: warp.")
    picture, alpha, facts = rasterization(
        splats["means"],
        torch.nn.functional.normalize(splats["quaternions"], dim=-1),
        *(splats[name] for name in ("scales", "opacities", "colors")),
        *(matrix[None].to(splats["means"]) for matrix in (view.world_to_camera, view.intrinsics)),
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
    # gsplat 1.5 and later return one radius per axis, earlier versions one in total.
    radii = facts["radii"][0].float()
    radii = radii.amax(-1) if radii.ndim == 2 else radii
    index = torch.nonzero(radii > 0).squeeze(1)
    cover = alpha[0, ..., 0]
    rgb = picture[0, ..., :3] + (1 - cover)[..., None] * picture.new_tensor(background)
    return Rendered(rgb, cover, picture[0, ..., 3], index, flat, radii[index], "gsplat")


def choose_backend(wanted: Literal["auto", "warp", "gsplat"], device: str) -> Backend:
    """Select the backend: `auto` is gsplat on CUDA if it works, else warp. Raises InputError for a gsplat that does not work."""
    if wanted == "warp" or (wanted == "auto" and not device.startswith("cuda")):
        return "warp"
    if not (fault := _gsplat_fault(device)):
        return "gsplat"
    if wanted == "auto":
        return "warp"
    raise InputError("images.backend", "gsplat must work on this machine", fault, "Set images.backend: auto or warp.")


@functools.cache
def _gsplat_fault(device: str) -> str:
    """Reason why gsplat cannot render on `device`; empty if it can. Renders one splat, because gsplat compiles at first use."""
    if not device.startswith("cuda"):
        return f"device {device}; gsplat needs CUDA"
    if importlib.util.find_spec("gsplat") is None:
        return 'no gsplat (pip install -c workflow/envs/constraints.txt -e ".[gpu]")'
    try:
        size = 16
        intrinsics = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]], device=device)
        mean, turn = torch.tensor([[0.0, 0.0, 1.0]], device=device), torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device)
        scale, opacity = torch.full((1, 3), 0.1, device=device), torch.full((1,), 0.5, device=device)
        view = View(torch.eye(4, device=device), intrinsics, size, size)
        picture = rasterize(mean, turn, scale, opacity, torch.ones_like(mean), view, backend="gsplat")
    except Exception as error:
        return f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
    return "" if float(picture.alpha.max()) > 0.4 else "an empty image"


def _require_splats(splats: dict[str, torch.Tensor], degree: int | None) -> None:
    count, colors = len(splats["means"]), splats["colors"]
    coefficients = colors.shape[1] if colors.ndim == 3 else None
    shapes = ([count, 3], [count, 4], [count, 3], [count], [count, 3] if degree is None else [count, coefficients, 3])
    for (name, tensor), shape in zip(splats.items(), shapes, strict=True):
        if list(tensor.shape) != shape:
            raise InputError(f"splats, {name}", f"the shape must be {shape}", tuple(tensor.shape))
        finite = torch.isfinite(tensor.detach())
        if not finite.all():
            bad = int((~finite).reshape(count, -1).any(1).sum())
            raise InputError(f"splats, {name}", "every entry must be finite", f"{bad} of {count} splats that are not")
    if degree is not None and not 0 <= degree <= 3:
        raise InputError("splats, degree", "harmonics of degree 0 to 3 can be rendered", degree)
    if degree is not None and colors.shape[1] < (degree + 1) ** 2:
        raise InputError("splats, colors", f"degree {degree} needs {(degree + 1) ** 2} coefficients", colors.shape[1])
