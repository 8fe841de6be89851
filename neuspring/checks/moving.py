"""Points in space from frame to frame: hands, markers on an object or along a line.

A moving point never repeats a position exactly, jumps away for one frame, or swaps positions with another point. In a file that
contains this, a marker was lost, a stream stopped, or labels were exchanged.
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
"""Number of frames before and after a step that it is compared with; up to two other large steps there do not hide it."""
STEP, HELD_STEP = 6.0, 3.0
"""Ratios to the neighboring steps above which a step is not motion: in general, and after a point stood exactly still.

In 350 released recordings, the step of a single marker is at most 4.2 times its neighboring steps. Where samples are missing, all
markers step together, up to 9.9 times as far."""
LEAST, SLOW = 0.01, 0.5
"""Length, m, and speed, m/s, below which a step may be noise."""
HELD = 4
"""Number of frames from which an exactly constant position is examined."""
EXCHANGED, REORDERED = 0.5, 0.1
"""Labels were exchanged if the best order reduces the steps to less than EXCHANGED times. Points have no order if this happens in
more than REORDERED of the frames."""
ORDER = "Write each point at the same index in all frames, or remove these frames."
MAX_STRETCH = 0.5
"""Two neighbors separate if one moves by more than this fraction of their distance."""
MANY = 4
"""Smallest number of points for which a common motion is computed."""
FRAMES_AROUND, NAMED = 50, 3
"""Number of frames in which neighbors are searched, and number of entries in a message."""


def steps(points: np.ndarray, of: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Distances [T, K], m, from the previous visible position of each point to `of`, and the number of frames [T, K] since then.

    points and `of` (default: points) are [T, K, 3], m; NaN: not visible. A distance is NaN if the point was not visible before.
    """
    now = np.arange(len(points))[:, None]
    frames = np.maximum.accumulate(np.where(np.isfinite(points).all(axis=2), now, -1), axis=0)
    before = np.pad(frames, ((1, 0), (0, 0)), constant_values=-1)[:-1]
    there = np.take_along_axis(points, np.maximum(before, 0)[..., None], axis=0)
    away = np.linalg.norm((points if of is None else of) - there, axis=2)
    return np.where(before < 0, np.nan, away), now - before


def no_places(given: np.ndarray) -> np.ndarray:
    """[T, K] bool: entries of points [T, K, 3] that are not positions.

    An entry with three equal coordinates (such as zeros) or an exactly repeated value is not a position if it is far from the
    point's positions before and after.
    """
    seen = np.isfinite(given).all(axis=2)
    _, which, counts = np.unique(given[seen], axis=0, return_inverse=True, return_counts=True)
    equal = (given == given[..., :1]).all(axis=2)
    repeated = equal.copy()
    repeated[seen] |= (counts > 1)[which.ravel()]
    unique = np.where(repeated[..., None], np.nan, given)
    away, gap = steps(unique)
    usual = np.nanquantile(np.append(away / gap, 0.0), 0.95)
    sides = [steps(unique, given), [values[::-1] for values in steps(unique[::-1], given[::-1])]]
    far = [np.isnan(away) | (away > np.maximum(LEAST, usual * np.maximum(STEP, gap))) for away, gap in sides]
    # If the point is visible on one side only, a repeated value may be its held position.
    known = np.isfinite([away for away, _ in sides]).sum(axis=0) > np.where(equal, 0, 1)
    result: np.ndarray = repeated & np.all(far, axis=0) & known
    # A value that is not a position in one frame is not a position anywhere, even in the middle of a long gap.
    result[seen] = np.isin(which.ravel(), which.ravel()[result[seen]])
    return result


def usual_speeds(speed: np.ndarray) -> np.ndarray:
    """[T, K], m/s: third largest `speed` [T, K] within AROUND frames; for fewer than three values the 95th percentile of all."""
    windows = sliding_window_view(np.pad(speed, ((AROUND, AROUND), (0, 0)), constant_values=np.nan), 2 * AROUND + 1, axis=0)
    count = np.isfinite(windows).sum(axis=2)
    third = np.take_along_axis(np.sort(windows), np.maximum(count - 3, 0)[..., None], axis=2)[..., 0]
    finite = np.append(speed[np.isfinite(speed)], 0.0)
    return np.maximum(np.where(count < 3, np.quantile(finite, 0.95), third), max(np.median(finite), SLOW / 10))


