"""Which frames are kept: a list of ranges, and the same moments of every camera."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from neuspring.core.errors import InputError
from neuspring.data.intake.views import View

FEWEST = 5
"""Frames of a capture."""
SYNTAX = re.compile(r"(\d+)(?:(-)(\d*))?(?:/(\d+))?")


@dataclass(frozen=True)
class Choice:
    """The frames of a capture."""

    numbers: list[int]
    """Of the source, per frame of the capture."""
    places: dict[str, dict[int, int]]
    """Camera -> frame of the capture -> place in its view; a frame that the camera lacks is absent."""
    step: int
    """Every so many frames of the source are kept; the rate falls by it."""
    jumps: int
    """Places where more numbers are left out: there time jumps."""

    def missing(self, camera: str) -> tuple[int, ...]:
        """Frames that the camera lacks."""
        return tuple(frame for frame in range(len(self.numbers)) if frame not in self.places[camera])

    def text(self) -> str:
        """Which they are, in one line."""
        stride = f", one in {self.step}" if self.step > 1 else ""
        return f"{len(self.numbers)} frames, numbers {self.numbers[0]} to {self.numbers[-1]} of the source{stride}"


def chosen(wanted: str, numbers: Sequence[int]) -> list[int]:
    """The members of ascending `numbers` that `wanted` names: `250-335`, `0-`, `0-300/2`, `1,5,9-20`; both ends count.

    Raises InputError for another syntax, or where nothing is left.
    """
    if not wanted:
        return list(numbers)
    kept: set[int] = set()
    for part in wanted.split(","):
        match = SYNTAX.fullmatch(part.strip())
        if not match or (match[4] and int(match[4]) < 1) or (match[4] and not match[2]):
            raise InputError("--frames", "ranges like 250-335, 0-, 0-300/2 or 1,5,9-20 are required", repr(part))
        first = int(match[1])
        last = first if not match[2] else int(match[3]) if match[3] else max(numbers, default=first)
        kept |= {number for number in numbers if first <= number <= last and (number - first) % int(match[4] or 1) == 0}
    return sorted(kept)


def choose(views: Sequence[View], wanted: str = "") -> Choice:
    """The frames of all cameras that are kept.

    Cameras with equally many frames go by their order, others by the numbers in the names of their images; a number that the first
    camera has and another lacks is a missing frame. Raises InputError for too few frames.
    """
    first = views[0]
    alike = all(len(view.numbers) == len(first.numbers) for view in views)
    kept = chosen(wanted, first.numbers)
    received = f"{len(kept)} of the numbers {first.numbers[0]} to {first.numbers[-1]}" if first.numbers else "none"
    if len(kept) < FEWEST:
        raise InputError("--frames", f"a capture needs at least {FEWEST} frames", received)
    places: dict[str, dict[int, int]] = {}
    for view in views:
        where = {number: place for place, number in enumerate(first.numbers if alike else view.numbers)}
        places[view.name] = {frame: where[number] for frame, number in enumerate(kept) if number in where}
        if len(places[view.name]) < len(kept) / 2 or 0 not in places[view.name]:
            rule = f"camera {view.name} must have the frames of camera {first.name}: the first of them, and half of the others"
            remedy = "Name the images of all cameras by the same frame numbers, or give --frames."
            raise InputError(view.path, rule, f"{len(places[view.name])} of {len(kept)}", remedy)
    of_first = [place for _, place in sorted(places[first.name].items())]
    # The rate is that of the files that are there; a number that is not there is a moment that is missing.
    step = min(after - before for before, after in pairwise(of_first))
    gaps = [after - before for before, after in pairwise(kept)]
    return Choice(kept, places, step, sum(gap != min(gaps) for gap in gaps))
