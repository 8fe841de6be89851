"""Training losses (those of the released PhysTwin code), differentiable in the predicted nodes.

Chamfer: mean over visible observed points of the squared Euclidean distance to the nearest surface node (assignment fixed).
Track: smooth-L1 (beta = 1 m) between node i and track i where the motion is valid, mean over points and axes.
Acceleration: smooth-L1 between consecutive velocity changes, mean over nodes and axes; search only.
A term is weighted by the field of `config.Losses` that has its name.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch.nn.functional import smooth_l1_loss

from neuspring.config import Losses
from neuspring.core.artifacts import Observations
from neuspring.twin.image_losses import ImageLoss

CHUNK_ENTRIES = 1 << 22
"""Distances computed at once in the nearest-node search; bounds memory."""


def frames_seen(observations: Observations, *, oracle: bool) -> int:
    """Frames that a loss may read, from frame 0 on: those before the split; all of them for an oracle."""
    scenario = observations.scenario
    return scenario.frame_count if oracle else scenario.train_end


def nearest(points: torch.Tensor, nodes: torch.Tensor) -> torch.Tensor:
    """Index [P] of the nearest node (Euclidean, lowest index on ties) for points [P, 3] among nodes [M, 3]."""
    rows = max(1, CHUNK_ENTRIES // max(1, len(nodes)))
    x, y, z = nodes.T.contiguous()
    found = []
    for chunk in points.split(rows):
        # Axis by axis: a third of the time of the same sum over a last axis of 3.
        squares = (chunk[:, :1] - x).square_()
        squares += (chunk[:, 1:2] - y).square_()
        squares += (chunk[:, 2:] - z).square_()
        found.append(squares.argmin(dim=1))
    # An empty tensor splits into itself, and argmin of no rows is empty too.
    return torch.cat(found)


def chamfer(
    nodes: torch.Tensor, target: torch.Tensor, visible: torch.Tensor, surface: int, count: int | None = None
) -> torch.Tensor:
    """Squared Chamfer loss [m^2] from visible targets [P, 3] to the first `surface` nodes. 0 if nothing is visible.

    `count` replaces the number of visible points as divisor (released quirk 4).
    """
    points = target[visible]
    if len(points) == 0:
        return nodes.sum() * 0.0
    with torch.no_grad():
        index = nearest(points, nodes[:surface])
    return (nodes[index] - points).square().sum() / (len(points) if count is None else max(count, 1))


def track(nodes: torch.Tensor, target: torch.Tensor, valid: torch.Tensor, count: int | None = None) -> torch.Tensor:
    """Smooth-L1 track loss [m^2 below 1 m] between node i and target i where `valid` [P]. 0 if nothing is valid."""
    total = smooth_l1_loss(nodes[: len(target)][valid], target[valid], reduction="sum", beta=1.0)
    return total / (3 * max(int(valid.sum()) if count is None else count, 1))


def acceleration(change: torch.Tensor, previous: torch.Tensor) -> torch.Tensor:
    """Smoothness of motion: smooth-L1 between a frame's velocity change [N, 3] and that of the frame before."""
    return smooth_l1_loss(change, previous, reduction="mean", beta=1.0)


@dataclass(frozen=True)
class FrameLoss:
    """The observations of a scenario as tensors, and the loss of each frame that they hold: the training frames.

    `frozen_counts` divides every frame by the valid counts of frame 1 (released quirk 4).
    """

    points: torch.Tensor
    visible: torch.Tensor
    motion_valid: torch.Tensor
    surface: int
    weights: Losses
    frozen_counts: bool = False
    image: ImageLoss | None = None
    """Of captures without depth."""

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
        """Keep training frames only: losses never see the future. `oracle` is the one exception: all frames are kept.

        Only a method row with `oracle: true` sets it. Such a row predicts nothing, and its records say so.
        """
        end = frames_seen(observations, oracle=oracle)
        points = torch.tensor(observations.object_points[:end], dtype=dtype, device=device)
        visible = torch.tensor(observations.object_visibility[:end], device=device)
        valid = torch.tensor(observations.object_motion_valid[:end], device=device)
        image = ImageLoss.of(observations, weights, device, dtype)
        return cls(points, visible, valid, observations.surface_count, weights, frozen_counts, image)

    def counts(self) -> list[tuple[int, int]]:
        """(visible points, points whose motion is valid) that each frame's terms are divided by; none in frame 0."""
        visible = self.visible.sum(dim=1).tolist()
        valid = [0, *self.motion_valid.sum(dim=1).tolist()[:-1]]
        if self.frozen_counts:
            visible, valid = [visible[1]] * len(visible), [valid[1]] * len(valid)
        return list(zip(visible, valid, strict=True))

    def terms(self, frame: int, nodes: torch.Tensor) -> dict[str, torch.Tensor]:
        """Weighted terms of a frame >= 1 for nodes [N, 3], by name. Frame t uses visibility[t] but motion_valid[t - 1]."""
        target, visible, valid = self.points[frame], self.visible[frame], self.motion_valid[frame - 1]
        visible_count = int(self.visible[1].sum()) if self.frozen_counts else None
        valid_count = int(self.motion_valid[0].sum()) if self.frozen_counts else None
        values = {
            "chamfer": chamfer(nodes, target, visible, self.surface, visible_count),
            "track": track(nodes, target, valid, valid_count),
        }
        weighted = {name: getattr(self.weights, name) * value for name, value in values.items()}
        return weighted | (self.image.terms(frame, nodes) if self.image else {})

    def __call__(self, frame: int, nodes: torch.Tensor) -> torch.Tensor:
        """The sum of a frame's terms."""
        first, *others = self.terms(frame, nodes).values()
        return sum(others, start=first)

    def of_rollout(self, states: Iterable[tuple[int, torch.Tensor, torch.Tensor]], velocity: torch.Tensor) -> float:
        """Mean loss of the frames (frame, x, v) of a rollout from `velocity` [N, 3] on, acceleration included."""
        total, count = 0.0, 0
        previous: torch.Tensor | None = None
        for frame, x, v in states:
            total += float(self(frame, x))
            change = v - velocity
            if previous is not None:
                total += self.weights.acceleration * float(acceleration(change, previous))
            velocity, previous, count = v, change, count + 1
        return total / count
