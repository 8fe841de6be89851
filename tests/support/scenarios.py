"""Small hand-made Observations for tests that need the noun, not a scene."""

from __future__ import annotations

from typing import Any

import numpy as np

from neuspring.core.artifacts import Observations, Scenario


def scenario(**changes: Any) -> Scenario:
    values: dict[str, Any] = {"name": "scene", "source": "toy", "category": "toy", "frame_count": 5, "train_end": 3}
    return Scenario(**(values | {"frame_rate": 30.0, "up": "+z"} | changes))


def observations(frames: int = 5, points: int = 3, tracks: Any = None, **changes: Any) -> Observations:
    """Points at rest on the x axis; everything visible and valid; one hand, one surface node, one interior node."""
    row = np.arange(points)[:, None] * [1.0, 0, 0]
    values: dict[str, Any] = {
        "scenario": scenario(frame_count=frames, train_end=max(2, frames - 2)),
        "object_points": np.tile(row, (frames, 1, 1)),
        "object_visibility": np.ones((frames, points), bool),
        "object_motion_valid": np.ones((frames, points), bool),
        "controller_points": np.zeros((frames, 1, 3)) + 9,
        "surface_points": np.array([[0.0, 5, 0]]),
        "interior_points": np.array([[0.0, 0, 7]]),
        "tracks": np.zeros((frames, 0, 3)) if tracks is None else tracks,
    }
    return Observations(**(values | changes))
