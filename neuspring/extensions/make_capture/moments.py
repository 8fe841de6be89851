"""Which pictures of two sources show the same moment, and whether time passes evenly from one to the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuspring.core.errors import InputError

COMMON = 0.5
"""Numbers in names count the same moments if this part of them is common to both sources."""
MISSING_GAP = 1.5
"""Pictures this many times farther apart than usual have others missing between them."""
DEPARTURE = 1.0
"""Frames. A picture may be this far from where an even clock has it: a lost picture is half of it."""
MISSING_SHARE = 0.05
"""This part of the pictures may be missing."""
JITTER, ROUNDED = 0.1, 0.001
"""Intervals that differ by less than this part and these seconds are one rate: time stamps may be whole milliseconds."""
OVERLAP = 0.5
"""Two cameras' own clocks are one if this part of the shorter series lies within the other."""
PAIRING_REMEDY = (
    "Numbers that each source counts for itself pair nothing. If one only ended early, remove the last pictures of the other. "
    "Else name the images of both by the camera's own frame numbers, or by time stamps (s, ms, us or ns since 1970)."
)


@dataclass(frozen=True, eq=False)
class Series:
    """When the pictures of a source were taken, in their order."""

    numbers: list[int]
    """Number of every picture: that in its name, or its place, from 0."""
    named: bool = False
    """True where they are those in the names."""
    times: np.ndarray | None = None
    """s, ascending; None: unknown."""
    clock: str = ""
    """Start of the times: `wall`, a camera's own (`device`), a file with several tracks, or, empty, the source's first picture."""

    @property
    def _steps(self) -> np.ndarray:
        """s, or numbers, from each picture to the next."""
        return np.diff(self.numbers if self.times is None else self.times)

    @property
    def step(self) -> float:
        """s, or numbers: the usual one."""
        return float(np.median(self._steps)) if len(self.numbers) > 1 else 1.0

    @property
    def whole(self) -> bool:
        """True where no picture is missing in between."""
        return bool((self._steps <= MISSING_GAP * self.step).all())

    @property
    def rate(self) -> float | None:
        """Frames per second: the mean of intervals decides, as time stamps may be whole milliseconds; gaps do not count."""
        if self.times is None or len(self.times) < 2:
            return None
        return float(1 / self._steps[self._steps <= MISSING_GAP * self.step].mean())

    def part(self, places: Sequence[int]) -> Series:
        """Those at ascending places."""
        times = None if self.times is None else self.times[list(places)]
        return Series([self.numbers[place] for place in places], self.named, times, self.clock)

    def text(self) -> str:
        """Their number, and what is known of them."""
        known = f" at {self.rate:.3g} Hz" if self.rate else f" with the numbers {spans(self.numbers)}" if self.named else ""
        return f"{len(self.numbers)} pictures{known}"


class Match(NamedTuple):
    """Pictures of two sources that show the same moments."""

    places: dict[int, int]
    """Number of a picture of one -> place in the other; where numbers decide also those that one lacks."""
    by: str
    """The names, times or order that decided."""
    rival: int = 0
    """Places by which another reading of the same names would move the other, where nothing in them says which is right."""

    def moved(self, late: int, count: int) -> Match:
        """The same with the other moved by `late` of its `count` pictures."""
        if not late:
            return self
        places = {number: place + late for number, place in self.places.items() if 0 <= place + late < count}
        return Match(places, f"{self.by}, moved by {late}", self.rival)


