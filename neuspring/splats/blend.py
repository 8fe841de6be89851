"""Lists of ellipses per tile and their differentiable front-to-back blending, in Warp kernels for CPU and CUDA.

A pixel at u blends the ellipses i of its tile in order of depth, with conic Q_i, mean m_i, opacity o_i and feature f_i [4]:

    s_i = (u - m_i)^T Q_i (u - m_i) / 2,   a_i = min(alpha_max, o_i exp(-s_i)),   w_i = a_i T_i,   T_(i+1) = T_i (1 - a_i)

The result is F = sum_i w_i f_i and the final transmittance T. Ellipses with a_i < alpha_min are skipped. Blending stops before
the first ellipse that would leave T <= transmittance_min. The adjoint runs from back to front, with T_i = T_(i+1) / (1 - a_i)
and B_i = sum_(j>i) w_j (f_j . dL/dF) + T dL/dT:

    dL/da_i = T_i (f_i . dL/dF) - B_i / (1 - a_i),   dL/ds_i = -o_i exp(-s_i) dL/da_i,   both zero where a_i is clamped.
"""
# This module does not postpone annotations: Warp reads the evaluated types of the closures below.

import functools
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp

from neuspring.core.device import load, start_warp
from neuspring.splats.view import Limits, View

TILE_SIDE = {"cpu": 8, "cuda": 16}
"""Side of a tile, px. A pixel's thread visits all ellipses of its tile: small tiles make many lists, large tiles many misses."""


@dataclass(frozen=True)
class Tiles:
    """Lists of ellipses, one per tile, row by row."""

    side: int
    across: int
    starts: torch.Tensor
    """Start of each tile's list [tiles + 1], int32."""
    members: torch.Tensor
    """Ellipses [total], int32; nearest first within a tile."""


