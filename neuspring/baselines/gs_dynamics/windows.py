"""What training sees of a capture, with +z up: smoothed tracks without outliers, tools, and windows of steps around every frame.

A window has H steps of history and F steps of future. A step is `step` m of tool motion. Tools are the controllers.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
import torch

from neuspring.baselines.gs_dynamics.model import HISTORY
from neuspring.config.baselines import GsDynamics
from neuspring.core.artifacts import Observations, Up
from neuspring.core.geometry import farthest

HALF_TURN = np.array([1, -1, -1], dtype=np.float32)
"""Half a turn about the x axis: from a world with -z up to one with +z up, and back. It makes no mirror image."""
DENSE_POINTS = 1000
"""Most tracks from which particles are drawn."""
MIN_VISIBLE = 20
"""Least tracks that must be seen in all frames of a window. Where fewer are, the window takes those seen in its history, and the
losses leave out what is not seen."""
SMOOTHING_PASSES = 10
"""Of a moving average over three frames on the visible part of tracks."""
LAST_ACCEPTED = 0.75
"""Part of a step that suffices for the last training frame to end a step."""


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
    def of(cls, observations: Observations, settings: GsDynamics) -> Tracks:
        """From the training frames of a capture; nothing else of it is read."""
        train, up = slice(observations.scenario.train_end), observations.scenario.up
        points, visible = upright(observations.object_points[train], up), observations.object_visibility[train]
        inliers = np.flatnonzero(ordinary(points, visible, settings.outlier_deviations))
        indices = inliers[farthest(points[0, inliers], DENSE_POINTS)]
        smooth = smoothed(points[:, indices], visible[:, indices], SMOOTHING_PASSES)
        tools = upright(observations.controller_points[train], up)
        return cls(smooth, visible[:, indices], tools, points.shape[1] - len(inliers))


def ordinary(points: np.ndarray, visible: np.ndarray, deviations: float) -> np.ndarray:
    """[M] bool: tracks whose path length is less than `deviations` median absolute deviations from the median.

    A path length is a point's mean motion over pairs of successive frames that see it, times the number of all pairs. A track
    without such a pair is dropped. All tracks stay with `deviations` 0, and all with a path where the deviation is 0.
    """
    both = visible[1:] & visible[:-1]
    steps = np.where(both, np.linalg.norm(np.diff(points, axis=0), axis=2), 0.0)
    pairs = both.sum(axis=0)
    lengths = np.where(pairs > 0, steps.sum(axis=0) * len(both) / np.maximum(pairs, 1), np.nan)
    finite = np.isfinite(lengths)
    if not deviations or not finite.any():
        return np.ones_like(finite)
    distance = np.abs(lengths - np.median(lengths[finite]))
    spread = np.median(distance[finite])
    return np.asarray(finite & (distance < deviations * spread)) if spread > 0 else finite


def smoothed(points: np.ndarray, visible: np.ndarray, passes: int) -> np.ndarray:
    """Points [T, M, 3] after moving averages over three frames of the visible [T, M] ones. Invisible points stay."""

    def three(values: np.ndarray) -> np.ndarray:
        total = values.copy()
        total[1:] += values[:-1]
        total[:-1] += values[1:]
        return total

    weights = visible[..., None].astype(np.float32)
    result = np.where(visible[..., None], points, 0).astype(np.float32)
    count = three(weights)
    for _ in range(passes):
        result = weights * three(result) / np.maximum(count, 1)
    return np.where(visible[..., None], result, points).astype(np.float32)


def steps(tools: np.ndarray, frames: Iterable[int], step: float, last_accepted: float = 1.0) -> Iterator[int]:
    """The first of `frames`, then each in which any tool of [T, C, 3] has moved `step`, m, since the one before.

    The last frame of the recording needs only `last_accepted` of a step.
    """
    latest = None
    for frame in frames:
        least = step * (last_accepted if frame == len(tools) - 1 else 1.0)
        if latest is None or float(np.linalg.norm(tools[frame] - tools[latest], axis=1).max()) >= least:
            latest = frame
            yield frame


def executed(tools: np.ndarray, step: float) -> list[int]:
    """Frames in which a rollout makes a step: those in which tools [T, C, 3] have moved `step`, m, since the one before."""
    return list(steps(tools, range(len(tools)), step))[1:]


def past(tools: np.ndarray, frame: int, step: float) -> list[int]:
    """H frames up to `frame`, oldest first, a step apart; where there are fewer, the oldest is repeated."""
    frames = list(islice(steps(tools, range(frame, -1, -1), step), HISTORY))
    return [frames[-1]] * (HISTORY - len(frames)) + frames[::-1]


def ahead(tools: np.ndarray, frame: int, step: float, count: int) -> list[int]:
    """`count` frames after `frame`, a step apart; where there are fewer, the latest is repeated. Empty where there is none."""
    frames = list(islice(steps(tools, range(frame, len(tools)), step, LAST_ACCEPTED), 1, count + 1))
    return frames + frames[-1:] * (count - len(frames))


def window_frames(tools: np.ndarray, settings: GsDynamics) -> np.ndarray:
    """Frames [W, H + F] of each window. A frame without a step ahead has none, as nothing moves there in a rollout."""
    rows = []
    for frame in range(len(tools)):
        future = ahead(tools, frame, settings.step, settings.future)
        if future:
            rows.append(past(tools, frame, settings.step) + future)
    return np.array(rows, dtype=np.int64).reshape(-1, HISTORY + settings.future)


@dataclass(frozen=True, eq=False)
class Windows:
    """The windows of a capture, on a device."""

    frames: torch.Tensor
    """[W, H + F] int64."""
    usable: torch.Tensor
    """[W, M] bool: tracks that may become particles: those seen in the whole history, so every input is a measured position."""
    points: torch.Tensor
    """[T, M, 3] m."""
    visible: torch.Tensor
    """[T, M] bool."""
    tools: torch.Tensor
    """[T, C, 3] m."""

    def __len__(self) -> int:
        return len(self.frames)

    @classmethod
    def of(cls, tracks: Tracks, settings: GsDynamics, device: str) -> Windows:
        """All windows in which at least one track may become a particle.

        These are tracks visible in all frames of the window. Fallback if fewer than MIN_VISIBLE: visible in the history only.
        """
        frames = window_frames(tracks.tools, settings)
        seen: np.ndarray = tracks.visible[frames]
        throughout = seen.all(axis=1)
        enough = throughout.sum(axis=1, keepdims=True) >= MIN_VISIBLE
        usable = np.where(enough, throughout, seen[:, :HISTORY].all(axis=1))
        nonempty = usable.any(axis=1)
        arrays = (frames[nonempty], usable[nonempty], tracks.points, tracks.visible, tracks.tools)
        return cls(*(torch.tensor(values, device=device) for values in arrays))
