"""Followed points to the world: depth lifts a pixel, and cameras that see the same point are averaged."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.capture import Camera, Capture
from neuspring.perception.lift import local_depth

WINDOW, LEAST = 5, 4
"""Side of the window, pixels, whose median depth a point gets, and how many of its pixels must be measured."""


@dataclass(frozen=True, eq=False)
class Lifted:
    """A point in the world."""

    track: np.ndarray
    """[T, 3], m, NaN where no camera has it."""
    apart: np.ndarray
    """Largest distance between cameras [T], m; NaN where fewer than two have it."""


def lift_places(camera: Camera, depth_of: Callable[[int], np.ndarray | None], places: np.ndarray) -> np.ndarray:
    """World points [T, 3], m, of places (x, y) [T, 2]: each at the median depth of a small window; NaN without place or depth.

    `depth_of(frame)` is a depth image [H, W], m, 0 where nothing was measured, or None.
    """
    points = np.full((len(places), 3), np.nan)
    for frame in np.flatnonzero(np.isfinite(places).all(axis=1)):
        x, y = np.clip(np.round(places[frame]).astype(int), 0, (camera.width - 1, camera.height - 1))
        depth = depth_of(int(frame))
        if depth is None:
            continue
        reach = WINDOW // 2
        window = depth[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
        if (window > 0).sum() >= LEAST:
            here = local_depth(depth, depth > 0, np.array([x]), np.array([y]), WINDOW)[0]
            points[frame] = camera.lift(places[frame], here)
    return points


def lift_track(capture: Capture, places: Mapping[str, np.ndarray]) -> Lifted:
    """One point in the world from its places [T, 2] in the images of some cameras: the mean over cameras that have depth there."""
    return join([lift_places(capture.cameras[name], depth_reader(capture, name), own) for name, own in places.items()], capture)


def join(points: Sequence[np.ndarray], capture: Capture) -> Lifted:
    """The mean of points [T, 3] of several cameras, and how far they lie apart."""
    if not points:
        return Lifted(np.full((capture.frame_count, 3), np.nan), np.full(capture.frame_count, np.nan))
    stacked = np.stack(points)
    known = np.isfinite(stacked).all(axis=2)
    total = np.where(known[..., None], stacked, 0.0).sum(axis=0)
    track = np.where(known.any(axis=0)[:, None], total / np.maximum(known.sum(axis=0), 1)[:, None], np.nan)
    pairs = [np.linalg.norm(one - other, axis=1) for one, other in combinations(stacked, 2)]
    apart = np.fmax.reduce(pairs) if pairs else np.full(len(track), np.nan)
    return Lifted(track, apart)


def require_depth(capture: Capture) -> None:
    """Raise InputError for a capture of color alone, whose clicks have no place in the world."""
    if not capture.has_depth:
        rule = "tracks in the world need depth: color alone cannot lift clicks to 3D"
        raise InputError(f"{capture.folder}, depth", rule, "none", "Clicks stay in annotations.json. Masks need no depth.")


def depth_reader(capture: Capture, camera: str) -> Callable[[int], np.ndarray | None]:
    """Depth images of a camera by frame; None where it has none."""

    def read(frame: int) -> np.ndarray | None:
        if not capture.has_depth or not capture.has(camera, frame) or not capture.path("depth", camera, frame).exists():
            return None
        return capture.depth(camera, frame)

    return read
