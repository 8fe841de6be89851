"""Correct the state at the end of the training frames by what was observed until then, if that helps on training frames.

The state is corrected at the last training frame s, and the simulation goes on from it. How, is one of two:

    residuals   x(s) + R and v(s) + R', where R is the residual (observed - predicted) of the tracked points in frame s, R' that of
                their velocities, (3 x(s) - 4 x(s-1) + x(s-2)) / (2 dt); both are spread over all nodes, with no residual at the
                controllers
    state       least squares over the last frames through the simulator (last_frame.py)

Training frames alone decide whether to do so: earlier frames take the role of s, later training frames that of the future.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
import torch

from neuspring.config import Carry, LastFrame
from neuspring.core.artifacts import Observations, Trajectory, Twin
from neuspring.physics.autograd import solver_for
from neuspring.physics.path import waypoints
from neuspring.twin.last_frame import State, StateEstimator
from neuspring.twin.motion import holding, recent_velocity, spread
from neuspring.twin.rollout import Diverged, frames

ORIGINS = 12
"""Training frames that take the role of the last one."""
LEAST_GAIN = 0.02
"""The state is corrected only if that lowers the error of training frames by this fraction."""


class Correction(Protocol):
    """Ways to correct a state, of which the training frames choose one."""

    @property
    def variants(self) -> Sequence[float]:
        """A number for each way."""

    def corrected(self, frame: int, states: list[State], stop: int) -> list[np.ndarray | None]:
        """For each way, positions [stop - frame - 1, N, 3], m, of the frames after `frame` from its corrected state.

        None: it diverged. `states` are the uncorrected ones from frame 0 on; those after `frame` are not read.
        """


def carry_over(
    trajectory: Trajectory,
    twin: Twin,
    observations: Observations,
    velocity: np.ndarray,
    device: str = "cpu",
    how: Carry = "residuals",
    settings: LastFrame | None = None,
) -> tuple[Trajectory, dict[str, float]]:
    """The corrected trajectory of a twin, the `gain` on training frames, and `carried`: 1 if it was corrected, else 0.

    `trajectory` is the twin's rollout from `velocity` [N, 3], m/s. Frames before the split stay as they are. A trajectory that
    diverged, or would diverge from the corrected state, is returned unchanged. Of a `state`, `weight` is that of its prior.
    """
    scenario = observations.scenario
    last = scenario.train_end - 1
    if trajectory.diverged_frame is not None or last < 2:
        return trajectory, {"gain": 0.0, "carried": 0.0}
    states = training_states(twin, observations, velocity, device)
    run: Correction = Residuals(twin, observations, device)
    if how == "state":
        run = StateEstimator(twin, observations, settings or LastFrame(), device)
    gains = training_gains(run, states, observations, scenario.frame_count - scenario.train_end)
    best = int(np.argmax(gains))
    gain, future = gains[best], None
    if gain >= LEAST_GAIN:
        future = run.corrected(last, states, scenario.frame_count)[best]
    facts = {"gain": gain, "carried": 0.0 if future is None else 1.0}
    if how == "state":
        facts["weight"] = run.variants[best]
    if future is None:
        return trajectory, facts
    positions = np.concatenate([trajectory.positions[: last + 1], future])
    return replace(trajectory, positions=positions), facts


def training_states(twin: Twin, observations: Observations, velocity: np.ndarray, device: str = "cpu") -> list[State]:
    """The states of all training frames, from frame 0 on; the twin does not diverge there."""
    solver = solver_for(twin, device, differentiable=False)
    known = torch.tensor(observations.controller_points, device=device)
    hands = waypoints(known, twin.simulation, observations.controller_valid)[: observations.scenario.train_end]
    rest: State = (twin.topology.nodes, velocity)
    return [rest] + [(x.cpu().numpy(), v.cpu().numpy()) for _, x, v in frames(twin, solver, hands, velocity)]


class Residuals:
    """Rollouts of one twin that go on from a state corrected by interpolated residuals."""

    variants = (0.0,)

    def __init__(self, twin: Twin, observations: Observations, device: str) -> None:
        self.twin, self.observations = twin, observations
        self._solver = solver_for(twin, device, differentiable=False)
        hands = torch.tensor(observations.controller_points, device=device)
        self._hands = waypoints(hands, twin.simulation, observations.controller_valid)
        nodes, points = len(observations.nodes), observations.object_points.shape[1]
        self._nodes, self._points = observations.canonical[:nodes], observations.canonical[:points]
        self._controllers = observations.canonical[nodes:]

    def corrected(self, frame: int, states: list[State], stop: int) -> list[np.ndarray | None]:
        """See `Correction`."""
        observations = self.observations
        x, v = (values.astype(np.float64) for values in states[frame])
        points = len(self._points)
        visible = observations.object_visibility[frame][:, None]
        targets = np.where(visible, observations.object_points[frame].astype(np.float64), np.nan)
        # Only a hand that holds keeps what it holds in its place.
        held = self._controllers[holding(observations, slice(frame, frame + 1))]
        x += self._spread(targets - x[:points], held)
        v += self._spread(recent_velocity(observations, frame) - v[:points], held)
        try:
            self._solver.resume(self._hands[:frame], [x for x, _ in states])
            later = frames(self.twin, self._solver, self._hands[frame:stop], v, positions=x)
            return [np.array([x.cpu().numpy() for _, x, _ in later]).reshape(-1, *x.shape)]
        except Diverged:
            return [None]

    def _spread(self, residual: np.ndarray, held: np.ndarray) -> np.ndarray:
        """Residuals of tracked points [No, 3], NaN where unknown, on all nodes [N, 3]; none at controllers `held` [C', 3]."""
        finite = ~np.isnan(residual).any(axis=1)
        if not finite.any():
            return np.zeros((len(self._nodes), 3))
        anchors = np.concatenate([self._points[finite], held])
        return spread(anchors, np.concatenate([residual[finite], np.zeros((len(held), 3))]), self._nodes)


def training_gains(run: Correction, states: list[State], observations: Observations, future: int) -> list[float]:
    """The fraction by which each way of correcting lowers the mean error of training frames; 0 where there are too few frames.

    Origins lie in the second half of the training frames; from each, up to `future` later training frames count. A
    continuation that diverges counts as twice the error: -1.
    """
    last, ways = len(states) - 1, len(run.variants)
    first = max(len(states) // 2, 2)
    without: list[float] = []
    corrected: list[list[float]] = []
    diverged = np.zeros(ways, dtype=bool)
    for origin in sorted({int(i) for i in np.linspace(first, last - 1, ORIGINS)}) if first < last else []:
        stop = min(origin + 1 + future, len(states))
        paths = run.corrected(origin, states, stop)
        diverged |= [path is None for path in paths]
        if diverged.all():
            return [-1.0] * ways
        without.append(_error(np.array([x for x, _ in states[origin + 1 : stop]]), observations, origin + 1))
        corrected.append([float("nan") if path is None else _error(path, observations, origin + 1) for path in paths])
    finite = ~np.isnan(without)
    if not finite.any():
        return [0.0] * ways
    uncorrected = max(float(np.mean(np.array(without)[finite])), 1e-12)
    errors = np.array(corrected)[finite]
    return [-1.0 if gone else float(1 - np.mean(errors[:, way]) / uncorrected) for way, gone in enumerate(diverged)]


def _error(positions: np.ndarray, observations: Observations, first: int) -> float:
    """Mean distance, m, of nodes [F, N, 3] from the visible points in the frames from `first` on; NaN if there are none."""
    targets = observations.object_points[first : first + len(positions)]
    visible = observations.object_visibility[first : first + len(positions)]
    if not visible.any():
        return float("nan")
    return float(np.linalg.norm(positions[:, : targets.shape[1]] - targets, axis=2)[visible].mean())
