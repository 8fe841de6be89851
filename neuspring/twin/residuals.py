"""The training loss of a rollout as a sum of squares: what Gauss-Newton steps need (polish.py)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from neuspring.twin.losses import FrameLoss, nearest


@dataclass(frozen=True)
class Residuals:
    """Residuals r of a rollout from `velocity` [N, 3], m/s, over the F frames after the first: |r|^2 is its cost (losses.py).

        chamfer       sqrt(w / visible) (x_near - p)
        track         sqrt(w / (3 valid)) s(x_i - p_i)              s(a) = a / sqrt(2) for |a| < 1 m, so that s^2 is smooth-L1,
        acceleration  sqrt(w / (3 N)) s(change of change of v)      and sign(a) sqrt(|a| - 1/2) beyond

    with weights w over F, for the mean over frames. x_near is the nearest surface node of one rollout, the base, also for its
    neighbors, so that residuals are smooth. Of captures without depth come those of image_losses.py.
    """

    loss: FrameLoss
    velocity: torch.Tensor

    @classmethod
    def of(cls, loss: FrameLoss, velocity: torch.Tensor) -> Residuals:
        """On the CPU, in double precision."""
        flags = loss.visible.cpu(), loss.motion_valid.cpu()
        points = loss.points.double().cpu()
        image = loss.image.to("cpu", torch.float64) if loss.image else None
        return cls(FrameLoss(points, *flags, loss.surface, loss.weights, loss.frozen_counts, image), velocity.double().cpu())

    def assigned(self, x: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Nearest surface node [F, P] of every visible point, for positions x [F, N, 3], 0 where a point is invisible; and, of
        captures without depth, of each frame's points of the mask."""
        found = torch.zeros(self.loss.visible[1:].shape, dtype=torch.int64)
        for frame, visible in enumerate(self.loss.visible[1:]):
            found[frame, visible] = nearest(self.loss.points[frame + 1][visible], x[frame, : self.loss.surface].double())
        image = self.loss.image
        return found, [image.assigned(frame, nodes) for frame, nodes in enumerate(x.double(), start=1)] if image else []

    def __call__(self, x: torch.Tensor, v: torch.Tensor, assigned: tuple[torch.Tensor, list[torch.Tensor]]) -> np.ndarray:
        """r, for positions and velocities [F, N, 3] and the nodes `assigned`."""
        loss, frames, nodes = self.loss, len(x), x.shape[1]
        x, v = x.double(), v.double()
        points, counts = loss.points[1:], torch.tensor(loss.counts()[1:], dtype=torch.float64).clamp_min(1)
        near = x.gather(1, assigned[0][..., None].expand(-1, -1, 3)) - points
        tracked = _root(x[:, : points.shape[1]] - points)
        change = torch.diff(torch.cat([self.velocity[None], v]), dim=0)
        parts = (
            (near * loss.visible[1:, :, None], loss.weights.chamfer / counts[:, 0]),
            (tracked * loss.motion_valid[:-1, :, None], loss.weights.track / (3 * counts[:, 1])),
            (_root(torch.diff(change, dim=0)), torch.full((frames - 1,), loss.weights.acceleration / (3 * nodes))),
        )
        flat = [((w / frames).sqrt()[:, None, None] * r).flatten() for r, w in parts]
        if loss.image:
            for frame, (nodes, own) in enumerate(zip(x, assigned[1], strict=True), start=1):
                for values in loss.image.residuals(frame, nodes, own).values():
                    flat += [r.flatten() / frames**0.5 for r in values]
        result: np.ndarray = torch.cat(flat).numpy()
        return result


def _root(a: torch.Tensor) -> torch.Tensor:
    """s(a), whose square is smooth-L1 of a."""
    size = a.abs()
    return torch.where(size < 1, a / 2**0.5, a.sign() * (size - 0.5).clamp_min(0).sqrt())
