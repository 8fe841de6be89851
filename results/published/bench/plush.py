"""Observations of a plush that is lifted at one end, with the size of a real capture, for the section `search`.

Trunk and head are ellipsoids on the ground, filled with points 1 cm apart on average. The observed motion is smooth and not
physical, because the time of a search does not depend on its result.
"""

from __future__ import annotations

import functools

import numpy as np

from neuspring import config
from neuspring.core.artifacts import Observations
from neuspring.twin.candidates import SearchProblem
from tests.support import scenarios, small

FRAMES, RATE = 31, 30.0
TRACKED, SURFACE, NODES, HANDS = 300, 150, 650, 30
PARTS = (((0.0, 0.0, 0.041), (0.08, 0.05, 0.04)), ((0.095, 0.0, 0.051), (0.04, 0.035, 0.035)))
"""Center and semi-axes of each part, m."""
LIFT = 0.1
"""Rise of the controllers, m."""


def problem(rollouts: int, device: str) -> SearchProblem:
    """A search with the settings of the released code and a safe number of substeps."""
    return small.search_problem(observations(), search=config.Search(rollouts=rollouts), device=device)


@functools.cache
def observations() -> Observations:
    """The plush: tracked points near its surface first, then its interior."""
    rng = np.random.default_rng(0)
    points = filled(rng)
    hands = points[np.argsort(points[:, 0])[-HANDS:]] + rng.normal(0, 2e-3, (HANDS, 3)) + np.array([0.02, 0, 0])
    moved = np.stack([at(points, frame) for frame in range(FRAMES)])
    seen = np.ones((FRAMES, TRACKED), dtype=bool)
    seen[1:] = rng.random((FRAMES - 1, TRACKED)) > 0.2
    valid = np.zeros_like(seen)
    valid[:-1] = seen[:-1] & seen[1:]
    nodes = {"surface_points": points[TRACKED : TRACKED + SURFACE], "interior_points": points[TRACKED + SURFACE :]}
    return scenarios.seen(
        np.where(seen[..., None], moved[:, :TRACKED], 0.0),
        np.stack([at(hands, frame) for frame in range(FRAMES)]),
        {"name": "plush", "category": "plush", "frame_rate": RATE},
        object_visibility=seen,
        object_motion_valid=valid,
        tracks=moved[:, :10],
        **nodes,
    )


def filled(rng: np.random.Generator) -> np.ndarray:
    """NODES points in the parts, at least 6 mm apart, outermost first."""
    chosen = np.empty((0, 3))
    depth: list[float] = []
    centers, axes = (np.array(values) for values in zip(*PARTS, strict=True))
    while len(chosen) < NODES:
        point = rng.uniform([-0.08, -0.05, 0.0], [0.135, 0.05, 0.09])
        # 1 at the surface of a part, 0 at its center.
        level = float(np.linalg.norm((point - centers) / axes, axis=1).min())
        if level <= 1 and not (np.linalg.norm(chosen - point, axis=1) < 0.006).any():
            chosen = np.vstack([chosen, point])
            depth.append(-level)
    return chosen[np.argsort(depth)]


def at(points: np.ndarray, frame: int) -> np.ndarray:
    """Positions of points in a frame: the held end rises, the other end stays."""
    share = np.clip((points[:, 0] + 0.08) / 0.215, 0, 1)
    rise = LIFT * np.sin(np.pi / 2 * frame / (FRAMES - 1)) ** 2
    return points + np.outer(share**2 * rise, [0, 0, 1])
