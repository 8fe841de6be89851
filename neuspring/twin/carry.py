"""Correct the state at the end of the training frames by what was observed there, if that helps on training frames.

The tracked points are observed at the last training frame s. The state is corrected there, to x(s) + R and v(s) + R', and the
simulation goes on from it. R is the residual (observed - predicted) of the tracked points, R' that of their velocities, (3 x(s) -
4 x(s-1) + x(s-2)) / (2 dt); both are spread over all nodes, with no residual at the controllers. Training frames alone decide
whether to do so: earlier frames take the role of s, later training frames that of the future.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from neuspring.core.artifacts import Observations, Trajectory, Twin
from neuspring.physics.autograd import solver_for
from neuspring.physics.path import waypoints
from neuspring.twin.motion import recent_velocity, spread
from neuspring.twin.rollout import Diverged, frames

ORIGINS = 12
"""Training frames that take the role of the last one."""
LEAST_GAIN = 0.02
"""The state is corrected only if that lowers the error of training frames by this fraction."""

State = tuple[np.ndarray, np.ndarray]
"""Positions, m, and velocities, m/s, of all nodes, [N, 3] each."""


def carry_over(
    trajectory: Trajectory, twin: Twin, observations: Observations, velocity: np.ndarray, device: str = "cpu"
) -> tuple[Trajectory, dict[str, float]]:
    """The corrected trajectory of a twin, the `gain` on training frames, and `carried`: 1 if it was corrected, else 0.

    `trajectory` is the twin's rollout from `velocity` [N, 3], m/s. Frames before the split stay as they are. A trajectory that
    diverged, or would diverge from the corrected state, is returned unchanged.
    """
    scenario = observations.scenario
    last = scenario.train_end - 1
    if trajectory.diverged_frame is not None or last < 2:
        return trajectory, {"gain": 0.0, "carried": 0.0}
    run = _Continuation(twin, observations, device)
    states = run.states(velocity)
    gain = training_gain(run, states, scenario.frame_count - scenario.train_end)
    future = run.corrected(last, states[last], scenario.frame_count) if gain >= LEAST_GAIN else None
    if future is None:
        return trajectory, {"gain": gain, "carried": 0.0}
    positions = np.concatenate([trajectory.positions[: last + 1], future])
    return replace(trajectory, positions=positions), {"gain": gain, "carried": 1.0}


class _Continuation:
    """Rollouts of one twin that go on from a corrected state."""

    def __init__(self, twin: Twin, observations: Observations, device: str) -> None:
        self.twin, self.observations, self.device = twin, observations, device
        self._solver = solver_for(twin, device, differentiable=False)
        self._hands = waypoints(torch.tensor(observations.controller_points, device=device), twin.simulation)
        nodes, points = len(observations.nodes), observations.object_points.shape[1]
        self._nodes, self._points = observations.canonical[:nodes], observations.canonical[:points]
        self._controllers = observations.canonical[nodes:]

    def states(self, velocity: np.ndarray) -> list[State]:
        """The states of all training frames, from frame 0 on."""
        hands = self._hands[: self.observations.scenario.train_end]
        rest: State = (self.twin.topology.nodes, velocity)
        return [rest] + [(x.cpu().numpy(), v.cpu().numpy()) for _, x, v in frames(self.twin, self._solver, hands, velocity)]

    def corrected(self, frame: int, state: State, stop: int) -> np.ndarray | None:
        """Positions [stop - frame - 1, N, 3], m, of the frames after `frame`, from its corrected state. None: it diverged."""
        observations = self.observations
        x, v = (values.astype(np.float64) for values in state)
        points = len(self._points)
        visible = observations.object_visibility[frame][:, None]
        targets = np.where(visible, observations.object_points[frame].astype(np.float64), np.nan)
        x += self._spread(targets - x[:points])
        v += self._spread(recent_velocity(observations, frame) - v[:points])
        try:
            later = frames(self.twin, self._solver, self._hands[frame:stop], v, positions=x)
            return np.array([x.cpu().numpy() for _, x, _ in later]).reshape(-1, *x.shape)
        except Diverged:
            return None

    def _spread(self, residual: np.ndarray) -> np.ndarray:
        """Residuals of tracked points [No, 3], NaN where unknown, on all nodes [N, 3]; none at the controllers."""
        finite = ~np.isnan(residual).any(axis=1)
        if not finite.any():
            return np.zeros((len(self._nodes), 3))
        anchors = np.concatenate([self._points[finite], self._controllers])
        return spread(anchors, np.concatenate([residual[finite], np.zeros((len(self._controllers), 3))]), self._nodes)


def training_gain(run: _Continuation, states: list[State], future: int) -> float:
    """The fraction by which corrections lower the mean error of training frames; 0 where there are too few frames.

    Origins lie in the second half of the training frames; from each, up to `future` later training frames count. A
    continuation that diverges counts as twice the error: -1.
    """
    last = len(states) - 1
    first = max(len(states) // 2, 2)
    without, corrected = [], []
    for origin in sorted({int(i) for i in np.linspace(first, last - 1, ORIGINS)}) if first < last else []:
        stop = min(origin + 1 + future, len(states))
        positions = run.corrected(origin, states[origin], stop)
        if positions is None:
            return -1.0
        without.append(_error(np.array([x for x, _ in states[origin + 1 : stop]]), run.observations, origin + 1))
        corrected.append(_error(positions, run.observations, origin + 1))
    finite = ~np.isnan(without)
    if not finite.any():
        return 0.0
    return float(1 - np.mean(np.array(corrected)[finite]) / max(float(np.mean(np.array(without)[finite])), 1e-12))


def _error(positions: np.ndarray, observations: Observations, first: int) -> float:
    """Mean distance, m, of nodes [F, N, 3] from the visible points in the frames from `first` on; NaN if there are none."""
    targets = observations.object_points[first : first + len(positions)]
    visible = observations.object_visibility[first : first + len(positions)]
    if not visible.any():
        return float("nan")
    return float(np.linalg.norm(positions[:, : targets.shape[1]] - targets, axis=2)[visible].mean())
