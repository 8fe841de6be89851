"""Controllers: where they are in each frame, which of them hold, and the springs of those that take hold later than in frame 0.

At the frame in which a controller at x_c begins to hold, spring (c, n) with stiffness Y and rest length l0 becomes

    l0' = |x_c - x_n|,   Y' = Y l0' / l0,

with x_n where the simulated node is then. So the springs have no force at that moment, and Y' / l0' = Y / l0: force per length, and
with it the substep that was found stable, stay. Both are functions of the state of that frame, and of the parameters: gradients go
through them, exactly. Springs that only push keep their lengths.
"""

from __future__ import annotations

import numpy as np
import torch

from neuspring.physics.lanes import MIN_SPRING_LENGTH

BEGINS = 2.0
"""Value in the last column of a row of waypoints: the controller begins to hold in this frame."""


def waypoints(hands: torch.Tensor, valid: np.ndarray | None = None) -> torch.Tensor:
    """Rows that a solver takes for `begin` and `end` of frames, one row per frame: hands [T, C, 3], m.

    Where some controller does not hold in some frame (`valid` [T', C], T' >= T; empty or none: all hold), a last column has 1 or 0,
    and 2 where it begins to hold, but in frame 0. The springs of a controller act in a frame if it holds at both ends of the frame.
    When it begins to hold they take the rest lengths of that moment.
    """
    if valid is None or valid.all():
        return hands
    holds = torch.tensor(valid[: len(hands)], dtype=hands.dtype, device=hands.device)
    holds[1:] += (BEGINS - 1.0) * (holds[1:] - holds[:-1]).clamp(min=0.0)
    return torch.cat([hands, holds[..., None]], dim=-1)


def begins(row: torch.Tensor) -> torch.Tensor:
    """True for the controllers [..., C] of a row of waypoints that begin to hold; none where it has no such column."""
    return row[..., 3] == BEGINS if row.shape[-1] == 4 else torch.zeros(row.shape[:-1], dtype=torch.bool, device=row.device)


def begun(row: torch.Tensor) -> torch.Tensor:
    """The row after its grips were taken: who begins holds."""
    return torch.cat([row[..., :3], row[..., 3:].clamp(max=1.0)], dim=-1) if row.shape[-1] == 4 else row


class ControllerSprings:
    """The springs of controllers among spring_pairs [S, 2]; i >= nodes means controller i - nodes."""

    def __init__(self, spring_pairs: np.ndarray, nodes: int, device: str) -> None:
        ends = np.sort(np.asarray(spring_pairs).reshape(-1, 2), axis=1)
        led = np.flatnonzero(ends[:, 1] >= nodes)
        self.springs, self.nodes, self.leaders = (
            torch.tensor(values, dtype=torch.long, device=device) for values in (led, ends[led, 0], ends[led, 1] - nodes)
        )
        """Springs of controllers [L], the node and the controller of each."""

    def taken(self, lengths: torch.Tensor | None, x: torch.Tensor, row: torch.Tensor) -> torch.Tensor | None:
        """Rest lengths [..., L], m, after the grips that begin in a frame; 0 where a spring's own holds; None: everywhere.

        `lengths` are those before, x [..., N, 3], m, the nodes in that frame, and `row` [..., C, K] its waypoints.
        """
        now = begins(row)
        if not bool(now.any()):
            return lengths
        apart = (row[..., self.leaders, :3] - x[..., self.nodes, :]).norm(dim=-1).clamp(min=MIN_SPRING_LENGTH)
        before = torch.zeros_like(apart) if lengths is None else lengths
        return torch.where(now[..., self.leaders], apart, before)

    def applied(self, packed: torch.Tensor, lengths: torch.Tensor | None) -> torch.Tensor:
        """Parameters [..., S, 3] of springs with rest lengths [..., L], and the stiffness that goes with them."""
        if lengths is None:
            return packed
        stiffness, inverse, dashpot = packed[..., self.springs, :].unbind(dim=-1)
        new = (lengths > 0) & (inverse > 0)
        safe = torch.where(new, lengths, 1.0)
        own = [torch.where(new, stiffness * inverse * safe, stiffness), torch.where(new, 1.0 / safe, inverse), dashpot]
        return packed.index_copy(-2, self.springs, torch.stack(own, dim=-1))
