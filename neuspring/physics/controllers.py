"""Controllers: their positions in each frame, which of them hold, and the springs of grasps that begin after frame 0.

In the frame in which a controller at x_c begins to hold, spring (c, n) with stiffness Y and rest length l0 gets

    l0' = |x_c - x_n|,   Y' = Y l0' / l0,

where x_n is the position of the simulated node in that frame. So the spring starts without force. Y' / l0' = Y / l0, so the force
per length and the stable substep do not change. Gradients pass through l0' and Y' exactly. Springs that only push keep their rest
length.
"""

from __future__ import annotations

import numpy as np
import torch

from neuspring.physics.lanes import MIN_SPRING_LENGTH

BEGINS = 2.0
"""Value in the last column of waypoints for a controller that begins to hold in this frame."""


def waypoints(hands: torch.Tensor, valid: np.ndarray | None = None) -> torch.Tensor:
    """Waypoints for a solver, which uses one row as `begin` and the next as `end` of a frame.

    - hands: positions of the controllers [T, C, 3], m
    - valid: frames in which each controller holds [T', C], T' >= T; empty or None: all frames

    If some controller does not hold in some frame, the result has a fourth column: 1 if the controller holds, 2 if it begins to
    hold after frame 0, 0 otherwise. Springs of a controller act in a frame if it holds at both ends of the frame. Their rest
    lengths are reset when the controller begins to hold.
    """
    if valid is None or valid.all():
        return hands
    holds = torch.tensor(valid[: len(hands)], dtype=hands.dtype, device=hands.device)
    holds[1:] += (BEGINS - 1.0) * (holds[1:] - holds[:-1]).clamp(min=0.0)
    return torch.cat([hands, holds[..., None]], dim=-1)


def begins(row: torch.Tensor) -> torch.Tensor:
    """True for the controllers [..., C] of a row of waypoints that begin to hold; rows without a fourth column have none."""
    return row[..., 3] == BEGINS if row.shape[-1] == 4 else torch.zeros(row.shape[:-1], dtype=torch.bool, device=row.device)


def begun(row: torch.Tensor) -> torch.Tensor:
    """The row of waypoints after its grasps have begun: 2 becomes 1 in the fourth column."""
    return torch.cat([row[..., :3], row[..., 3:].clamp(max=1.0)], dim=-1) if row.shape[-1] == 4 else row


class ControllerSprings:
    """The controller springs among spring_pairs [S, 2]; i >= nodes means controller i - nodes."""

    def __init__(self, spring_pairs: np.ndarray, nodes: int, device: str) -> None:
        ends = np.sort(np.asarray(spring_pairs).reshape(-1, 2), axis=1)
        led = np.flatnonzero(ends[:, 1] >= nodes)
        self.springs, self.nodes, self.leaders = (
            torch.tensor(values, dtype=torch.long, device=device) for values in (led, ends[led, 0], ends[led, 1] - nodes)
        )
        """Indices of the controller springs [L], and the node and the controller of each."""

    def taken(self, lengths: torch.Tensor | None, x: torch.Tensor, row: torch.Tensor) -> torch.Tensor | None:
        """Rest lengths [..., L], m, after the grasps that begin in a frame; 0: a spring keeps its own; None: all do.

        - lengths: rest lengths before the frame
        - x: nodes in the frame [..., N, 3], m
        - row: waypoints of the frame [..., C, K]
        """
        now = begins(row)
        if not bool(now.any()):
            return lengths
        apart = (row[..., self.leaders, :3] - x[..., self.nodes, :]).norm(dim=-1).clamp(min=MIN_SPRING_LENGTH)
        before = torch.zeros_like(apart) if lengths is None else lengths
        return torch.where(now[..., self.leaders], apart, before)

    def applied(self, packed: torch.Tensor, lengths: torch.Tensor | None) -> torch.Tensor:
        """Apply rest lengths [..., L] of grasps, and the resulting stiffness, to the parameters of springs [..., S, 3]."""
        if lengths is None:
            return packed
        stiffness, inverse, dashpot = packed[..., self.springs, :].unbind(dim=-1)
        new = (lengths > 0) & (inverse > 0)
        safe = torch.where(new, lengths, 1.0)
        own = [torch.where(new, stiffness * inverse * safe, stiffness), torch.where(new, 1.0 / safe, inverse), dashpot]
        return packed.index_copy(-2, self.springs, torch.stack(own, dim=-1))
