"""What training sees of a capture: tracks and tools in the training frames, with +z up, outliers dropped, smoothed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from neuspring.baselines.gs_dynamics.rules import Rules
from neuspring.config.gs_dynamics import GsDynamics
from neuspring.core.artifacts import Observations, Up
from neuspring.core.points import farthest

HALF_TURN = np.array([1, -1, -1], dtype=np.float32)
"""About the x axis: takes a world with -z up to one with +z up, and back, without making a mirror image of it."""
HAND_GAP = 0.08
"""Controllers that a chain of gaps no longer than this joins in frame 0 are one hand, m."""


def upright(points: np.ndarray, up: Up) -> np.ndarray:
    """Points [..., 3] with +z up, m; applied again, as they were."""
    return points.astype(np.float32) if up == "+z" else points.astype(np.float32) * HALF_TURN


@dataclass(frozen=True)
class Tracks:
    """Of T training frames."""

    points: np.ndarray
    """[T, M, 3] m; anything where not visible."""
    visible: np.ndarray
    """[T, M] bool."""
    tools: np.ndarray
    """[T, C, 3] m."""
    dropped: int
    """Tracks that were outliers."""

    @classmethod
    def of(cls, observations: Observations, settings: GsDynamics, rules: Rules) -> Tracks:
        """Of the training frames of a capture, and nothing else of it."""
        train, up = slice(observations.scenario.train_end), observations.scenario.up
        points, visible = upright(observations.object_points[train], up), observations.object_visibility[train]
        kept = np.flatnonzero(ordinary(points, visible, settings.outlier_deviations))
        chosen = kept[farthest(points[0, kept], settings.dense_points)]
        smooth = smoothed(points[:, chosen], visible[:, chosen], settings.smoothing_passes)
        tools = tools_of(upright(observations.controller_points[train], up), rules)
        return cls(smooth, visible[:, chosen], tools, points.shape[1] - len(kept))


def tools_of(controllers: np.ndarray, rules: Rules) -> np.ndarray:
    """Tool nodes [T, C', 3], m: the controllers [T, C, 3], or the mean of each hand.

    Nothing tells which controllers are of one hand: those that are linked in frame 0 by gaps of at most `HAND_GAP`.
    """
    if rules.tools == "points" or controllers.shape[1] == 1:
        return controllers
    hand = fcluster(linkage(controllers[0], "single"), HAND_GAP, "distance")
    return np.stack([controllers[:, hand == k].mean(axis=1) for k in np.unique(hand)], axis=1)


def path_lengths(points: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """[M] m: the mean motion between successive frames that both see a point, times their number; NaN where there are none."""
    both = visible[1:] & visible[:-1]
    steps = np.where(both, np.linalg.norm(np.diff(points, axis=0), axis=2), 0.0)
    pairs = both.sum(axis=0)
    return np.where(pairs > 0, steps.sum(axis=0) * len(both) / np.maximum(pairs, 1), np.nan)


def ordinary(points: np.ndarray, visible: np.ndarray, deviations: float) -> np.ndarray:
    """[M] bool: tracks whose path length is not `deviations` or more median absolute deviations from the median (0: all tracks).

    Where the deviation is 0, as when all move as one, there are no outliers. Points without a path are no use.
    """
    lengths = path_lengths(points, visible)
    found = np.isfinite(lengths)
    if not deviations or not found.any():
        return np.ones_like(found)
    away = np.abs(lengths - np.median(lengths[found]))
    spread = np.median(away[found])
    return np.asarray(found & (away < deviations * spread)) if spread > 0 else found


def smoothed(points: np.ndarray, visible: np.ndarray, passes: int) -> np.ndarray:
    """Points [T, M, 3] after moving averages over three frames, of what is visible [T, M] of them; others stay."""
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
