"""Points in space from frame to frame: hands, markers on an object or along a line.

Nothing that moves is anywhere twice to the bit, leaves its place for a frame, or changes places with another. Where a file says so,
a marker was lost, a stream stood still, or labels were exchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import minimum_spanning_tree

from neuspring.core.text import listed, spans

AROUND = 4
"""Frames before and after a step with which it is compared; up to two more large steps there do not hide it."""
STEP, HELD_STEP = 6.0, 3.0
"""Steps so many times as large as those around are no motion: of a point, after it stood still to the bit.
In 350 released recordings one marker steps at most 4.2 times as far as around. Some of them lack samples: there all step
together, up to 9.9 times as far."""
LEAST, SLOW = 0.01, 0.5
"""m and m/s: smaller and slower steps may be noise."""
HELD = 4
"""Frames from which a place that stays equal to the bit is looked at."""
EXCHANGED, REORDERED = 0.5, 0.1
"""Steps after an exchange of labels, as a part of those before it, that show that they were exchanged; and the part of the frames
with an exchange from which points have no order."""
ORDER = "Write each point at the same index in all frames, or leave the frames out."
MAX_STRETCH = 0.5
"""Change of the distance of two neighbors, as a fraction of it, by which one of them left the other."""
MANY = 4
"""Points from which there is a motion of all."""
FRAMES_AROUND, NAMED = 50, 3
"""Frames in which neighbors are looked for, and places that a message names."""


def steps(points: np.ndarray, of: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Distances [T, K], m, of each place `of` [T, K, 3] (the points themselves) from where its point was last seen, NaN where it
    was not; and how many frames ago that was."""
    now = np.arange(len(points))[:, None]
    frames = np.maximum.accumulate(np.where(np.isfinite(points).all(axis=2), now, -1), axis=0)
    before = np.pad(frames, ((1, 0), (0, 0)), constant_values=-1)[:-1]
    there = np.take_along_axis(points, np.maximum(before, 0)[..., None], axis=0)
    away = np.linalg.norm((points if of is None else of) - there, axis=2)
    return np.where(before < 0, np.nan, away), now - before


def no_places(given: np.ndarray) -> np.ndarray:
    """[T, K] bool: entries of points [T, K, 3] that are no places: zeros, other equal coordinates, or a value that is there several
    times to the bit, far from where the point is seen before and after."""
    seen = np.isfinite(given).all(axis=2)
    _, which, counts = np.unique(given[seen], axis=0, return_inverse=True, return_counts=True)
    equal = (given == given[..., :1]).all(axis=2)
    repeated = equal.copy()
    repeated[seen] |= (counts > 1)[which.ravel()]
    others = np.where(repeated[..., None], np.nan, given)
    away, gap = steps(others)
    usual = np.nanquantile(np.append(away / gap, 0.0), 0.95)
    sides = [steps(others, given), [one[::-1] for one in steps(others[::-1], given[::-1])]]
    far = [np.isnan(away) | (away > np.maximum(LEAST, usual * np.maximum(STEP, gap))) for away, gap in sides]
    # Where the point is seen on one side alone, the value may be its place, held.
    known = np.isfinite([away for away, _ in sides]).sum(axis=0) > np.where(equal, 0, 1)
    found: np.ndarray = repeated & np.all(far, axis=0) & known
    # What is no place in one frame is none in the middle of a long gap.
    found[seen] = np.isin(which.ravel(), which.ravel()[found[seen]])
    return found


def usual_speeds(speed: np.ndarray) -> np.ndarray:
    """[T, K], m/s: the third largest of `speed` [T, K] within AROUND frames, where there are three, else a high one of all."""
    windows = sliding_window_view(np.pad(speed, ((AROUND, AROUND), (0, 0)), constant_values=np.nan), 2 * AROUND + 1, axis=0)
    count = np.isfinite(windows).sum(axis=2)
    third = np.take_along_axis(np.sort(windows), np.maximum(count - 3, 0)[..., None], axis=2)[..., 0]
    finite = np.append(speed[np.isfinite(speed)], 0.0)
    return np.maximum(np.where(count < 3, np.quantile(finite, 0.95), third), max(np.median(finite), SLOW / 10))


