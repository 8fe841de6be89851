"""Points in space from frame to frame: hands, markers on an object, markers along a cable.

Nothing that moves is anywhere twice to the bit, leaves its place for a frame, or changes places with another. Where a file says so,
a marker was lost, a stream stood still, or labels were exchanged.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import minimum_spanning_tree

from neuspring.core.checks import Check

AROUND = 4
"""Frames before and after a step with which it is compared; up to two more large steps there do not hide it."""
STEP, HELD_STEP, TOGETHER = 6.0, 3.0, 4.0
"""Steps so many times as large as those around are no motion: of a point, after it stood still to the bit, of all points together.
In 350 released recordings of cables one marker steps at most 4.2 times as far as around. Some of them lack samples: there all step
together, up to 9.9 times as far."""
LEAST, SLOW = 0.01, 0.5
"""m and m/s: smaller and slower steps may be noise."""
HELD = 4
"""Frames from which a place that stays equal to the bit is looked at."""
EXCHANGED = 0.5
"""Steps after an exchange of labels, as a part of those before it, that show that they were exchanged."""
STEADY, MAX_STRETCH, CHANGED = 0.1, 0.5, 0.02
"""Distances of neighbors that vary by less than STEADY of their median, between the quintiles, are kept by what carries them. One
that changes by more than MAX_STRETCH and CHANGED, m, is wrong. Released cables change by 0.37 of it or by 1.3 cm at most."""
MANY = 4
"""Points from which there is a motion of all."""
PAUSE = 0.25
"""s. Where so much time is missing, a twin learns another motion."""
LOOKED, NAMED = 50, 3
"""Frames in which neighbors are looked for, and places that a message names."""


def last_seen(seen: np.ndarray) -> np.ndarray:
    """[T, K]: the last earlier frame in which each point is seen; -1: none. `seen` is [T, K] bool."""
    frames = np.where(seen, np.arange(len(seen))[:, None], -1)
    return np.concatenate([np.full((1, seen.shape[1]), -1), np.maximum.accumulate(frames, axis=0)[:-1]])


def steps(points: np.ndarray, of: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Distances [T, K], m, of each place `of` [T, K, 3] (the points themselves) from where its point was last seen, NaN where it
    was not; and how many frames ago that was."""
    before = last_seen(np.isfinite(points).all(axis=2))
    there = np.take_along_axis(points, np.maximum(before, 0)[..., None], axis=0)
    away = np.linalg.norm((points if of is None else of) - there, axis=2)
    return np.where(before < 0, np.nan, away), np.arange(len(points))[:, None] - before


