"""Carry the residual of the last training frame into the prediction, where training frames say that it helps.

At the last training frame s the tracked points are known, so the error r(s) = observed - predicted is known there. A
prediction is corrected by a part of it that fades: x(t) + exp(-(t - s) / tau) r(s), spread over all nodes. The time constant
tau is chosen on training frames alone: earlier frames take the role of s, later training frames that of the future.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neuspring.artifacts import Observations, Trajectory
from neuspring.motion import spread

TIME_CONSTANTS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Candidates for tau, s."""
ORIGINS = 12
"""Training frames that take the role of the last one."""
LEAST_GAIN = 0.02
"""The guard: nothing is carried unless it would have lowered the training error by this fraction."""
LEAST_SHARE = 0.6
"""The guard: and in this share of the origins."""


def carry_over(trajectory: Trajectory, observations: Observations) -> tuple[Trajectory, dict[str, float]]:
    """The corrected trajectory, and facts: `time_constant`, s (0: nothing was carried), and the `gain` on training frames.

    Frames before the split stay as they are. A rollout that diverged within the training frames is returned unchanged.
    """
    scenario = observations.scenario
    last = scenario.train_end - 1
    if len(trajectory.positions) <= last:
        return trajectory, {"time_constant": 0.0, "gain": 0.0}
    residuals = _residuals(trajectory, observations)
    tau, gain = choose(residuals, scenario.frame_count - scenario.train_end, scenario.frame_rate)
    residual = residuals[last]
    known = ~np.isnan(residual).any(axis=1)
    if tau == 0 or not known.any():
        return trajectory, {"time_constant": 0.0, "gain": gain}
    correction = spread(observations.object_points[0][known], residual[known], observations.nodes)
    positions = trajectory.positions.copy()
    later = np.arange(1, len(positions) - last)
    positions[last + 1 :] += np.exp(-later / (tau * scenario.frame_rate))[:, None, None] * correction
    return replace(trajectory, positions=positions), {"time_constant": tau, "gain": gain}


def _residuals(trajectory: Trajectory, observations: Observations) -> np.ndarray:
    """Observed minus predicted, m, of tracked points in the training frames [train_end, No, 3]; NaN where not seen."""
    end, points = observations.scenario.train_end, observations.object_points
    residual: np.ndarray = points[:end].astype(np.float64) - trajectory.positions[:end, : points.shape[1]]
    residual[~observations.object_visibility[:end]] = np.nan
    return residual


def choose(residuals: np.ndarray, future: int, frame_rate: float) -> tuple[float, float]:
    """(tau, gain): the time constant, s, that lowers the mean error of training frames most, 0 if the guard refuses.

    residuals [F, No, 3], m, of the training frames. Origins lie in their second half; from each, up to `future` later training
    frames are corrected. gain: by which fraction tau (the best, whatever the guard says) lowers the mean error.
    """
    frames = len(residuals)
    origins = np.unique(np.linspace(frames // 2, frames - 2, ORIGINS).astype(int)) if frames >= 4 else np.zeros(0, int)
    without = np.array([_error(residuals, s, future, 0.0) for s in origins])
    usable = ~np.isnan(without)
    if not usable.any():
        return 0.0, 0.0
    best, gain, share = 0.0, -np.inf, 0.0
    for tau in TIME_CONSTANTS:
        corrected = np.array([_error(residuals, s, future, tau * frame_rate) for s in origins])
        lowered = 1 - corrected[usable].mean() / max(without[usable].mean(), 1e-12)
        if lowered > gain:
            best, gain, share = tau, float(lowered), float((corrected < without)[usable].mean())
    return (best if gain >= LEAST_GAIN and share >= LEAST_SHARE else 0.0), gain


def _error(residuals: np.ndarray, origin: int, future: int, tau: float) -> float:
    """Mean distance, m, over the frames after `origin`, once exp(-dt / tau) of its residual (tau in frames) is taken off."""
    later = residuals[origin + 1 : origin + 1 + future]
    part = np.exp(-np.arange(1, len(later) + 1) / tau)[:, None, None] if tau else np.zeros((len(later), 1, 1))
    distance = np.linalg.norm(later - part * residuals[origin], axis=2)
    return float(np.nanmean(distance)) if not np.isnan(distance).all() else float("nan")