class Moving:
    """Trajectories of points `given` [T, K, 3], m, NaN where not seen, at `rate` frames per second.

    Of each frame and point, [T, K]: `lost` where an entry is no place (then `points` has NaN too); the distance `away`, m, from
    where it was last seen, `gap` frames before; its `speed` and that `around`, m/s; `large` where a step is no noise. `together`
    [T, 1] is how many times as far as around all points step; 0 where there are few.
    """

    def __init__(self, given: np.ndarray, rate: float) -> None:
        self.given, self.rate, self.lost = given, rate, no_places(given)
        self.points = np.where(self.lost[..., None], np.nan, given)
        self.away, self.gap = steps(self.points)
        self.speed = self.away * rate / self.gap
        self.around = usual_speeds(self.speed)
        self.large = (self.away > LEAST) & (self.speed > SLOW)
        factors = np.ma.masked_invalid(self.speed / self.around) * self.large
        many = given.shape[1] >= MANY
        self.together = np.ma.median(factors, axis=1, keepdims=True).filled(0.0) if many else np.zeros((len(given), 1))

    @cached_property
    def held(self) -> list[tuple[int, int, int]]:
        """Point, first and last frame of each time in which it stays equal to the bit, and then steps or is left behind."""
        found = []
        for point in range(self.points.shape[1]):
            at = np.flatnonzero(np.isfinite(self.points[:, point]).all(axis=1))
            changes = np.flatnonzero((np.diff(self.points[at, point], axis=0) != 0).any(axis=1)) + 1
            runs = [run for run in np.split(at, changes) if len(run) >= HELD]
            found += [(point, int(run[0]), int(run[-1])) for run in runs if self._ends(point, run, at[at > run[-1]])]
        return found

    def _ends(self, point: int, run: np.ndarray, after: np.ndarray) -> bool:
        """True where a place that was held in the frames `run` ends with a step; or, at the end of all, is left by the nearest."""
        then = self.points[run[0]]
        went = np.linalg.norm(self.points[run[-1]] - then, axis=1)
        if len(after):
            far = self.large[after[0], point] and self.speed[after[0], point] > HELD_STEP * self.around[after[0], point]
            return bool(far and (run[0] or np.nanmax(went) > 0))
        near = np.linalg.norm(then - then[point], axis=1) + 0 * went
        near[point] = np.inf
        other = np.nanargmin(near)
        return bool(run[0] and went[other] > max(LEAST, MAX_STRETCH * near[other]))

    @cached_property
    def swapped(self) -> list[tuple[int, np.ndarray, float, float]]:
        """Frames in which points exchange their places, the points, and the length of steps, m, as given and in the best order."""
        found, far = [], self.away > LEAST
        for frame in np.flatnonzero(far.sum(axis=1) > 1).tolist():
            some = np.flatnonzero(far[frame])
            there, here = self.points[frame - self.gap[frame, some], some], self.points[frame, some]
            cost = np.linalg.norm(there[:, None] - here, axis=2)
            order = linear_sum_assignment(cost)[1]
            moved = np.flatnonzero(order != np.arange(len(some)))
            given, best = cost[moved, moved].sum(), cost[moved, order[moved]].sum()
            if best < EXCHANGED * given:
                found.append((frame, some[moved], given, best))
        return found

    @cached_property
    def stepped(self) -> np.ndarray:
        """[T, K] bool: steps far beyond those around and those of the others, that nothing else explains."""
        found = np.asarray(self.large & (self.speed > STEP * self.around * np.maximum(self.together, 1.0)))
        for frame, group, *_ in self.swapped:
            found[frame, group] = False
        for point, _, last in self.held:
            found[last + 1 :, point][: np.argmax(np.append(self.large[last + 1 :, point], True)) + 1] = False
        return found


def apart(points: np.ndarray, of: Callable[..., np.ndarray]) -> np.ndarray:
    """The largest (np.nanmax) or median distance [K, K], m, of each two points [T, K, 3] in some frames; 0 where none sees both."""
    some = points[np.unique(np.linspace(0, len(points) - 1, FRAMES_AROUND).astype(int))]
    distances = np.array([np.linalg.norm(at[:, None] - at, axis=2) for at in some])
    return of(np.where(np.isfinite(distances).any(axis=0), distances, 0.0), axis=0)


def spanned(distances: np.ndarray) -> np.ndarray:
    """Pairs [P, 2] of the shortest tree that joins points by their distances [K, K]."""
    return np.transpose(minimum_spanning_tree(distances).nonzero())


def told(entries: Sequence[tuple[int, int, str]]) -> dict[str, Any] | None:
    """Words about points and frames; their number is the value."""
    text = listed((f"point {point} {what}" for point, _, what in entries), NAMED)
    return {"value": len(entries), "detail": text, "frames": sorted({frame for _, frame, _ in entries})} if entries else None


def lost(moving: Moving) -> dict[str, Any] | None:
    """Entries that are no places."""
    before = np.pad(moving.lost, ((1, 0), (0, 0)))[:-1]
    begins = np.argwhere((moving.lost & ~before).T).tolist()
    words = told([(k, t, f"from frame {t} on is {moving.given[t, k].tolist()}") for k, t in begins])
    return words and words | {"frames": np.flatnonzero(moving.lost.any(axis=1))}


def held(moving: Moving) -> dict[str, Any] | None:
    """Places that were held."""
    return told([(point, first, f"from frame {first} to {last}") for point, first, last in moving.held])


def swapped(moving: Moving) -> dict[str, Any] | None:
    """Points that exchange their places; an error where their order changes often."""
    words = told([(point, frame, f"in frame {frame}") for frame, group, *_ in moving.swapped for point in group])
    if words and len(moving.swapped) > max(REORDERED * len(moving.given), NAMED):
        _, _, given, best = zip(*moving.swapped, strict=True)
        times = f"steps {sum(given) / max(sum(best), LEAST):.2g} times those in the best order"
        words |= {"level": "error", "detail": f"in frames {spans(words['frames'])}; {times}"}
    return words


def stepped(moving: Moving) -> dict[str, Any] | None:
    """Steps of single points."""
    cm, speed = 100 * moving.away, moving.speed
    at = np.argwhere(moving.stepped).tolist()
    return told([(k, t, f"in frame {t} by {cm[t, k]:.1f} cm, {speed[t, k]:.2g} m/s") for t, k in at])