@torch.no_grad()
def tiles(depths: torch.Tensor, boxes: torch.Tensor, view: View) -> Tiles:
    """Lists of ellipses with depths [M] and boxes [M, 4]; all must touch the image. Equal depths keep their order."""
    device = depths.device
    side = TILE_SIDE[device.type]
    across, down = -(-view.width // side), -(-view.height // side)
    order = torch.sort(depths, stable=True).indices
    low = torch.div(boxes[order, :2], side, rounding_mode="floor")
    span = torch.div(boxes[order, 2:] - 1, side, rounding_mode="floor") - low + 1
    counts = (span[:, 0] * span[:, 1]).long()
    # One entry per ellipse and touched tile, in order of depth; the stable sort by tile keeps this order within each list.
    owner = torch.repeat_interleave(torch.arange(len(order), device=device), counts)
    inside = torch.arange(len(owner), device=device) - (torch.cumsum(counts, 0) - counts)[owner]
    wide = span[owner, 0].long()
    number = (low[owner, 1] + inside // wide) * across + low[owner, 0] + inside % wide
    number, by_tile = torch.sort(number.int(), stable=True)
    starts = torch.searchsorted(number, torch.arange(across * down + 1, device=device, dtype=torch.int32), out_int32=True)
    return Tiles(side, across, starts.contiguous(), order[owner[by_tile]].int().contiguous())


def blend(
    lists: Tiles,
    view: View,
    limits: Limits,
    means: torch.Tensor,
    conics: torch.Tensor,
    opacities: torch.Tensor,
    features: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Blended features [H, W, 4] and transmittance [H, W].

    Differentiable in means [M, 2], conics [M, 3], opacities [M] and features [M, 4].
    """
    start_warp()
    result: tuple[torch.Tensor, torch.Tensor] = _Blend.apply(lists, view, limits, means, conics, opacities, features)  # type: ignore[no-untyped-call]
    return result


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, lists: Tiles, view: View, limits: Limits, *tensors: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        means, conics, opacities, features = tensors
        # Above this exponent an ellipse is below alpha_min: the comparison avoids most exponentials.
        bound = torch.log(opacities / limits.alpha_min) * (1 + 1e-6) + 1e-6
        strengths = torch.stack([opacities, bound], dim=1)
        inputs = [t.detach().contiguous() for t in (means, conics, strengths, features)]
        total = features.new_zeros(view.height, view.width, 4)
        left = features.new_ones(view.height, view.width)
        ends = torch.zeros(view.height, view.width, dtype=torch.int32, device=means.device)
        thresholds = (limits.alpha_min, limits.alpha_max, limits.transmittance_min)
        _launch(0, view, [*_vectors(*inputs), *_lists(lists), *thresholds, *_vectors(total), *_scalars(left, ends)], means)
        ctx.lists, ctx.view, ctx.limits = lists, view, limits
        ctx.save_for_backward(*inputs, left, ends)
        return total, left

    @staticmethod
    def backward(ctx: Any, adj_total: torch.Tensor, adj_left: torch.Tensor) -> tuple[torch.Tensor | None, ...]:  # type: ignore[override]
        *inputs, left, ends = ctx.saved_tensors
        means, conics, strengths, features = inputs
        adjoints = [torch.zeros_like(tensor) for tensor in (means, conics, strengths[:, 0], features)]
        limits = ctx.limits
        adj_means, adj_conics, adj_opacities, adj_features = adjoints
        arguments = [*_vectors(*inputs), *_lists(ctx.lists), limits.alpha_min, limits.alpha_max, *_scalars(left.detach(), ends)]
        arguments += [*_vectors(adj_total.contiguous()), *_scalars(adj_left.contiguous())]
        arguments += [*_vectors(adj_means, adj_conics), *_scalars(adj_opacities), *_vectors(adj_features)]
        _launch(1, ctx.view, arguments, means)
        return (None, None, None, *adjoints)


def _launch(which: int, view: View, arguments: list[Any], like: torch.Tensor) -> None:
    """Run kernel `which` of `kernels` with one thread per pixel, in the precision and on the device of `like`."""
    device = wp.device_from_torch(like.device)
    kernel = load(kernels(wp.dtype_from_torch(like.dtype))[which], device)
    # Torch orders its own work on its current stream, so the kernel must run on it too.
    stream = wp.stream_from_torch(torch.cuda.current_stream(like.device)) if like.is_cuda else None
    wp.launch(kernel, (view.height, view.width), arguments, device=device, stream=stream)


def _lists(lists: Tiles) -> list[Any]:
    return [wp.from_torch(lists.starts), wp.from_torch(lists.members), lists.across, lists.side]


def _scalars(*tensors: torch.Tensor) -> list[Any]:
    return [wp.from_torch(tensor) for tensor in tensors]


def _vectors(*tensors: torch.Tensor) -> list[Any]:
    """Warp arrays that share the tensors' memory; the last axis becomes a vector."""
    return [wp.from_torch(t, dtype=wp.types.vector(t.shape[-1], wp.dtype_from_torch(t.dtype))) for t in tensors]


@functools.cache
def kernels(real: Any) -> tuple[Any, Any]:
    """The kernels (blending and its adjoint) for the scalar type `real`, wp.float32 or wp.float64."""
    vec2 = wp.types.vector(2, real)
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    one = real(1.0)
    half = real(0.5)

    def front_to_back(
        means: wp.array(dtype=vec2),
        conics: wp.array(dtype=vec3),
        strengths: wp.array(dtype=vec2),
        features: wp.array(dtype=vec4),
        starts: wp.array(dtype=int),
        members: wp.array(dtype=int),
        across: int,
        tile: int,
        alpha_min: real,
        alpha_max: real,
        transmittance_min: real,
        total: wp.array2d(dtype=vec4),
        transmittance: wp.array2d(dtype=real),
        ends: wp.array2d(dtype=int),
    ):
        y, x = wp.tid()  # type: ignore[misc]
        place = vec2(real(x) + half, real(y) + half)
        number = (y // tile) * across + x // tile
        # The caller initialized both: zero and one.
        sum = total[y, x]
        left = transmittance[y, x]
        end = starts[number]
        for k in range(starts[number], starts[number + 1]):
            i = members[k]
            d = place - means[i]
            q = conics[i]
            s = half * (q[0] * d[0] * d[0] + q[2] * d[1] * d[1]) + q[1] * d[0] * d[1]
            strength = strengths[i]
            if s <= strength[1]:
                alpha = wp.min(strength[0] * wp.exp(-s), alpha_max)
                if alpha >= alpha_min:
                    after = left * (one - alpha)
                    if after <= transmittance_min:
                        break
                    sum += features[i] * (alpha * left)
                    left = after
                    end = k + 1
        total[y, x] = sum
        transmittance[y, x] = left
        ends[y, x] = end

    def back_to_front(
        means: wp.array(dtype=vec2),
        conics: wp.array(dtype=vec3),
        strengths: wp.array(dtype=vec2),
        features: wp.array(dtype=vec4),
        starts: wp.array(dtype=int),
        members: wp.array(dtype=int),
        across: int,
        tile: int,
        alpha_min: real,
        alpha_max: real,
        transmittance: wp.array2d(dtype=real),
        ends: wp.array2d(dtype=int),
        adj_total: wp.array2d(dtype=vec4),
        adj_transmittance: wp.array2d(dtype=real),
        adj_means: wp.array(dtype=vec2),
        adj_conics: wp.array(dtype=vec3),
        adj_opacities: wp.array(dtype=real),
        adj_features: wp.array(dtype=vec4),
    ):
        y, x = wp.tid()  # type: ignore[misc]
        place = vec2(real(x) + half, real(y) + half)
        number = (y // tile) * across + x // tile
        adj = adj_total[y, x]
        left = transmittance[y, x]
        behind = left * adj_transmittance[y, x]
        count = ends[y, x] - starts[number]
        for step in range(count):
            i = members[starts[number] + count - 1 - step]
            d = place - means[i]
            q = conics[i]
            s = half * (q[0] * d[0] * d[0] + q[2] * d[1] * d[1]) + q[1] * d[0] * d[1]
            strength = strengths[i]
            if s <= strength[1]:
                bell = wp.exp(-s)
                raw = strength[0] * bell
                alpha = wp.min(raw, alpha_max)
                if alpha >= alpha_min:
                    inverse = one / (one - alpha)
                    left = left * inverse
                    weight = alpha * left
                    gain = wp.dot(features[i], adj)
                    adj_alpha = left * gain - behind * inverse
                    behind += weight * gain
                    wp.atomic_add(adj_features, i, adj * weight)
                    if raw <= alpha_max:
                        adj_s = -raw * adj_alpha
                        wp.atomic_add(adj_opacities, i, bell * adj_alpha)
                        pull = vec2(q[0] * d[0] + q[1] * d[1], q[1] * d[0] + q[2] * d[1])
                        wp.atomic_add(adj_means, i, pull * (-adj_s))
                        wp.atomic_add(adj_conics, i, vec3(half * d[0] * d[0], d[0] * d[1], half * d[1] * d[1]) * adj_s)

    unique = wp.kernel(module="unique", enable_backward=False)
    return unique(front_to_back), unique(back_to_front)
