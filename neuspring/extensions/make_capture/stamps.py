"""Times in the names of images, by one parser: what grows by nearly even steps, as fast as a camera takes pictures, is a time.

    20240501_123015_033, 2024-05-01T12-30-15.033    date and time of day, with any separators
    12-30-15-033, 123015_033                        time of day alone
    1305031102.175304, 421_733366000, 12.033        seconds and their fraction, by a point or as ms, us, ns
    1305031102175, 421733366                        ms, us or ns, since 1970 or by a clock of the camera

Numbers that count pictures grow by the same step exactly, and stay numbers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

import numpy as np

from neuspring.data.camera import FASTEST, SLOWEST

FEWEST_NAMES = 3
"""Names below which steps say nothing."""
STEPS_EVEN, MOSTLY = 0.15, 0.8
"""Part of a step by which steps of a camera's own clock may differ, and the share of steps that are so even."""
COUNTED = 1000
"""A step of so many counts, which is the same exactly, is still a time: nobody keeps one picture in a thousand."""
EPOCH = (1e9, 2e9)
"""s since 1970 that are a time of ours; from 2e9 on digits are a date: 20260131..."""
FRACTIONS = {3: 1e-3, 6: 1e-6, 9: 1e-9}
"""Digits of a fraction of a second -> s per count."""
FILM_RATES = (24, 25, 30, 48, 50, 60, 100, 120)
"""Frames per second of time codes, whose last two digits count frames."""
SECONDS_APART = 0.5
"""s. Where seconds stand in digits of their own, several pictures share them; else they are a counter."""


def times_of(names: Sequence[str]) -> tuple[np.ndarray, str] | None:
    """Times [n], s, in names without endings, and their clock, `wall` or `device`; None where they hold no time."""
    words = [re.split(r"([0-9]+)", name) for name in names]
    if len(names) < FEWEST_NAMES or len({tuple(word[::2]) for word in words}) != 1:
        return None
    columns = list(zip(*(word[1::2] for word in words), strict=True))
    read = [(times, clock) for times, count in _readings(columns, words[0][2:-1:2]) if (clock := _clock(times, count))]
    return min(read, key=lambda one: one[1] != "wall", default=None)


def _readings(columns: Sequence[Sequence[str]], between: Sequence[str]) -> Iterator[tuple[np.ndarray, float]]:
    """Times that columns of digits may be, the surest first, with the s of one count. `between` is what separates columns."""
    widths = [{len(digits) for digits in column} for column in columns]
    fixed = [width.pop() if len(width) == 1 else 0 for width in widths]
    for first in range(len(columns)):
        for last in range(len(columns), first, -1):
            if all(fixed[first:last]):
                joined = ["".join(parts) for parts in zip(*columns[first:last], strict=True)]
                yield from _dates(joined, fixed[first:last])
    for left, right, separator in zip(columns, columns[1:], between, strict=False):
        if len(set(left)) == 1 or len(set(right)) == 1:
            continue
        seconds, rest = np.array(left, float), np.array(right, float)
        most = max(len(part) for part in right)
        if separator == ".":
            found = [(np.array([float(f"{whole}.{part}") for whole, part in zip(left, right, strict=True)]), 0.1**most)]
        elif most == min(len(part) for part in right) and most in (2, *FRACTIONS):
            found = [_seconds(seconds, right)]
        else:
            found = [(seconds + rest * unit, unit) for unit in FRACTIONS.values() if rest.max() < 1 / unit]
        yield from ((times, count) for times, count in found if np.median(np.diff(np.sort(times))) <= SECONDS_APART)
    for column in columns:
        counts = np.array(column, float)
        yield from ((counts * unit, unit) for unit in FRACTIONS.values())


def _dates(joined: Sequence[str], widths: Sequence[int]) -> Iterator[tuple[np.ndarray, float]]:
    """Times of digits that begin with a date and a time of day, or with a time of day in columns of its own."""
    form = "%Y%m%d%H%M%S"
    length = 14
    if widths[0] in (2, 6) and sum(widths[:3]) >= 6:
        form, length = "%H%M%S", 6
        if (widths[:3] != [2, 2, 2] and widths[0] != 6) or len(joined[0]) == length:
            return
    if len(joined[0]) < length or (length == 14 and not joined[0].startswith(("19", "20"))):
        return
    if len({digits[length:] for digits in joined}) == 1:
        return  # Of whole seconds, digits that follow are of something else.
    try:
        moments = [datetime.strptime(digits[:length], form).replace(tzinfo=UTC) for digits in joined]
    except ValueError:
        return
    start = datetime(1970 if length == 14 else 1900, 1, 1, tzinfo=UTC)
    seconds = np.array([(moment - start).total_seconds() for moment in moments])
    times, count = _seconds(seconds, [digits[length:] for digits in joined])
    if np.median(np.diff(np.sort(times))) <= SECONDS_APART:
        yield times, count


def _seconds(seconds: np.ndarray, digits: Sequence[str]) -> tuple[np.ndarray, float]:
    """Times [n], s, of whole seconds and the digits behind them, all as many, and the s of one count.

    Two digits that grow by 1 count the frames of a time code.
    """
    counts, unit = np.array(digits, float), 0.1 ** len(digits[0])
    order = np.lexsort([counts, seconds])
    steps = np.diff(counts[order])[np.diff(seconds[order]) == 0]
    if len(digits[0]) == 2 and len(steps) and np.median(steps) == 1:
        rate = next((rate for rate in FILM_RATES if rate > counts.max()), 100) if len(set(seconds)) > 1 else np.nan
        return seconds + counts / rate, 0.0
    return seconds + counts * unit, unit


def _clock(times: np.ndarray, count: float) -> str | None:
    """The clock of times [n], in any order, with `count` s per count (0: none); None where they are no times of pictures."""
    steps = np.diff(np.sort(times))
    usual = float(np.median(steps))
    if not (steps > 0).all() or not 0.9 / FASTEST <= usual <= 1.1 / SLOWEST:
        return None
    if EPOCH[0] < times.min() and times.max() < EPOCH[1]:
        return "wall"
    if count and usual / count < COUNTED and np.ptp(steps) < 0.5 * count:
        return None
    rest = np.abs(steps - np.round(steps / usual) * usual)
    return "device" if (rest <= max(STEPS_EVEN * usual, 1.5 * count)).mean() >= MOSTLY else None
