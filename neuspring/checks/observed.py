"""Observations: nodes, motion of the object, and controllers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from neuspring.core.artifacts import Observations
from neuspring.core.geometry import lean

FIRST, SETTLED = 4, 0.005
"""An object is at rest if it moves less than SETTLED, m, in the FIRST frames."""
GRIP = 0.04
"""Distance from the object, m, within which a controller can hold it."""
NO_INTERACTION = 0.15
"""Smallest distance between controllers and object, m, above which there is no interaction."""
OF_CONTROLLERS: dict[str, Any] = {"where": "controllers"}


@dataclass(frozen=True, eq=False)
class Observed:
    """Observations, and `moves`: the fraction of training frames in which the object's image changes."""

    observations: Observations
    moves: float = 0.0

    @property
    def motion(self) -> tuple[float, float]:
        """Largest displacement of the object in training frames, m, and the largest fraction of invisible points.

        The displacement of a frame is the 90th percentile over visible points; inf if only frame 0 shows the object.
        """
        end, image, space = self.observations.scenario.train_end, self.observations.image, self.observations
        if image is None:
            seen, points = space.object_visibility[:end], space.object_points
            moved = np.linalg.norm(points[:end] - points[0], axis=2)
        else:
            seen, moved = image.visible[:end], image.pixel_size * np.linalg.norm(image.pixels[:end] - image.pixels[0], axis=2)
        tenths = (float(np.quantile(row[shown], 0.9)) for row, shown in zip(moved[1:], seen[1:], strict=True) if shown.any())
        return max(tenths, default=np.inf), 1 - min((float(shown.mean()) for shown in seen), default=1.0)

    @cached_property
    def apart(self) -> np.ndarray:
        """[T, C], m: distance of controllers from the nearest visible point of the object, in frame 0 from the nearest node."""
        seen = self.observations
        apart = np.full(seen.controller_points.shape[:2], np.inf)
        for frame, own in enumerate(seen.controller_points):
            points = seen.nodes if frame == 0 else seen.object_points[frame, seen.object_visibility[frame]]
            if len(points):
                apart[frame] = cKDTree(points).query(own)[0]
        return apart

    @property
    def meets(self) -> bool:
        """True if hands come near the object. Otherwise only `gap` is reported."""
        return bool(self.apart.min() <= NO_INTERACTION)


def gap(seen: Observed) -> dict[str, Any]:
    """Smallest distance between controllers and object, m."""
    return OF_CONTROLLERS | {"value": float(seen.apart.min())}


def first_gap(seen: Observed) -> dict[str, Any] | None:
    """Smallest distance between controllers and object in frame 0, m."""
    return OF_CONTROLLERS | {"value": float(seen.apart[0].min())} if seen.meets else None


def motion_of_hands(seen: Observed) -> dict[str, Any] | None:
    """Largest displacement of a controller from frame 0, m."""
    points = seen.observations.controller_points
    return OF_CONTROLLERS | {"value": float(np.linalg.norm(points - points[0], axis=2).max())} if seen.meets else None


def speed_of_hands(seen: Observed) -> dict[str, Any] | None:
    """Largest median speed of the controllers between two frames, m/s."""
    rate = seen.observations.scenario.frame_rate
    speed = rate * np.median(np.linalg.norm(np.diff(seen.observations.controller_points, axis=0), axis=2), axis=1)
    if not seen.meets or not len(speed):
        return None
    frame = int(speed.argmax())
    return OF_CONTROLLERS | {"value": float(speed.max()), "detail": f"after frame {frame}", "frames": (frame,)}


def leaning(seen: Observed) -> dict[str, Any] | None:
    """Angle, degrees, in frame 0 between the vertical and an object that hangs at rest; None if it does not hang freely."""
    own = seen.observations
    up, hands, points = (
        own.scenario.up_sign,
        own.controller_points[0],
        own.object_points[:FIRST, own.object_visibility[:FIRST].all(axis=0)],
    )
    heights = up * own.nodes[:, 2]
    hangs = heights.mean() < up * hands[:, 2].mean() - GRIP
    free = not own.scenario.ground or heights.min() > GRIP
    still = points.size and np.linalg.norm(points - points[0], axis=2).max() < SETTLED
    return {"value": float(np.degrees(np.linalg.norm(lean(own.nodes, hands, up))))} if hangs and free and still else None


def motion_of_object(seen: Observed) -> dict[str, Any]:
    """Largest displacement of the object in training frames, m."""
    moved, lost = seen.motion
    detail = f"its image changes in {seen.moves:.0%} of the training frames; up to {lost:.0%} of its points are invisible"
    return {"value": moved, "detail": detail}


def node_count(seen: Observed) -> dict[str, Any]:
    """Number of nodes."""
    count = len(seen.observations.nodes)
    return {"value": count, "level": "error" if count < 4 else "note" if count > 30 else "warning"}
