"""Roll a twin out under recorded controller motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch

from neuspring.core.artifacts import Trajectory, Twin
from neuspring.physics import stability
from neuspring.physics.controllers import waypoints
from neuspring.physics.solver import FrameSolver, solver_for

FAR = 1e3
"""A node this far from the origin has left any plausible scene, m."""


class Diverged(Exception):
    """A rollout left every plausible range; carries the frame and what happened."""

    def __init__(self, frame: int, reason: str) -> None:
        super().__init__(reason)
        self.frame, self.reason = frame, reason


def frames(
    twin: Twin,
    solver: FrameSolver,
    hands: torch.Tensor,
    velocity: np.ndarray | None = None,
    positions: np.ndarray | None = None,
) -> Iterator[tuple[int, torch.Tensor, torch.Tensor]]:
    """Yield (frame, x [N, 3] m, v [N, 3] m/s) for frames 1, 2, ... of hands [T, C, 3] (controllers.waypoints). Raises Diverged.

    `velocity` [N, 3], m/s, and `positions` [N, 3], m, are those of frame 0; none means at rest, and where the twin's nodes are.
    """
    x = torch.tensor(twin.topology.nodes if positions is None else positions, dtype=solver.dtype, device=solver.device)
    v = torch.zeros_like(x) if velocity is None else torch.tensor(velocity, dtype=x.dtype, device=x.device)
    for frame in range(1, len(hands)):
        x, v = solver.forward(x, v, hands[frame - 1], hands[frame])
        # NaN compares false, so this catches it together with infinity and absurd distances.
        near = (x.abs() < FAR).all(dim=1)
        if not bool(near.all()):
            raise Diverged(frame, f"node {int((~near).nonzero()[0])} left the scene in frame {frame}")
        yield frame, x, v


def roll_out(
    twin: Twin,
    controller_points: np.ndarray,
    device: str = "cpu",
    progress: Callable[[int], None] | None = None,
    velocity: np.ndarray | None = None,
    valid: np.ndarray | None = None,
) -> Trajectory:
    """Simulate over controller_points [T, C, 3], m, from velocity [N, 3], m/s (none: at rest). Divergence is a named result.

    `valid` [T, C]: when each controller holds; empty or none: always. Raises Unstable if the substep is beyond the stability bound.
    """
    stability.check(twin)
    return simulate(twin, controller_points, device, progress, velocity, valid)


def simulate(
    twin: Twin,
    controller_points: np.ndarray,
    device: str = "cpu",
    progress: Callable[[int], None] | None = None,
    velocity: np.ndarray | None = None,
    valid: np.ndarray | None = None,
) -> Trajectory:
    """As `roll_out`, without the check of the substep: the released simulator has none."""
    solver = solver_for(twin, device, differentiable=False)
    hands = torch.tensor(np.asarray(controller_points), dtype=torch.float32, device=device)
    positions = [torch.tensor(twin.topology.nodes)]
    diverged, reason = None, ""
    try:
        for frame, x, _ in frames(twin, solver, waypoints(hands, valid), velocity):
            positions.append(x.cpu())
            if progress is not None:
                progress(frame)
    except Diverged as end:
        diverged, reason = end.frame, end.reason
    return Trajectory(
        positions=torch.stack(positions).numpy(),
        frame_count=len(hands),
        diverged_frame=diverged,
        reason=reason,
        collision_overflow=solver.collision_overflow,
    )
