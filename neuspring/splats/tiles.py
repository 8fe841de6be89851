"""Lists of the ellipses that touch each tile of the picture, in order of depth; and blending as a differentiable function."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp

from neuspring.core.device import load, start_warp
from neuspring.splats.blend import kernels
from neuspring.splats.view import Limits, View

TILE_SIDE = {"cpu": 8, "cuda": 16}
"""Pixels. A pixel's thread looks at all ellipses of its tile: small tiles make many lists, large tiles many looks in vain."""


@dataclass(frozen=True)
class Tiles:
    """Lists of ellipses, one per tile, row by row."""

    side: int
    across: int
    starts: torch.Tensor
    """[tiles + 1] int32: where each tile's list begins."""
    members: torch.Tensor
    """[total] int32: ellipses, nearest first within a tile."""


@torch.no_grad()
def tiles(depths: torch.Tensor, boxes: torch.Tensor, view: View, side: int | None = None) -> Tiles:
    """Lists for ellipses with depths [M] and boxes [M, 4], all of which touch the picture. Equal depths keep their order."""
    device = depths.device
    side = side or TILE_SIDE[device.type]
    across, down = -(-view.width // side), -(-view.height // side)
    order = torch.sort(depths, stable=True).indices
    low = torch.div(boxes[order, :2], side, rounding_mode="floor")
    span = torch.div(boxes[order, 2:] - 1, side, rounding_mode="floor") - low + 1
    counts = (span[:, 0] * span[:, 1]).long()
    # One entry per ellipse and tile that it touches, still in order of depth; a stable sort by tile keeps that order in each list.
    owner = torch.repeat_interleave(torch.arange(len(order), device=device), counts)
    inside = torch.arange(len(owner), device=device) - (torch.cumsum(counts, 0) - counts)[owner]
    wide = span[owner, 0].long()
    number = (low[owner, 1] + inside // wide) * across + low[owner, 0] + inside % wide
    number, by_tile = torch.sort(number.int(), stable=True)
    starts = torch.searchsorted(number, torch.arange(across * down + 1, device=device, dtype=torch.int32), out_int32=True)
    return Tiles(side, across, starts.contiguous(), order[owner[by_tile]].int().contiguous())


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        lists: Tiles,
        view: View,
        limits: Limits,
        means: torch.Tensor,
        conics: torch.Tensor,
        opacities: torch.Tensor,
        features: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        # Beyond this exponent an ellipse is below alpha_min; the comparison saves most exponentials.
        bound = torch.log(opacities / limits.alpha_min) * (1 + 1e-6) + 1e-6
        strengths = torch.stack([opacities, bound], dim=1)
        inputs = [t.detach().contiguous() for t in (means, conics, strengths, features)]
        total = features.new_zeros(view.height, view.width, 4)
        left = features.new_ones(view.height, view.width)
        ends = torch.zeros(view.height, view.width, dtype=torch.int32, device=means.device)
        own = (limits.alpha_min, limits.alpha_max, limits.transmittance_min)
        _launch(0, view, [*_vectors(*inputs), *_lists(lists), *own, *_vectors(total), *_scalars(left, ends)], means)
        ctx.lists, ctx.view, ctx.limits = lists, view, limits
        ctx.save_for_backward(*inputs, left, ends)
        return total, left

    @staticmethod
    def backward(ctx: Any, adj_total: torch.Tensor, adj_left: torch.Tensor) -> tuple[torch.Tensor | None, ...]:  # type: ignore[override]
        *inputs, left, ends = ctx.saved_tensors
        means, conics, strengths, features = inputs
        adjoints = [torch.zeros_like(tensor) for tensor in (means, conics, strengths[:, 0], features)]
        limits: Limits = ctx.limits
        arguments = [*_vectors(*inputs), *_lists(ctx.lists), limits.alpha_min, limits.alpha_max, *_scalars(left.detach(), ends)]
        arguments += [*_vectors(adj_total.contiguous()), *_scalars(adj_left.contiguous())]
        place, shape, opacity, feature = adjoints
        _launch(1, ctx.view, [*arguments, *_vectors(place, shape), *_scalars(opacity), *_vectors(feature)], means)
        return (None, None, None, *adjoints)


def blend(
    lists: Tiles,
    view: View,
    limits: Limits,
    means: torch.Tensor,
    conics: torch.Tensor,
    opacities: torch.Tensor,
    features: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Blended features [H, W, 4] and transmittance [H, W], differentiable in means [M, 2], conics [M, 3], opacities [M],
    features [M, 4]."""
    start_warp()
    result: tuple[torch.Tensor, torch.Tensor] = _Blend.apply(lists, view, limits, means, conics, opacities, features)  # type: ignore[no-untyped-call]
    return result


def _launch(which: int, view: View, arguments: list[Any], like: torch.Tensor) -> None:
    device = wp.device_from_torch(like.device)
    kernel = load(kernels(wp.dtype_from_torch(like.dtype))[which], device)
    # Torch orders its own work on its current stream, so the kernel must run there too.
    stream = wp.stream_from_torch(torch.cuda.current_stream(like.device)) if like.is_cuda else None
    wp.launch(kernel, (view.height, view.width), arguments, device=device, stream=stream)


def _lists(lists: Tiles) -> list[Any]:
    return [wp.from_torch(lists.starts), wp.from_torch(lists.members), lists.across, lists.side]


def _scalars(*tensors: torch.Tensor) -> list[Any]:
    return [wp.from_torch(tensor) for tensor in tensors]


def _vectors(*tensors: torch.Tensor) -> list[Any]:
    """Warp arrays of the same memory whose entries are vectors: the last axis."""
    return [wp.from_torch(t, dtype=wp.types.vector(t.shape[-1], wp.dtype_from_torch(t.dtype))) for t in tensors]
