"""Streams of images, and pairing of their images by stamps, names or order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import repeat
from pathlib import Path
from typing import Literal, Protocol, TypeAlias

import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.text import spans
from neuspring.data.camera import Lens
from neuspring.data.capture import FEWEST_FRAMES

Kind = Literal["color", "depth"]
Pairing = Literal["names", "order"]
Pair: TypeAlias = tuple[np.ndarray, np.ndarray | None]
"""RGB [H, W, 3] uint8, and depth [H, W] as stored; None: a camera without depth."""
GAP = 1.5
"""Longer intervals, in median intervals, contain a missing image."""


@dataclass(frozen=True, eq=False)
class Series:
    """Frame numbers and times of a stream's images, both ascending."""

    numbers: list[int]
    times: np.ndarray | None = None
    """s; None: no stamps."""
    clock: str = ""
    """Name of the clock of the times; empty: times start at the stream's first image."""
    named: bool = True
    """False if the numbers only count images and identify no moment."""

    @property
    def step(self) -> float:
        """Median interval, s; NaN without stamps."""
        return np.nan if self.times is None or len(self.times) < 2 else float(np.median(np.diff(self.times)))

    @property
    def rate(self) -> float | None:
        """Frames per second, averaged over intervals without a missing image. None without stamps."""
        if self.times is None or len(self.times) < 2:
            return None
        steps = np.diff(self.times)
        return float(1 / steps[steps <= GAP * self.step].mean())


class ImageSource(Protocol):
    """Images of one kind, in temporal order."""

    @property
    def path(self) -> Path:
        """Path for messages."""

    @property
    def kind(self) -> Kind:
        """Kind of the images."""

    @property
    def series(self) -> Series:
        """Numbers and times of the images."""

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """RGB [H, W, 3] uint8, or depth [H, W] as stored, at ascending indices. Raises InputError."""

    def files(self, places: Sequence[int]) -> list[Path]:
        """The files that contain the images at these indices."""


def matched(where: object, names: tuple[str, str], one: Series, other: Series, pairing: Pairing | None) -> dict[int, int]:
    """Frame number in `one` -> index of the paired image in `other`.

    If both streams have stamps, each image is paired with the nearest, at most half a frame apart. Otherwise both must have the
    same frame numbers, unless `pairing` states that equal names or the order pair them. Raises InputError with `where` and the two
    `names`.
    """
    if one.times is not None and other.times is not None:
        return _by_time(where, names, one, other)
    counts, common = (len(one.numbers), len(other.numbers)), len({*one.numbers} & {*other.numbers})
    named = one.named and other.named
    if named and (one.numbers == other.numbers or (pairing == "names" and common)):
        return {number: place for place, number in enumerate(other.numbers)}
    if pairing == "order" and counts[0] == counts[1]:
        return dict(zip(one.numbers, range(counts[1]), strict=True))
    by_order = f"the order pairs {counts[0]}" if counts[0] == counts[1] else "the order pairs none"
    by_number = common if named else "none"
    received = (
        f"{counts[0]} images ({spans(one.numbers)}) and {counts[1]} ({spans(other.numbers)}): equal numbers pair {by_number}, "
    )
    remedy = "Use --pair names or --pair order, or write stamps.csv (file,seconds) into both folders."
    raise InputError(where, f"{names[0]} and {names[1]} must have the same frame numbers", received + by_order, remedy)


def _by_time(where: object, names: tuple[str, str], one: Series, other: Series) -> dict[int, int]:
    assert one.times is not None, "both have stamps"
    assert other.times is not None, "both have stamps"
    same_clock = one.clock == other.clock != ""
    left, right = ((each - (0 if same_clock else each[0])) for each in (one.times, other.times))
    half = np.nanmax([one.step, other.step]) / 2
    forth, back = (np.searchsorted((b[1:] + b[:-1]) / 2, a) for a, b in ((left, right), (right, left)))
    mutual = (back[forth] == np.arange(len(left))) & (np.abs(left - right[forth]) <= half)
    ends_apart = not same_clock and abs(left[-1] - right[-1]) > 2 * GAP * half
    if mutual.sum() < min(len(left), len(right)) / 2 or ends_apart:
        received = f"{len(left)} images over {np.ptp(left):.2f} s and {len(right)} over {np.ptp(right):.2f} s: {mutual.sum()} pairs"
        rule = f"{names[0]} and {names[1]} must show the same moments by their stamps"
        raise InputError(where, rule, received, "Trim both to the same time, or write stamps from one clock.")
    return {one.numbers[place]: int(forth[place]) for place in np.flatnonzero(mutual)}


