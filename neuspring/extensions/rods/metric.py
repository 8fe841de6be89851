"""The error of DEFORM's evaluation."""

from __future__ import annotations

import numpy as np

from neuspring.core.artifacts import Observations
from neuspring.scores.metrics import Metric

LOWEST = 0.002001
"""Minimum height of observed markers in DEFORM's evaluation, m."""


def deform_l1(positions: np.ndarray, observations: Observations) -> np.ndarray:
    """Mean absolute difference of positions [F, N, 3] per frame [F], m, over coordinates and markers of the line.

    As in DEFORM's evaluation, held markers count with 0, and observed markers have at least the height `LOWEST`. The line must
    consist of controllers and of tracked points that are always visible.
    """
    free = observations.line[observations.line < len(observations.nodes)]
    seen = observations.object_points[: len(positions), free].astype(np.float64)
    seen[..., 2] = np.maximum(seen[..., 2], LOWEST)
    total: np.ndarray = np.abs(positions[:, free] - seen).sum(axis=(1, 2))
    return total / (3 * len(observations.line))


def _of_cables(positions: np.ndarray, observations: Observations) -> np.ndarray | None:
    """DEFORM's error; None unless the line has only markers, all visible."""
    line = observations.line
    of_markers = not ((line >= observations.object_points.shape[1]) & (line < len(observations.nodes))).any()
    of_markers &= bool(line.size) and observations.scenario.up == "+z" and bool(observations.object_visibility.all())
    return deform_l1(positions, observations) if of_markers else None


DEFORM_L1 = Metric(
    name="deform_l1",
    title="L1 error of DEFORM",
    heading="L1",
    unit="m",
    shown_unit="mm",
    factor=1e3,
    digits=2,
    function=_of_cables,
    explained="mean absolute difference of all coordinates of the markers along a cable, including held markers (0)",
)
