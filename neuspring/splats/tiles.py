"""Lists of the ellipses that touch each tile of the picture, in order of depth."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from neuspring.splats.view import View

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