@dataclass(frozen=True, eq=False)
class CameraStreams:
    """The streams of one camera, with unit and lens if the source states them."""

    name: str
    color: ImageSource
    depth: ImageSource | None
    unit: float | None = None
    """m per count of depth."""
    lens: Lens | None = None
    pairing: Pairing | None = None
    late: int = 0
    """Images by which depth is late, as --shift states."""

    @property
    def path(self) -> Path:
        """The path of color."""
        return self.color.path

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """(index in color, index in depth) of the paired images. Raises InputError."""
        numbers = self.color.series.numbers
        if self.depth is None:
            return [(place, place) for place in range(len(numbers))]
        names = f"camera {self.name}: color", "depth"
        partner = matched(self.depth.path, names, self.color.series, self.depth.series, self.pairing)
        count = len(self.depth.series.numbers)
        shifted = [(place, partner[number] + self.late) for place, number in enumerate(numbers) if number in partner]
        return [(place, other) for place, other in shifted if 0 <= other < count]

    @cached_property
    def series(self) -> Series:
        """Numbers and times of the pairs."""
        color, places = self.color.series, [place for place, _ in self.pairs]
        times = None if color.times is None else color.times[places]
        return replace(color, numbers=[color.numbers[place] for place in places], times=times)

    @property
    def without_partner(self) -> int:
        """Number of unpaired images of color and depth."""
        counts = [len(source.series.numbers) for source in (self.color, self.depth) if source is not None]
        return sum(count - len(self.pairs) for count in counts)

    def read(self, places: Sequence[int]) -> Iterator[Pair]:
        """The pairs at ascending indices, all of one size. Raises InputError."""
        pairs, size = [self.pairs[place] for place in places], None
        colors = self.color.read([left for left, _ in pairs])
        depths = repeat(None, len(pairs)) if self.depth is None else self.depth.read([right for _, right in pairs])
        for color, depth in zip(colors, depths, strict=True):
            shape = color.shape[:2]
            if depth is not None and shape != depth.shape:
                received = f"{depth.shape[1]} x {depth.shape[0]} for {shape[1]} x {shape[0]}"
                remedy = "Align depth to color where it was recorded (RealSense: rs.align; ROS: aligned_depth_to_color)."
                raise InputError(self.path, f"camera {self.name}: depth must be aligned to color, pixel by pixel", received, remedy)
            size = size or shape
            if shape != size:
                rule = f"camera {self.name}: all images must be {size[1]} x {size[0]}"
                raise InputError(self.path, rule, f"{shape[1]} x {shape[0]}")
            yield color, depth

    def files(self, places: Sequence[int]) -> list[Path]:
        """Files of color, then of depth."""
        left, right = zip(*(self.pairs[place] for place in places), strict=True)
        return self.color.files(left) + ([] if self.depth is None else self.depth.files(right))


@dataclass(frozen=True)
class FrameChoice:
    """The frames of a capture."""

    numbers: list[int]
    """Number in the source, per frame of the capture."""
    places: dict[str, dict[int, int]]
    """Camera -> frame of the capture -> index in the camera's pairs; missing frames are absent."""
    step: int
    """One in this many frames of the source is kept."""

    def missing(self, camera: str) -> tuple[int, ...]:
        """Frames that the camera misses."""
        return tuple(frame for frame in range(len(self.numbers)) if frame not in self.places[camera])

    def text(self) -> str:
        """The kept frames, in one line."""
        stride = f", one in {self.step}" if self.step > 1 else ""
        return f"{len(self.numbers)} frames, numbers {self.numbers[0]} to {self.numbers[-1]} of the source{stride}"


def choose(views: Sequence[CameraStreams], wanted: str, pairing: Pairing | None, late: Mapping[str, int]) -> FrameChoice:
    """The frames that `wanted` (FIRST-LAST or FIRST-LAST/STEP) selects, by the numbers of the first camera.

    Raises InputError for too few frames, or a camera without the first frame or half of the frames.
    """
    first, where = views[0], dict[str, dict[int, int]]()
    for view in views:
        names = f"camera {first.name}", f"camera {view.name}"
        partner = matched(view.path, names, first.series, view.series, pairing)
        moved = ((number, place + late.get(view.name, 0)) for number, place in partner.items())
        where[view.name] = {number: place for number, place in moved if 0 <= place < len(view.series.numbers)}
    numbers = sorted({number for of in where.values() for number in of})
    kept = chosen(wanted, numbers)
    if len(kept) < FEWEST_FRAMES:
        raise InputError("--frames", f"a capture needs at least {FEWEST_FRAMES} frames", f"{len(kept)} of {spans(numbers)}")
    places = {name: {frame: of[number] for frame, number in enumerate(kept) if number in of} for name, of in where.items()}
    for view in views:
        if len(places[view.name]) < len(kept) / 2 or 0 not in places[view.name]:
            rule = f"camera {view.name} must have the first chosen frame, number {kept[0]}, and half of all chosen frames"
            start = next((number for number in kept if all(number in of for of in where.values())), None)
            remedy = "" if start in (None, kept[0]) else f"Start at number {start}, the first frame of all cameras."
            raise InputError(view.path, rule, f"{len(places[view.name])} of {len(kept)} frames", remedy)
    return FrameChoice(kept, places, int(np.diff(np.searchsorted(numbers, kept)).min()))


def chosen(wanted: str, numbers: Sequence[int]) -> list[int]:
    """The members of ascending `numbers` from FIRST to LAST, both included, every STEP-th. Raises InputError."""
    if not wanted:
        return list(numbers)
    span, _, step = wanted.partition("/")
    first, _, last = span.partition("-")
    if not (first.isdigit() and last.isdigit() and (step or "1").isdigit() and int(step or 1)):
        raise InputError("--frames", "FIRST-LAST or FIRST-LAST/STEP is required, like 250-335 or 0-300/2", repr(wanted))
    kept = range(int(first), int(last) + 1, int(step or 1))
    return [number for number in numbers if number in kept]