class Moving:
    """Trajectories of points `given` [T, K, 3], m, NaN where not visible, at `rate` frames per second.

    Arrays [T, K] per frame and point:

    - lost: True if the entry is not a position (`no_places`); `points` [T, K, 3] are `given` with NaN there
    - away, gap: distance, m, from the previous visible position, and the number of frames since then
    - speed, around: speed, m/s, of the step and of the neighboring steps (`usual_speeds`)
    - large: True if the step is not noise

    `together` [T, 1] is the median ratio of large steps to neighboring steps over all points; 0 for fewer than MANY points.
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
        """(point, first frame, last frame) of each exactly constant position that ends with a jump, or that a neighbor leaves."""
        entries = []
        for point in range(self.points.shape[1]):
            at = np.flatnonzero(np.isfinite(self.points[:, point]).all(axis=1))
            changes = np.flatnonzero((np.diff(self.points[at, point], axis=0) != 0).any(axis=1)) + 1
            runs = [run for run in np.split(at, changes) if len(run) >= HELD]
            entries += [(point, int(run[0]), int(run[-1])) for run in runs if self._ends(point, run, at[at > run[-1]])]
        return entries

    def _ends(self, point: int, run: np.ndarray, after: np.ndarray) -> bool:
        """True if the constant position in the frames `run` ends with a jump, or at the end of the data the nearest point left."""
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
        """(frame, points, sum of steps as given, sum in the best order), sums in m, for each exchange of positions."""
        exchanges, far = [], self.away > LEAST
        for frame in np.flatnonzero(far.sum(axis=1) > 1).tolist():
            some = np.flatnonzero(far[frame])
            there, here = self.points[frame - self.gap[frame, some], some], self.points[frame, some]
            cost = np.linalg.norm(there[:, None] - here, axis=2)
            order = linear_sum_assignment(cost)[1]
            moved = np.flatnonzero(order != np.arange(len(some)))
            given, best = cost[moved, moved].sum(), cost[moved, order[moved]].sum()
            if best < EXCHANGED * given:
                exchanges.append((frame, some[moved], given, best))
        return exchanges

    @cached_property
    def stepped(self) -> np.ndarray:
        """[T, K] bool: steps far larger than neighboring steps and than the other points' steps, without another explanation."""
        result = np.asarray(self.large & (self.speed > STEP * self.around * np.maximum(self.together, 1.0)))
        for frame, group, *_ in self.swapped:
            result[frame, group] = False
        for point, _, last in self.held:
            result[last + 1 :, point][: np.argmax(np.append(self.large[last + 1 :, point], True)) + 1] = False
        return result


def apart(points: np.ndarray, of: Callable[..., np.ndarray]) -> np.ndarray:
    """Distances [K, K], m, of points [T, K, 3], reduced over frames by `of` (np.nanmax, np.nanmedian); 0: never both visible."""
    some = points[np.unique(np.linspace(0, len(points) - 1, FRAMES_AROUND).astype(int))]
    distances = np.array([np.linalg.norm(at[:, None] - at, axis=2) for at in some])
    return of(np.where(np.isfinite(distances).any(axis=0), distances, 0.0), axis=0)


def spanned(distances: np.ndarray) -> np.ndarray:
    """Pairs [P, 2] of the minimum spanning tree of points with distances [K, K]."""
    return np.transpose(minimum_spanning_tree(distances).nonzero())


def _words(entries: Sequence[tuple[int, int, str]]) -> dict[str, Any] | None:
    """Words of a finding about (point, frame, text) entries; None without entries."""
    text = listed((f"point {point} {what}" for point, _, what in entries), NAMED)
    return {"value": len(entries), "detail": text, "frames": sorted({frame for _, frame, _ in entries})} if entries else None


def lost(moving: Moving) -> dict[str, Any] | None:
    """Entries that are not positions."""
    before = np.pad(moving.lost, ((1, 0), (0, 0)))[:-1]
    begins = np.argwhere((moving.lost & ~before).T).tolist()
    words = _words([(k, t, f"from frame {t} on is {moving.given[t, k].tolist()}") for k, t in begins])
    return words and words | {"frames": np.flatnonzero(moving.lost.any(axis=1))}


def held(moving: Moving) -> dict[str, Any] | None:
    """Positions that stay exactly constant."""
    return _words([(point, first, f"from frame {first} to {last}") for point, first, last in moving.held])


def swapped(moving: Moving) -> dict[str, Any] | None:
    """Points that exchange their positions; an error if the order changes often."""
    words = _words([(point, frame, f"in frame {frame}") for frame, group, *_ in moving.swapped for point in group])
    if words and len(moving.swapped) > max(REORDERED * len(moving.given), NAMED):
        _, _, given, best = zip(*moving.swapped, strict=True)
        times = f"steps are {sum(given) / max(sum(best), LEAST):.2g} times as large as in the best order"
        words |= {"level": "error", "detail": f"in frames {spans(words['frames'])}; {times}"}
    return words


def stepped(moving: Moving) -> dict[str, Any] | None:
    """Jumps of single points."""
    cm, speed = 100 * moving.away, moving.speed
    at = np.argwhere(moving.stepped).tolist()
    return _words([(k, t, f"in frame {t} by {cm[t, k]:.1f} cm, {speed[t, k]:.2g} m/s") for t, k in at])