def typical(values: np.ndarray) -> np.ndarray:
    """The median [T, 1] of what is finite in each row; 0 where nothing is."""
    known = np.isfinite(values).any(axis=1, keepdims=True)
    return np.asarray(np.nanmedian(np.where(known, values, 0.0), axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class Moving:
    """Trajectories of points."""

    given: np.ndarray
    """[T, K, 3], m, NaN where not seen."""
    rate: float
    """Frames per second."""

    @cached_property
    def lost(self) -> np.ndarray:
        """[T, K] bool: entries that are no places: zeros, other equal coordinates, or a value that is there several times to the
        bit, far from where the point is seen before and after."""
        seen = np.isfinite(self.given).all(axis=2)
        _, which, counts = np.unique(self.given[seen], axis=0, return_inverse=True, return_counts=True)
        equal = (self.given == self.given[..., :1]).all(axis=2)
        repeated = equal.copy()
        repeated[seen] |= (counts > 1)[which.ravel()]
        others = np.where(repeated[..., None], np.nan, self.given)
        away, gap = steps(others)
        usual = np.nanquantile(np.append(away / gap, 0.0), 0.95)
        sides = [steps(others, self.given), [one[::-1] for one in steps(others[::-1], self.given[::-1])]]
        far = [np.isnan(away) | (away > np.maximum(LEAST, usual * np.maximum(STEP, gap))) for away, gap in sides]
        # Where the point is seen on one side alone, the value may be its place, held.
        known = np.isfinite([away for away, _ in sides]).sum(axis=0) > np.where(equal, 0, 1)
        found = repeated & np.all(far, axis=0) & known
        # What is no place in one frame is none in the middle of a long gap.
        found[seen] = np.isin(which.ravel(), which.ravel()[found[seen]])
        return found

    @cached_property
    def points(self) -> np.ndarray:
        """[T, K, 3], m, NaN where lost too."""
        return np.where(self.lost[..., None], np.nan, self.given)

    @cached_property
    def away(self) -> np.ndarray:
        """[T, K], m, from the place where each was last seen."""
        return steps(self.points)[0]

    @cached_property
    def gap(self) -> np.ndarray:
        """[T, K]: how many frames ago that was."""
        return steps(self.points)[1]

    @cached_property
    def speed(self) -> np.ndarray:
        """[T, K], m/s."""
        return self.away * self.rate / self.gap

    @cached_property
    def around(self) -> np.ndarray:
        """[T, K], m/s: the third largest speed within AROUND frames, where there are three, else a high one of all."""
        edge = np.full((AROUND, self.speed.shape[1]), np.nan)
        windows = np.sort(sliding_window_view(np.concatenate([edge, self.speed, edge]), 2 * AROUND + 1, axis=0))
        count = np.isfinite(windows).sum(axis=2)
        third = np.take_along_axis(windows, np.maximum(count - 3, 0)[..., None], axis=2)[..., 0]
        finite = np.append(self.speed[np.isfinite(self.speed)], 0.0)
        return np.maximum(np.where(count < 3, np.quantile(finite, 0.95), third), max(np.median(finite), SLOW / 10))

    @cached_property
    def large(self) -> np.ndarray:
        """[T, K] bool: steps that are no noise."""
        return (self.away > LEAST) & (self.speed > SLOW)

    @cached_property
    def together(self) -> np.ndarray:
        """[T]: the factor by which the points together step farther than around; 0: not at all."""
        if self.points.shape[1] < MANY:
            return np.zeros(len(self.points))
        middle = typical(np.where(np.isfinite(self.speed), self.large * self.speed / self.around, np.nan))[:, 0]
        return np.where(middle > TOGETHER, middle, 0.0)

    @cached_property
    def held(self) -> list[tuple[int, int, int]]:
        """Point, first and last frame of each time in which it stays equal to the bit, and then steps or is left behind."""
        found = []
        for point in range(self.points.shape[1]):
            at = np.flatnonzero(np.isfinite(self.points[:, point]).all(axis=1))
            changes = np.flatnonzero((np.diff(self.points[at, point], axis=0) != 0).any(axis=1)) + 1
            for run in np.split(at, changes):
                if len(run) < HELD:
                    continue
                after = at[at > run[-1]][:1]
                if self._stepped(run, after[0], point) if len(after) else self._left(run, point):
                    found.append((point, int(run[0]), int(run[-1])))
        return found

    def _stepped(self, run: np.ndarray, after: int, point: int) -> bool:
        """True where a point steps in frame `after`, and it or others moved before that."""
        if not self.large[after, point] or self.speed[after, point] <= HELD_STEP * self.around[after, point]:
            return False
        return bool(run[0] or np.nanmax(self.away[run[0] + 1 : run[-1] + 1], initial=0.0) > 0)

    def _left(self, run: np.ndarray, point: int) -> bool:
        """True where a point stands still to the end, and what was nearest to it goes away."""
        near = np.linalg.norm(self.points[run[0]] - self.points[run[0], point], axis=1)
        went = np.linalg.norm(self.points[run[-1]] - self.points[run[0]], axis=1)
        near[point] = np.nan
        if not run[0] or not np.isfinite(near + went).any():
            return False
        other = np.nanargmin(near + 0 * went)
        return bool(went[other] > max(LEAST, MAX_STRETCH * near[other]))

    @cached_property
    def swapped(self) -> dict[tuple[int, ...], list[int]]:
        """Points that exchange their places -> the frames in which they do."""
        doubtful = (self.away > LEAST) & ((self.speed > HELD_STEP * self.around) | (self.gap > 1))
        found: dict[tuple[int, ...], list[int]] = {}
        for frame in np.flatnonzero(doubtful.sum(axis=1) > 1):
            some = np.flatnonzero(doubtful[frame])
            there, here = self.points[frame - self.gap[frame, some], some], self.points[frame, some]
            cost = np.linalg.norm(there[:, None] - here, axis=2)
            order = linear_sum_assignment(cost)[1]
            moved = np.flatnonzero(order != np.arange(len(some)))
            if len(moved) and cost[moved, order[moved]].sum() < EXCHANGED * cost[moved, moved].sum():
                found.setdefault(tuple(some[moved].tolist()), []).append(int(frame))
        return found

    @cached_property
    def stepped(self) -> np.ndarray:
        """[T, K] bool: steps far beyond those around and those of the others, that nothing else explains."""
        usual = self.around
        if self.points.shape[1] >= MANY:
            usual = np.maximum(usual, typical(self.speed))
        found = self.large & (self.speed > STEP * usual)
        for group, frames in self.swapped.items():
            found[np.ix_(frames, group)] = False
        for point, _, last in self.held:
            found[last + 1 :, point][: np.argmax(np.append(self.large[last + 1 :, point], True)) + 1] = False
        return found

    @cached_property
    def links(self) -> np.ndarray:
        """Pairs [P, 2] of neighbors, by their usual distances."""
        return spanned(apart(self.points, 0.5))

    def strained(self) -> dict[str, Any] | None:
        """The largest change of a steady distance of neighbors, as a part of its median, that nothing else explains."""
        named = {point for group in self.swapped for point in group} | {point for point, *_ in self.held}
        named |= set(np.flatnonzero(self.stepped.any(axis=0)).tolist())
        links = np.array([link for link in self.links.tolist() if not named & set(link)]).reshape(-1, 2)
        if not links.size:
            return None
        lengths = np.linalg.norm(self.points[:, links[:, 0]] - self.points[:, links[:, 1]], axis=2)
        low, middle, high = np.nanquantile(lengths, (0.2, 0.5, 0.8), axis=0)
        change = np.where((high - low < STEADY * middle) & (np.abs(lengths - middle) > CHANGED), np.abs(lengths / middle - 1), 0.0)
        frame, link = (int(i) for i in np.unravel_index(int(np.nan_to_num(change).argmax()), change.shape))
        told = {"value": float(np.nan_to_num(change).max()), "length": lengths[frame, link], "median": middle[link]}
        return told | {"frame": frame, "one": links[link, 0], "two": links[link, 1], "frames": (frame,)}


def apart(points: np.ndarray, quantile: float) -> np.ndarray:
    """A quantile over frames of the distances [K, K], m, of each two points [T, K, 3]; 0 where no frame sees both."""
    some = points[np.unique(np.linspace(0, len(points) - 1, LOOKED).astype(int))]
    distances = np.array([np.linalg.norm(at[:, None] - at, axis=2) for at in some])
    return np.asarray(np.nanquantile(np.where(np.isfinite(distances).any(axis=0), distances, 0.0), quantile, axis=0))


def spanned(distances: np.ndarray) -> np.ndarray:
    """Pairs [P, 2], lower first, of the shortest tree that joins points by their distances [K, K]."""
    return np.sort(np.transpose(minimum_spanning_tree(distances).nonzero()), axis=1)


def listed(entries: Iterable[tuple[int, str]]) -> str:
    """Points and what happens to them, as far as a message names them."""
    every = list(entries)
    more = f" and {len(every) - NAMED} more" if len(every) > NAMED else ""
    return "; ".join(f"point {point} {what}" for point, what in islice(every, NAMED)) + more


def lost(moving: Moving) -> dict[str, Any] | None:
    """Entries that are no places."""
    if not moving.lost.any():
        return None
    points = np.flatnonzero(moving.lost.any(axis=0)).tolist()
    frames = {point: np.flatnonzero(moving.lost[:, point]) for point in points}
    values = {point: moving.given[at[0], point].tolist() for point, at in frames.items()}
    text = listed((point, f"is {values[point]} in {len(at)} frames, first {at[0]}") for point, at in frames.items())
    return {"value": int(moving.lost.sum()), "text": text, "frames": np.flatnonzero(moving.lost.any(axis=1))}


def never_seen(moving: Moving) -> list[dict[str, Any]]:
    """Points with one value in all frames that is no place: equal coordinates, or that of another point; while others move."""
    given = moving.given
    still = ((given == given[0]) | ~np.isfinite(given)).all(axis=(0, 2)) & np.isfinite(given[0]).all(axis=1)
    if not (np.abs(np.nan_to_num(given - given[0])) > LEAST).any():
        return []
    values, which, counts = np.unique(given[0, still], axis=0, return_inverse=True, return_counts=True)
    no_place = (counts > 1) | (values == values[:, :1]).all(axis=1)
    points = np.flatnonzero(still)[no_place[which.ravel()]]
    return [{"value": int(point), "place": given[0, point].tolist()} for point in points]


def held(moving: Moving) -> dict[str, Any] | None:
    """Points that stay equal to the bit, and then step or are left behind."""
    text = listed((point, f"from frame {first} to {last}") for point, first, last in moving.held)
    longest = max((last - first + 1 for _, first, last in moving.held), default=0)
    return {"value": longest, "text": text, "frames": sorted({first for _, first, _ in moving.held})} if longest else None


def swapped(moving: Moving) -> list[dict[str, Any]]:
    """Points whose labels are exchanged from a frame on."""
    return [{"points": " and ".join(map(str, group)), "value": at[0], "frames": at} for group, at in moving.swapped.items()]


def stepped(moving: Moving) -> dict[str, Any] | None:
    """Steps of single points."""
    at = np.argwhere(moving.stepped)
    if not len(at):
        return None
    words = [(point, f"in frame {t} by {100 * moving.away[t, point]:.1f} cm, {moving.speed[t, point]:.2g} m/s") for t, point in at]
    largest = float((moving.speed / moving.around)[moving.stepped].max())
    return {"value": largest, "text": listed(words), "frames": np.unique(at[:, 0])}


def together(moving: Moving) -> dict[str, Any] | None:
    """Steps of all points together."""
    frames = np.flatnonzero(moving.together)
    told = {last + 1 for _, _, last in moving.held} | {frame for at in moving.swapped.values() for frame in at}
    if not len(frames := np.array([frame for frame in frames if frame not in told], int)):
        return None
    worst = frames[moving.together[frames].argmax()]
    level = "warning" if moving.together[worst] > PAUSE * moving.rate else "note"
    far = {"value": float(moving.together[worst]), "cm": 100 * np.nanmedian(moving.away[worst])}
    return far | {"frame": worst, "frames": frames, "level": level}


# fmt: off
checks = (
    Check("lost points as numbers", "moving", lambda moving, _: lost(moving), None, "error",
          "a point that is not seen has no place; received the same value to the bit, far from where the point is: {text}. {1}",
          title=""),
    Check("point never seen", "moving", lambda moving, _: never_seen(moving), None, "warning",
          "point {value} is {place} in every frame while others move. If it was never seen, leave it out", title=""),
    Check("held value", "moving", lambda moving, _: held(moving), None, "warning",
          "a place that stays equal to the bit, and is then left by a step or by its neighbors, was held; received {text}. Did the "
          "stream stop, or was a gap filled with the last value? {1}", title=""),
    Check("labels swapped", "moving", lambda moving, _: swapped(moving), None, "warning",
          "points {points} change places in frame {value}: exchanged from there on, all their steps are shorter. Exchange the "
          "labels, or leave the frames out", title=""),
    Check("step far beyond the others", "moving", lambda moving, _: stepped(moving), None, "warning",
          f"steps should be less than {STEP:g} times those around; received {{text}}. Another label, a lost marker, or a reflex? "
          "{1}", title=""),
    Check("all points step", "moving", lambda moving, _: together(moving), None, "note",
          "all points step together in frame {frame} by {cm:.1f} cm, {value:.1f} times as far as around: samples are missing, "
          "takes were joined, or a pose was lost", title=""),
    Check("distance out of range", "moving", lambda moving, _: moving.strained(), (0, MAX_STRETCH), "warning",
          "distances of neighbors that are steady should stay within {high:.0%} of their median {median:.3f} m; received "
          "{length:.3f} m between points {one} and {two} in frame {frame}", title=""),
)
