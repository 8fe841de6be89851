"""Observations that every method reads: nodes, motion of the object, and controllers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from neuspring.core.artifacts import Observations
from neuspring.core.geometry import lean

FIRST, SETTLED = 4, 0.005
"""Frames in which an object at rest moves less than so many m."""
GRIP = 0.04
"""m from the object within which a controller can hold it."""
NO_INTERACTION = 0.15
"""m between hand and object, at their nearest, from which there is no interaction to learn from."""
OF_CONTROLLERS: dict[str, Any] = {"where": "controllers"}


@dataclass(frozen=True, eq=False)
class Observed:
    """Observations, and the share of training frames in which the image of the object changes, as masks show it."""

    observations: Observations
    moves: float = 0.0

    @property
    def motion(self) -> tuple[float, float]:
        """Farthest motion of the object in a training frame, m, which a tenth of its points exceed; largest share that is lost.

        It is not known where frame 0 alone shows the object: inf.
        """
        end, image, seen_of = self.observations.scenario.train_end, self.observations.image, self.observations
        if image is None:
            seen, points = seen_of.object_visibility[:end], seen_of.object_points
            moved = np.linalg.norm(points[:end] - points[0], axis=2)
        else:
            seen, moved = image.visible[:end], image.pixel_size * np.linalg.norm(image.pixels[:end] - image.pixels[0], axis=2)
        tenths = (float(np.quantile(row[shown], 0.9)) for row, shown in zip(moved[1:], seen[1:], strict=True) if shown.any())
        return max(tenths, default=np.inf), 1 - min((float(shown.mean()) for shown in seen), default=1.0)

    @cached_property
    def apart(self) -> np.ndarray:
        """[T, C], m: controllers from the nearest point of the object that is seen; in frame 0 from all nodes."""
        seen = self.observations
        apart = np.full(seen.controller_points.shape[:2], np.inf)
        for frame, own in enumerate(seen.controller_points):
            points = seen.nodes if frame == 0 else seen.object_points[frame, seen.object_visibility[frame]]
            if len(points):
                apart[frame] = cKDTree(points).query(own)[0]
        return apart

    @property
    def meets(self) -> bool:
        """True where hands come near the object: only then is more reported of them."""
        return bool(self.apart.min() <= NO_INTERACTION)


def gap(seen: Observed) -> dict[str, Any]:
    """Least distance of a controller from the object, m."""
    return OF_CONTROLLERS | {"value": float(seen.apart.min())}


def first_gap(seen: Observed) -> dict[str, Any] | None:
    """Least distance of a controller from the object in frame 0, m."""
    return OF_CONTROLLERS | {"value": float(seen.apart[0].min())} if seen.meets else None


def motion_of_hands(seen: Observed) -> dict[str, Any] | None:
    """The farthest motion of controllers, m."""
    points = seen.observations.controller_points
    return OF_CONTROLLERS | {"value": float(np.linalg.norm(points - points[0], axis=2).max())} if seen.meets else None


def speed_of_hands(seen: Observed) -> dict[str, Any] | None:
    """The largest median speed of controllers between two frames, m/s."""
    rate = seen.observations.scenario.frame_rate
    speed = rate * np.median(np.linalg.norm(np.diff(seen.observations.controller_points, axis=0), axis=2), axis=1)
    if not seen.meets or not len(speed):
        return None
    frame = int(speed.argmax())
    return OF_CONTROLLERS | {"value": float(speed.max()), "detail": f"after frame {frame}", "frames": (frame,)}


def leaning(seen: Observed) -> dict[str, Any] | None:
    """Angle, degrees, at which the object hangs at rest beside the vertical through its hands in frame 0."""
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
    """Farthest motion of the object in the training frames, m."""
    moved, lost = seen.motion
    detail = f"its image changes in {seen.moves:.0%} of the training frames, up to {lost:.0%} of its points are lost"
    return {"value": moved, "detail": detail}


def node_count(seen: Observed) -> dict[str, Any]:
    """Structure points."""
    count = len(seen.observations.nodes)
    return {"value": count, "level": "error" if count < 4 else "note" if count > 30 else "warning"}
