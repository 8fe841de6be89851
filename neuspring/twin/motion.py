"""From observed points to all nodes: quantities spread over the body, and its velocity in frame 0."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import RBFInterpolator

from neuspring.core.artifacts import InitialVelocity, Observations

NEIGHBORS = 16
"""Nearest points that a node's value is interpolated from."""
SMOOTHING = 1e-6
"""Keeps the interpolation solvable where two points coincide; in meters, far below any distance between points."""


def spread(points: np.ndarray, values: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Values [N, 3] at nodes [N, 3], from values [P, 3] at points [P, 3], by linear radial basis functions; P >= 1."""
    places, first = np.unique(points.astype(np.float64), axis=0, return_index=True)
    values = values[first].astype(np.float64)
    if len(places) == 1:
        return np.repeat(values, len(nodes), axis=0)
    interpolate = RBFInterpolator(places, values, min(NEIGHBORS, len(places)), SMOOTHING, "linear")
    result: np.ndarray = interpolate(nodes.astype(np.float64))
    return result


def initial_velocity(observations: Observations, kind: InitialVelocity) -> np.ndarray:
    """Velocity of each node in frame 0 [N, 3], m/s.

    rest: zero, as in the released simulator. observed: (-3 x0 + 4 x1 - x2) / (2 dt) of tracked points and of controllers that hold,
    exact for constant acceleration, spread over the nodes; (x1 - x0) / dt where frame 2 is not visible or not for training.
    """
    nodes = observations.nodes
    if kind == "rest":
        return np.zeros(nodes.shape)
    scenario = observations.scenario
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


def recent_velocity(observations: Observations, frame: int) -> np.ndarray:
    """Velocity of each tracked point in `frame` >= 2 [No, 3], m/s, from it and the two frames before; NaN where one is missing.

    (3 x(t) - 4 x(t-1) + x(t-2)) / (2 dt), exact for constant acceleration.
    """
    x = observations.object_points[frame - 2 : frame + 1].astype(np.float64)
    velocity: np.ndarray = (3 * x[2] - 4 * x[1] + x[0]) * observations.scenario.frame_rate / 2
    visible = observations.object_visibility[frame - 2 : frame + 1].all(axis=0)
    velocity[~(visible & observations.object_motion_valid[frame - 2 : frame].all(axis=0))] = np.nan
    return velocity