def matched(where: Path, names: tuple[str, str], one: Series, other: Series, numbered: bool = False) -> Match:
    """The pictures of `other` that show the moments of `one`: the nearest time stamps, else numbers in names, else the order.

    Numbers decide where they have gaps or begin alike; as many pictures with the same gaps are paired by order. `numbered`: their
    numbers are known to count the same moments. Raises InputError naming `where` and the two `names` where nothing can be trusted.
    """
    rule, counts = f"{names[0]} and {names[1]} must show the same moments", (len(one.numbers), len(other.numbers))
    received, alike = f"{one.text()} and {other.text()}", counts[0] == counts[1]
    unlike = f", none missing in between, as if one had {max(counts) / max(min(counts), 1):.2f} times the rate"
    if one.times is not None and other.times is not None:
        largest = max(one.step, other.step)
        within = min(one.times[-1], other.times[-1]) - max(one.times[0], other.times[0])
        shared = within >= OVERLAP * min(np.ptp(one.times), np.ptp(other.times))
        # As many pictures over as long a time, begun at other times: each has a clock of its own.
        own_clocks = alike and abs(np.ptp(one.times) - np.ptp(other.times)) < largest < abs(one.times[0] - other.times[0])
        absolute = one.clock == other.clock != "" and (one.clock != "device" or (shared and not own_clocks))
        left, right = one.times - (0 if absolute else one.times[0]), other.times - (0 if absolute else other.times[0])
        if not absolute and one.whole and other.whole and abs(left[-1] - right[-1]) > MISSING_GAP * largest:
            raise InputError(where, rule, received + unlike, PAIRING_REMEDY)
        forth = _nearest(left, right)
        apart = np.abs(left - right[forth])
        mutual = (_nearest(right, left)[forth] == np.arange(len(left))) & (apart <= largest / 2)
        if mutual.sum() < COMMON * min(counts):
            raise InputError(where, rule, f"{received}; {mutual.sum()} are within half a frame of each other", PAIRING_REMEDY)
        places = {one.numbers[k]: int(forth[k]) for k in np.flatnonzero(mutual)}
        clocks = "" if absolute else ", each from its first picture"
        return Match(places, f"time stamps{clocks}, at most {1e3 * apart[mutual].max():.3g} ms apart")
    by_numbers = Match({number: place for place, number in enumerate(other.numbers)}, "the numbers in their names")
    begin = other.numbers[0] - one.numbers[0] if alike else 0
    if numbered or (one.named and other.named):
        common = len({*one.numbers} & {*other.numbers})
        same_gaps = alike and [number + begin for number in one.numbers] == other.numbers
        # A counter of its own has no gaps and begins at its own start: it says nothing of moments.
        begins = not common or abs(one.numbers[0] - other.numbers[0]) <= one.step
        ends = one.numbers[-1] != other.numbers[-1]
        own = one.whole and other.whole and one.step == other.step and begins and ends and not alike
        trusted = common >= COMMON * max(counts)
        if numbered or (trusted and not own and not (same_gaps and begin)):
            return by_numbers
        if not same_gaps:
            raise InputError(where, rule, received + (unlike if own else f"; {common} numbers are common"), PAIRING_REMEDY)
        # Neither says whether both counters begin with the same moment, or count the same moments.
        both = min({*one.numbers} & {*other.numbers}) if trusted else None
        rival = 0 if both is None else other.numbers.index(both) - one.numbers.index(both)
        by_order = f"order, from {one.numbers[0]} and {other.numbers[0]}"
        return Match({number: place for place, number in enumerate(one.numbers)}, by_order, rival)
    if not alike:
        raise InputError(where, rule, received, PAIRING_REMEDY)
    return Match({number: place for place, number in enumerate(one.numbers)}, "order")


def _nearest(times: np.ndarray, among: np.ndarray) -> np.ndarray:
    """The place in `among` of the nearest to each of `times`; both ascend."""
    return np.searchsorted((among[1:] + among[:-1]) / 2, times)


@dataclass(frozen=True, eq=False)
class Evenness:
    """Departure of the time stamps of some pictures from an even clock."""

    steps: np.ndarray
    """s per picture of the source, from each to the next."""
    departure: float
    """Frames: the farthest from where the clock has it."""
    missing: int
    """Pictures that are missing in between."""
    gaps: list[int]
    """Pictures after which some are missing."""
    runs: list[tuple[int, int]]
    """First and last picture of each part with one rate."""

    @classmethod
    def of(cls, times: np.ndarray, places: Sequence[int]) -> Evenness:
        """`times` [n], s, of the pictures at `places` of the source."""
        steps, usual = np.diff(times) / np.diff(places), float(np.median(np.diff(times) / np.diff(places)))
        rest = times - np.polyval(np.polyfit(places, times, 1), places)
        counted = np.where(steps > MISSING_GAP * usual, np.round(steps / usual) - 1, 0) * np.diff(places)
        breaks = np.flatnonzero(np.abs(np.diff(steps)) > JITTER * steps[1:] + ROUNDED) + 1
        runs = list(pairwise([0, *breaks.tolist(), len(steps)]))
        return cls(steps, float(np.ptp(rest) / 2 / steps.mean()), int(counted.sum()), np.flatnonzero(counted).tolist(), runs)

    @property
    def bad(self) -> bool:
        """True where a twin of these frames would have another time."""
        return self.departure > DEPARTURE or self.missing > MISSING_SHARE * len(self.steps)

    @property
    def odd(self) -> bool:
        """True where intervals differ by more than rounding."""
        return bool(np.ptp(self.steps) > JITTER * np.median(self.steps) + ROUNDED)

    def text(self) -> str:
        """The intervals."""
        first, last = 1e3 * self.steps.min(), 1e3 * self.steps.max()
        lost = f"about {self.missing} lost pictures (after {spans(self.gaps)} of {len(self.steps) + 1}), " if self.missing else ""
        return f"intervals of {first:.0f} to {last:.0f} ms, {lost}up to {self.departure:.1f} frames off an even clock"


SPANS_SHOWN = 6
"""Runs of numbers that a message names."""


def spans(numbers: Sequence[int]) -> str:
    """Ascending numbers in few words: `6, 13, 20 to 25`."""
    runs = [list(part) for _, part in groupby(enumerate(numbers), key=lambda pair: pair[1] - pair[0])]
    texts = [f"{run[0][1]} to {run[-1][1]}" if len(run) > 2 else ", ".join(str(number) for _, number in run) for run in runs]
    left = sum(map(len, runs[SPANS_SHOWN:]))
    return ", ".join(texts[:SPANS_SHOWN]) + (f" and {left} more" if left else "")
