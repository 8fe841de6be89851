"""Small Observations, made by hand, for tests without a scene."""

import numpy as np

from neuspring.core.artifacts import Observations, Scenario


def scenario(**changes):
    values = {"name": "scene", "source": "toy", "category": "toy", "frame_count": 5, "train_end": 3}
    return Scenario(**(values | {"frame_rate": 30.0, "up": "+z"} | changes))


def seen(points, hands, about=(), **changes):
    """Tracked points [T, N, 3] that are always visible, beside hands [T, C, 3], and nothing else; `about` changes the scenario."""
    frames, shown = len(points), np.ones(points.shape[:2], bool)
    values = {
        "scenario": scenario(**({"frame_count": frames, "train_end": frames} | dict(about))),
        "object_points": points,
        "object_visibility": shown,
        "object_motion_valid": shown,
        "controller_points": hands,
        "surface_points": np.zeros((0, 3)),
        "interior_points": np.zeros((0, 3)),
        "tracks": np.zeros((frames, 0, 3)),
    }
    return Observations(**(values | changes))


def observations(frames=5, points=3, **changes):
    """Points at rest on the x axis; everything visible and valid; one hand, one surface node, one interior node."""
    values = {
        "points": np.tile(np.arange(points)[:, None] * [1.0, 0, 0], (frames, 1, 1)),
        "hands": np.zeros((frames, 1, 3)) + 9,
        "surface_points": np.array([[0.0, 5, 0]]),
        "interior_points": np.array([[0.0, 0, 7]]),
    }
    return seen(about={"train_end": max(2, frames - 2)}, **(values | changes))
