"""Rollouts of a twin under recorded controller motion, and their initial velocity."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch

from neuspring.core.artifacts import InitialVelocity, Observations, Trajectory, Twin
from neuspring.core.errors import InputError
from neuspring.physics.controllers import waypoints
from neuspring.physics.solver import FrameSolver
from neuspring.twin.body import body_of

FAR_AWAY = 1e3
"""Distance from the origin beyond which a node has left any plausible scene, m."""


class Diverged(Exception):
    """A rollout diverged. Contains the frame and the reason."""

    def __init__(self, frame: int, reason: str) -> None:
        super().__init__(reason)
        self.frame, self.reason = frame, reason


def left_scene(x: torch.Tensor, frame: int, reach: float, what: str = "node") -> str:
    """Name the first of the points [N, 3], m, that is farther than `reach` from the origin; an empty string if none is."""
    # NaN compares false, so it counts as too far.
    near = (x.abs() < reach).all(dim=1)
    return "" if bool(near.all()) else f"{what} {int((~near).nonzero()[0])} left the scene in frame {frame}"


def frames(
    twin: Twin, solver: FrameSolver, hands: torch.Tensor, velocity: np.ndarray | None = None
) -> Iterator[tuple[int, torch.Tensor, torch.Tensor]]:
    """Yield (frame, x [N, 3] m, v [N, 3] m/s) for frames 1, 2, ... of hands [T, C, 3] (controllers.waypoints).

    `velocity` [N, 3], m/s, is the velocity in frame 0; None: at rest. Raises Diverged.
    """
    x = torch.tensor(twin.topology.nodes, dtype=solver.dtype, device=solver.device)
    v = torch.zeros_like(x) if velocity is None else torch.tensor(velocity, dtype=x.dtype, device=x.device)
    for frame in range(1, len(hands)):
        x, v = solver.forward(x, v, hands[frame - 1], hands[frame])
        if reason := left_scene(x, frame, FAR_AWAY):
            raise Diverged(frame, reason)
        yield frame, x, v


def roll_out(
    twin: Twin,
    controller_points: np.ndarray,
    device: str = "cpu",
    progress: Callable[[int], None] | None = None,
    velocity: np.ndarray | None = None,
    valid: np.ndarray | None = None,
    *,
    check: bool = True,
) -> Trajectory:
    """Simulate a twin under the motion of its controllers. Divergence is a result: the trajectory contains the frame and the
    reason.

    - controller_points: [T, C, 3], m
    - velocity: [N, 3] in frame 0, m/s; None: at rest
    - valid: [T, C], frames in which each controller holds; empty or None: all frames
    - check: raise Unstable if the substep exceeds the stability bound; the released simulator does not check
    """
    body = body_of(twin)
    if check:
        body.check(twin)
    solver = body.solver(twin, device)
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


SPREAD_NEIGHBORS = 16
"""Number of nearest points from which the value of a node is interpolated."""
SPREAD_SMOOTHING = 1e-6
"""Smoothing that keeps the interpolation solvable for coincident points, m; far below the distances between points."""


def spread(points: np.ndarray, values: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Interpolate values [P, 3] at points [P, 3] to nodes [N, 3] by linear radial basis functions; P >= 1."""
    from scipy.interpolate import RBFInterpolator

    positions, first = np.unique(points.astype(np.float64), axis=0, return_index=True)
    values = values[first].astype(np.float64)
    if len(positions) == 1:
        return np.repeat(values, len(nodes), axis=0)
    interpolate = RBFInterpolator(positions, values, min(SPREAD_NEIGHBORS, len(positions)), SPREAD_SMOOTHING, "linear")
    return np.asarray(interpolate(nodes.astype(np.float64)))


def initial_velocity(observations: Observations, kind: InitialVelocity) -> np.ndarray:
    """Velocity of each node in frame 0 [N, 3], m/s.

    - rest: zero, as in the released simulator
    - observed: (-3 x0 + 4 x1 - x2) / (2 dt) of tracks and of controllers that hold, interpolated to the nodes; exact for constant
      acceleration. If frame 2 is not visible or not a training frame: (x1 - x0) / dt
    - before: the recorded `velocity_before` of tracks and controllers, interpolated to the nodes

    Raises InputError if `velocity_before` is missing.
    """
    nodes = observations.nodes
    if kind == "rest":
        return np.zeros(nodes.shape)
    scenario = observations.scenario
    if kind == "before":
        if not len(observations.velocity_before):
            rule = "before needs a recording with velocities from the sample before frame 0"
            raise InputError(f"{scenario.name}, simulation.initial_velocity", rule, "none", "Choose observed.")
        points = np.concatenate([observations.object_points[0], observations.controller_points[0]])
        return spread(points, observations.velocity_before, nodes)
    x, hands = (values[:3].astype(np.float64) for values in (observations.object_points, observations.controller_points))
    visible, valid = observations.object_visibility, observations.object_motion_valid
    once = visible[1] & valid[0]
    v, v_hands = (x[1] - x[0]) * scenario.frame_rate, (hands[1] - hands[0]) * scenario.frame_rate
    if scenario.train_end > 2:
        twice = once & visible[2] & valid[1]
        v[twice] = (-3 * x[0] + 4 * x[1] - x[2])[twice] * scenario.frame_rate / 2
        v_hands = (-3 * hands[0] + 4 * hands[1] - hands[2]) * scenario.frame_rate / 2
    held = holding(observations, slice(0, 3))
    if not (once.any() or held.any()):
        return np.zeros(nodes.shape)
    return spread(np.concatenate([x[0][once], hands[0][held]]), np.concatenate([v[once], v_hands[held]]), nodes)


def holding(observations: Observations, frames: slice) -> np.ndarray:
    """True for the controllers [C] that hold the object in all of these frames."""
    valid, count = observations.controller_valid, observations.controller_points.shape[1]
    return np.asarray(valid[frames].all(axis=0)) if valid.size else np.ones(count, dtype=bool)
