"""What training sees of a capture: smoothed tracks without outliers, and tools, in the training frames, with +z up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from neuspring.baselines.gs_dynamics.rules import Rules
from neuspring.config.gs_dynamics import GsDynamics
from neuspring.core.artifacts import Observations, Up
from neuspring.core.geometry import farthest

HALF_TURN = np.array([1, -1, -1], dtype=np.float32)
"""Half a turn about the x axis: from a world with -z up to one with +z up, and back. It makes no mirror image."""
HAND_GAP = 0.08
"""Controllers that a chain of gaps no longer than this joins in frame 0 are one hand, m."""


def upright(points: np.ndarray, up: Up) -> np.ndarray:
    """Points [..., 3], m, of a world with this `up` in one with +z up. Applied twice, it changes nothing."""
    return points.astype(np.float32) if up == "+z" else points.astype(np.float32) * HALF_TURN


@dataclass(frozen=True)
class Tracks:
    """Tracks and tools in T training frames."""

    points: np.ndarray
    """[T, M, 3] m; without meaning where not visible."""
    visible: np.ndarray
    """[T, M] bool."""
    tools: np.ndarray
    """[T, C, 3] m."""
    dropped: int
    """How many tracks were outliers."""

    @classmethod
    def of(cls, observations: Observations, settings: GsDynamics, rules: Rules) -> Tracks:
        """From the training frames of a capture; nothing else of it is read."""
        train, up = slice(observations.scenario.train_end), observations.scenario.up
        points, visible = upright(observations.object_points[train], up), observations.object_visibility[train]
        inliers = np.flatnonzero(ordinary(points, visible, settings.outlier_deviations))
        indices = inliers[farthest(points[0, inliers], settings.dense_points)]
        smooth = smoothed(points[:, indices], visible[:, indices], settings.smoothing_passes)
        tools = tools_of(upright(observations.controller_points[train], up), rules)
        return cls(smooth, visible[:, indices], tools, points.shape[1] - len(inliers))


def tools_of(controllers: np.ndarray, rules: Rules) -> np.ndarray:
    """Tool nodes [T, C', 3], m: the controllers [T, C, 3], or the mean of each hand.

    Captures do not say which controllers belong to one hand, so gaps decide: see HAND_GAP.
    """
    if rules.tools == "points" or controllers.shape[1] == 1:
        return controllers
    hand = fcluster(linkage(controllers[0], "single"), HAND_GAP, "distance")
    return np.stack([controllers[:, hand == k].mean(axis=1) for k in np.unique(hand)], axis=1)


def path_lengths(points: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Path lengths [M], m: a point's mean motion over pairs of successive frames that see it, times the number of all pairs.

    NaN where no pair sees the point.
    """
    both = visible[1:] & visible[:-1]
    steps = np.where(both, np.linalg.norm(np.diff(points, axis=0), axis=2), 0.0)
    pairs = both.sum(axis=0)
    return np.where(pairs > 0, steps.sum(axis=0) * len(both) / np.maximum(pairs, 1), np.nan)


def ordinary(points: np.ndarray, visible: np.ndarray, deviations: float) -> np.ndarray:
    """[M] bool: tracks whose path length is less than `deviations` median absolute deviations from the median.

    All tracks with `deviations` 0. All tracks with a path where the deviation is 0, as when all move as one.
    """
    lengths = path_lengths(points, visible)
    finite = np.isfinite(lengths)
    if not deviations or not finite.any():
        return np.ones_like(finite)
    distance = np.abs(lengths - np.median(lengths[finite]))
    spread = np.median(distance[finite])
    return np.asarray(finite & (distance < deviations * spread)) if spread > 0 else finite


def smoothed(points: np.ndarray, visible: np.ndarray, passes: int) -> np.ndarray:
    """Points [T, M, 3] after moving averages over three frames of the visible [T, M] ones. Invisible points stay."""
    weights = visible[..., None].astype(np.float32)
    result = np.where(visible[..., None], points, 0).astype(np.float32)
    count = _three(weights)
    for _ in range(passes):
        result = weights * _three(result) / np.maximum(count, 1)
    return np.where(visible[..., None], result, points).astype(np.float32)


def _three(values: np.ndarray) -> np.ndarray:
    total = values.copy()
    total[1:] += values[:-1]
    total[:-1] += values[1:]
    return total
