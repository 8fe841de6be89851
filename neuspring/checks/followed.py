"""Points that were followed through the video of one camera, with its masks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from neuspring.checks.masks import FEWEST_STEPS, LOOKED, MASK_RIM, OFTEN, STIRRED, motions
from neuspring.core.checks import Check
from neuspring.data.capture import OBJECT, Capture

COVERED_SHARE = 0.15
"""Share of the object's moving pixels with a followed point nearby; 0.16 at least in the synthetic scenes."""
SPACING = 3.0
"""Nearby, as a multiple of the mean distance of points in frame 0."""
FEWEST_TRACKS = 50
"""Points on the object in frame 0."""
FOLLOWED = 0.1
"""Share of the points of frame 0 that are still followed."""


@dataclass(frozen=True, eq=False)
class Tracked:
    """Tracks of one camera."""

    capture: Capture
    camera: str
    labels: np.ndarray
    """[T, H, W]."""
    pixels: np.ndarray
    """[T, Q, 2]."""
    visible: np.ndarray
    """[T, Q] bool."""

    @cached_property
    def own(self) -> np.ndarray:
        """[Q] bool: points on the object in frame 0."""
        x, y = np.round(self.pixels[0]).astype(int).T
        return np.asarray(self.labels[0][y, x] == OBJECT)

    @cached_property
    def few(self) -> dict[str, Any] | None:
        """Frames in which few points are followed."""
        return few(self.visible[:, self.own], FOLLOWED) if self.own.any() else None

    def covered(self) -> dict[int, float]:
        """Frames in which a part of the object moves -> how much of that part has a followed point nearby."""
        shares, pixels, visible = {}, self.pixels[:, self.own], self.visible[:, self.own]
        for motion in motions(self.capture, self.camera, self.labels):
            body = motion.labels[0] == OBJECT
            own, scale = motion.moving & body, body.shape[1] / self.labels.shape[2]
            if own.sum() <= STIRRED * body.sum():
                continue
            spacing = scale * np.sqrt((self.labels[0] == OBJECT).sum() / visible.shape[1])
            empty, places = np.ones(body.shape, np.uint8), scale * pixels[motion.frame, visible[motion.frame]]
            x, y = np.clip(np.round(places).astype(int), 0, np.array(body.shape[::-1]) - 1).T
            empty[y, x] = 0
            away = cv2.distanceTransform(empty, cv2.DIST_L2, 5) if len(x) else np.full(body.shape, np.inf)
            shares[motion.frame] = float((away[own] <= max(SPACING * spacing, MASK_RIM * body.shape[1])).mean())
        return shares


def few(visible: np.ndarray, least: float) -> dict[str, Any] | None:
    """The least share of points [T, n] that are visible in a frame, and the frames with fewer than `least`; None without such."""
    alive = visible.mean(axis=1)
    low = np.flatnonzero(alive < least).tolist()
    told = {"value": float(alive.min()), "frame": int(alive.argmin()), "count": len(low), "frames": low, "least": least}
    return told | {"first": low[0], "often": len(low) >= OFTEN * len(visible)} if low else None


def lost(tracked: Tracked) -> dict[str, Any] | None:
    """Frames in which few points of the object are followed; rare ones are a note."""
    return tracked.few and tracked.few | {"level": "warning" if tracked.few["often"] else "note"}


def lost_where_it_moves(tracked: Tracked) -> dict[str, Any] | None:
    """Frames in which the moving part of the object has few followed points, where that is not said otherwise."""
    if tracked.own.sum() < FEWEST_TRACKS or (tracked.few and tracked.few["often"]):
        return None
    bare = [frame for frame, share in tracked.covered().items() if share < COVERED_SHARE]
    return {"value": len(bare), "first": bare[0], "frames": bare} if len(bare) >= max(FEWEST_STEPS, OFTEN * LOOKED) else None


TRACKS_REMEDY = "Look at tracks.png; end the capture before frame {first}, use more light or shorter exposures, or cotracker3."
# fmt: off
checks = (
    Check("few tracks", "tracks", lambda tracked: int(tracked.own.sum()) or None, (FEWEST_TRACKS, np.inf), "warning",
          "{value} points are followed on the object; at least {low} are expected.",
          "Film from nearer by, or raise points of perception.track."),
    Check("tracks lost", "tracks", lost, None, "warning",
          "{value:.0%} of the object's points are followed in frame {frame}; few in {count} frames; at least {least:.0%} are "
          "expected in every frame.", TRACKS_REMEDY),
    Check("tracks lost where it moves", "tracks", lost_where_it_moves, None, "warning",
          f"in {{value}} of {LOOKED} frames that were looked at, first in frame {{first}}, the part of the object that moves has "
          f"followed points on less than {COVERED_SHARE:.0%} of it; points that stand still alone teach no motion.", TRACKS_REMEDY),
)
