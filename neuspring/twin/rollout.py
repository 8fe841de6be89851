"""Roll a twin out under recorded controller motion, and the velocity with which that begins."""

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
"""A node this far from the origin has left any plausible scene, m."""


class Diverged(Exception):
    """A rollout left every plausible range; carries the frame and what happened."""

    def __init__(self, frame: int, reason: str) -> None:
        super().__init__(reason)
        self.frame, self.reason = frame, reason


def left_scene(x: torch.Tensor, frame: int, reach: float, what: str = "node") -> str:
    """The first of the points [N, 3], m, that is farther than `reach` from the origin, in words; empty where none is."""
    # NaN compares false, so this catches it together with infinity and absurd distances.
    near = (x.abs() < reach).all(dim=1)
    return "" if bool(near.all()) else f"{what} {int((~near).nonzero()[0])} left the scene in frame {frame}"


def frames(
    twin: Twin, solver: FrameSolver, hands: torch.Tensor, velocity: np.ndarray | None = None
) -> Iterator[tuple[int, torch.Tensor, torch.Tensor]]:
    """Yield (frame, x [N, 3] m, v [N, 3] m/s) for frames 1, 2, ... of hands [T, C, 3] (controllers.waypoints). Raises Diverged.

    `velocity` [N, 3], m/s, is that of frame 0; none means at rest.
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
    """Simulate over controller_points [T, C, 3], m, from velocity [N, 3], m/s (none: at rest). Divergence is a named result.

    `valid` [T, C]: when each controller holds; empty or none: always. Raises Unstable if the substep is beyond the stability bound,
    unless `check` is false: the released simulator does not look.
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
"""Nearest points that a node's value is interpolated from."""
SPREAD_SMOOTHING = 1e-6
"""Keeps the interpolation solvable where two points coincide; in meters, far below any distance between points."""


def spread(points: np.ndarray, values: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Values [N, 3] at nodes [N, 3], from values [P, 3] at points [P, 3], by linear radial basis functions; P >= 1."""
    from scipy.interpolate import RBFInterpolator

    places, first = np.unique(points.astype(np.float64), axis=0, return_index=True)
    values = values[first].astype(np.float64)
    if len(places) == 1:
        return np.repeat(values, len(nodes), axis=0)
    interpolate = RBFInterpolator(places, values, min(SPREAD_NEIGHBORS, len(places)), SPREAD_SMOOTHING, "linear")
    return np.asarray(interpolate(nodes.astype(np.float64)))


def initial_velocity(observations: Observations, kind: InitialVelocity) -> np.ndarray:
    """Velocity of each node in frame 0 [N, 3], m/s.

    rest: zero, as in the released simulator. observed: (-3 x0 + 4 x1 - x2) / (2 dt) of tracked points and of controllers that hold,
    exact for constant acceleration, spread over the nodes; (x1 - x0) / dt where frame 2 is not visible or not for training.
    before: the recorded `velocity_before` of tracked points and controllers, spread alike. Raises InputError where there is none.
    """
    nodes = observations.nodes
    if kind == "rest":
        return np.zeros(nodes.shape)
    scenario = observations.scenario
    if kind == "before":
        if not len(observations.velocity_before):
            rule = "before needs a recording that knows the sample before frame 0"
            where = f"{scenario.name}, simulation.initial_velocity"
            raise InputError(where, rule, "none", "Choose observed.")
        places = np.concatenate([observations.object_points[0], observations.controller_points[0]])
        return spread(places, observations.velocity_before, nodes)
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
    """Which controllers [C] hold the object in all of these frames."""
    valid, count = observations.controller_valid, observations.controller_points.shape[1]
    return np.asarray(valid[frames].all(axis=0)) if valid.size else np.ones(count, dtype=bool)
