"""The terms of the training loss. A term is a function that returns its loss of a frame.

The loss of a term is the sum of s(e)^2 over its errors e, m, divided by their number. Its weight has the same name in
`config.Losses`.

    chamfer       e from each visible observed point to its nearest surface node (assignment fixed), s(e) = e
    track         e from track i to node i where the motion is valid, s(e)^2 smooth-L1 (beta = 1 m)
    acceleration  e the change of a node's velocity change, m/s, s(e)^2 smooth-L1; only the search uses it, as released
    image_track   e = p (u(x_i) - q_i) of visible tracks, s(e)^2 smooth-L1 beyond BETA, because trackers drift
    silhouette    e = p |m - u(x_i)| from each point m of the mask to the nearest surface node, and p D(u(x_i)) of each node,
                  s(e) = e; D is the distance from object and hands, bilinear between cells, so hidden nodes have no error

The first three terms are those of the released PhysTwin code. The last two are for one camera without depth: u(x) = K R^T (x - c)
/ depth is the projection, pixels, and p the size of a pixel at the object in frame 0, m.

The fit calls `FrameLoss`. The search computes the first three terms in the lanes of its solver (trials.py, tested against this
file) and all other terms here. A new term requires its function and its weight in `config.Losses`. A package provides the
function as an entry point of the group `neuspring.losses`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch.nn.functional import grid_sample, smooth_l1_loss

from neuspring.config import Losses
from neuspring.config.twin import TERMS
from neuspring.core.artifacts import Observations

CHUNK_ENTRIES = 1 << 22
"""Number of distances that the nearest-node search computes at once; limits memory."""
BETA = 0.03
"""Image error of a track beyond which the loss is linear, m."""
NEAREST_DEPTH = 0.05
"""Smallest depth in projections, m; nearer nodes are projected at this depth."""


def frames_seen(observations: Observations, *, oracle: bool) -> int:
    """Number of frames that a loss may read, from frame 0 on: the training frames; all frames for an oracle."""
    scenario = observations.scenario
    return scenario.frame_count if oracle else scenario.train_end


def _smooth_l1(e: torch.Tensor) -> torch.Tensor:
    return smooth_l1_loss(e, torch.zeros_like(e), reduction="sum", beta=1.0)


def _smooth_root(e: torch.Tensor) -> torch.Tensor:
    """s(e) with s(e)^2 = e^2 / 2 below BETA and BETA (|e| - BETA / 2) beyond; the slope is continuous."""
    size = e.abs()
    # The unused branch must have a finite slope too.
    linear = (BETA * (size.clamp_min(BETA) - BETA / 2)).sqrt()
    return torch.where(size < BETA, e / 2**0.5, e.sign() * linear)


def _mean_square(s: torch.Tensor, count: torch.Tensor | int) -> torch.Tensor:
    """The sum of the squares of s [k, d], divided by max(count, 1)."""
    scale = 1.0 / torch.as_tensor(count, dtype=s.dtype, device=s.device).clamp_min(1)
    return (s * scale.sqrt()).square().sum()


class FrameState(NamedTuple):
    """The inputs of the terms in one frame."""

    frame: int
    x: torch.Tensor
    """Nodes [N, 3], m."""
    jerk: torch.Tensor | None = None
    """Change of the velocity change [N, 3], m/s; None: acceleration is not counted."""
    u: torch.Tensor | None = None
    """Nodes in the image [N, 2], pixels; None for captures with depth."""


def nearest(points: torch.Tensor, nodes: torch.Tensor) -> torch.Tensor:
    """Index [P] of the nearest node (Euclidean, lowest index on ties) for points [P, 3] among nodes [M, 3]."""
    rows = max(1, CHUNK_ENTRIES // max(1, len(nodes)))
    x, y, z = nodes.T.contiguous()
    indices = []
    for chunk in points.split(rows):
        # Axis by axis takes a third of the time of a sum over a last axis of 3.
        squares = (chunk[:, :1] - x).square_()
        squares += (chunk[:, 1:2] - y).square_()
        squares += (chunk[:, 2:] - z).square_()
        indices.append(squares.argmin(dim=1))
    # An empty tensor splits into itself, and its argmin is empty.
    return torch.cat(indices)


def chamfer(loss: FrameLoss, state: FrameState) -> torch.Tensor:
    """Mean squared distance from visible points to their nearest surface nodes."""
    points = loss.points[state.frame][loss.visible[state.frame]]
    e = state.x.index_select(0, nearest(points, state.x.detach()[: loss.surface])) - points
    return e.square().sum() / max(loss.counts[state.frame][0], 1)


def track(loss: FrameLoss, state: FrameState) -> torch.Tensor:
    """Smooth-L1 from tracks to their nodes, averaged over valid tracks and axes. Frame t uses the validity of frame t - 1."""
    target, valid = loss.points[state.frame], loss.motion_valid[state.frame - 1]
    e = state.x[: len(target)][valid] - target[valid]
    return _smooth_l1(e) / (3 * max(loss.counts[state.frame][1], 1))


def acceleration(loss: FrameLoss, state: FrameState) -> torch.Tensor | None:
    """Smoothness of motion, averaged over nodes and axes."""
    return None if state.jerk is None else _smooth_l1(state.jerk) / state.jerk.numel()


def image_track(loss: FrameLoss, state: FrameState) -> torch.Tensor | None:
    """Error from tracked pixels to the projections of their nodes, averaged over visible tracks and over x and y."""
    image, u = loss.image, state.u
    if image is None or u is None:
        return None
    seen = image.visible[state.frame]
    e = image.size * (u[: len(seen)] - image.pixels[state.frame])
    return _mean_square(_smooth_root(e * seen[:, None]), 2 * seen.sum())


def silhouette(loss: FrameLoss, state: FrameState) -> torch.Tensor | None:
    """Mean error from points of the mask to projected surface nodes, plus mean distance of nodes from object and hands."""
    image, u = loss.image, state.u
    if image is None or u is None:
        return None
    inside = ~torch.isnan(image.inside[state.frame, :, 0])
    points = torch.nan_to_num(image.inside[state.frame])
    near = torch.cdist(points, image.project(state.x.detach()[: loss.surface])).argmin(dim=1)
    away = image.size * (u.index_select(0, near) - points) * inside[:, None]
    left = image.size * image.distance(state.frame, u)[:, None]
    return _mean_square(away, inside.sum()) + _mean_square(left, len(u))


OF_IMAGES = ("image_track", "silhouette")
"""Terms for one camera without depth."""


@dataclass(frozen=True)
class ImageEvidence:
    """Measurements of a camera without depth, as tensors of E frames."""

    world_to_camera: torch.Tensor
    intrinsics: torch.Tensor
    pixels: torch.Tensor
    """[E, No, 2]."""
    visible: torch.Tensor
    """[E, No]."""
    inside: torch.Tensor
    """Points of the mask [E, P, 2], pixels, padded with NaN."""
    outside: torch.Tensor
    """Distances D from object and hands [E, h, w], pixels."""
    cell: int
    """Size of a cell of `outside`, pixels."""
    size: float
    """Size of a pixel at the object, p, m."""

    @classmethod
    def of(cls, observations: Observations, device: str, dtype: torch.dtype) -> ImageEvidence | None:
        """The measurements of a recording; None for captures with depth."""
        image = observations.image
        if image is None:
            return None

        def kept(values: np.ndarray) -> torch.Tensor:
            tensor = torch.tensor(values)
            return tensor.to(device, dtype if tensor.is_floating_point() else tensor.dtype)

        frames = {name: kept(getattr(image, name)[: len(image.inside)]) for name in ("pixels", "visible", "inside", "outside")}
        return cls(
            world_to_camera=torch.linalg.inv(torch.tensor(image.camera_to_world, dtype=torch.float64)).to(device, dtype),
            intrinsics=kept(image.intrinsics),
            cell=image.cell,
            size=image.pixel_size,
            **frames,
        )

    def project(self, x: torch.Tensor) -> torch.Tensor:
        """Project points [..., 3], m, to pixels [..., 2]."""
        local = x @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        flat = local @ self.intrinsics.T
        return flat[..., :2] / flat[..., 2:].clamp_min(NEAREST_DEPTH)

    def distance(self, frame: int, u: torch.Tensor) -> torch.Tensor:
        """Interpolate D [N], pixels, at pixels [N, 2]. Outside the image, D is that of the border."""
        rows, columns = self.outside.shape[1:]
        # `grid_sample` with align_corners = False maps the outer edges of the cells to -1 and 1.
        extent = torch.tensor([columns, rows], dtype=u.dtype, device=u.device) * self.cell
        grid = 2 * (u + 0.5) / extent - 1
        sampled = grid_sample(
            self.outside[frame][None, None], grid[None, None], mode="bilinear", padding_mode="border", align_corners=False
        )
        return sampled[0, 0, 0]


@dataclass(frozen=True)
class FrameLoss:
    """The training frames of a scenario as tensors, and the loss of each.

    `frozen_counts` divides the terms of every frame by the valid counts of frame 1 (`frozen_loss_denominators`).
    """

    points: torch.Tensor
    visible: torch.Tensor
    motion_valid: torch.Tensor
    surface: int
    weights: Losses
    frozen_counts: bool = False
    image: ImageEvidence | None = None
    """Evidence of captures without depth."""

    @classmethod
    def of(
        cls,
        observations: Observations,
        weights: Losses,
        device: str,
        dtype: torch.dtype = torch.float32,
        *,
        frozen_counts: bool = False,
        oracle: bool = False,
    ) -> FrameLoss:
        """Create the loss of the training frames.

        `oracle` keeps all frames, future frames included. Only a method with `oracle: true` sets it; its results are no
        prediction.
        """
        end = frames_seen(observations, oracle=oracle)
        points = torch.tensor(observations.object_points[:end], dtype=dtype, device=device)
        visible = torch.tensor(observations.object_visibility[:end], device=device)
        valid = torch.tensor(observations.object_motion_valid[:end], device=device)
        image = ImageEvidence.of(observations, device, dtype)
        return cls(points, visible, valid, observations.surface_count, weights, frozen_counts, image)

    @cached_property
    def counts(self) -> list[tuple[int, int]]:
        """Denominators of each frame: (visible points, points with valid motion); frame 0 has no valid motion."""
        visible = self.visible.sum(dim=1).tolist()
        valid = [0, *self.motion_valid.sum(dim=1).tolist()[:-1]]
        if self.frozen_counts:
            visible, valid = [visible[1]] * len(visible), [valid[1]] * len(valid)
        return list(zip(visible, valid, strict=True))

    @property
    def names(self) -> tuple[str, ...]:
        """Terms with a nonzero weight; terms of images only for captures without depth."""
        applicable = [name for name in TERMS if self.image is not None or name not in OF_IMAGES]
        return tuple(name for name in applicable if getattr(self.weights, name))

    def terms(
        self, frame: int, x: torch.Tensor, jerk: torch.Tensor | None = None, without: Collection[str] = ()
    ) -> dict[str, torch.Tensor]:
        """Weighted losses of a frame >= 1 by term, for nodes x [N, 3], m. Terms in `without` are omitted."""
        state = FrameState(frame, x, jerk, self.image.project(x) if self.image else None)
        losses = {name: TERMS[name](self, state) for name in self.names if name not in without}
        return {name: getattr(self.weights, name) * value for name, value in losses.items() if value is not None}

    def __call__(self, frame: int, x: torch.Tensor) -> torch.Tensor:
        """Sum the terms of a frame, without acceleration."""
        losses = list(self.terms(frame, x).values())
        return sum(losses[1:], start=losses[0]) if losses else x.sum() * 0.0
