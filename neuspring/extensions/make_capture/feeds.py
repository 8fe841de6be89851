"""Color and depth of a camera in pairs: of two folders or videos, or color alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import repeat
from pathlib import Path
from typing import Literal, Protocol, TypeAlias

import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.camera import Lens
from neuspring.extensions.make_capture.moments import Match, Series, matched

Kind = Literal["color", "depth"]
Pair: TypeAlias = tuple[np.ndarray, np.ndarray | None]
"""RGB [H, W, 3] uint8, and depth [H, W] as stored; None: color alone."""


class ImageSource(Protocol):
    """Pictures of one kind, in the order of time."""

    @property
    def path(self) -> Path:
        """For messages."""

    @property
    def kind(self) -> Kind:
        """The kind of all of them."""

    @property
    def series(self) -> Series:
        """When every picture was taken."""

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """RGB [H, W, 3] uint8, or depth [H, W] as stored, at ascending places. Raises InputError."""

    def files(self, places: Sequence[int]) -> list[Path]:
        """The files that hold them."""


@dataclass(frozen=True, eq=False)
class Paired:
    """Color and depth of two folders or videos, or color alone."""

    name: str
    color: ImageSource
    depth: ImageSource | None
    unit: float | None = None
    lens: Lens | None = None
    pose: np.ndarray | None = None
    numbered: bool = False
    """True where numbers in names are known to count the same moments everywhere."""
    late: int = 0
    """Pictures of depth that come before the first that belongs to one of color, beyond what `moments` says."""

    @property
    def path(self) -> Path:
        """The path of color."""
        return self.color.path

    @cached_property
    def match(self) -> Match:
        """Number of color -> place of depth; nothing of color alone. Raises InputError; see `moments`."""
        if self.depth is None:
            return Match({}, "")
        names = (f"camera {self.name}: color", "depth")
        found = matched(self.depth.path, names, self.color.series, self.depth.series, self.numbered)
        return found.moved(self.late, len(self.depth.series.numbers))

    @cached_property
    def _pairs(self) -> list[tuple[int, int]]:
        """(place of color, place of depth)."""
        numbers, of = self.color.series.numbers, self.match.places
        if self.depth is None:
            return [(place, place) for place in range(len(numbers))]
        return [(place, of[number]) for place, number in enumerate(numbers) if number in of]

    @cached_property
    def series(self) -> Series:
        """Times of the pairs."""
        return self.color.series.part([left for left, _ in self._pairs])

    def rate(self, places: Sequence[int]) -> float | None:
        """Frames per second around some pairs, by their time stamps."""
        return self.series.part(range(min(places), max(places) + 1)).rate

    @property
    def sources(self) -> list[ImageSource]:
        """Color, and depth where there is any."""
        return [self.color] if self.depth is None else [self.color, self.depth]

    @property
    def alone(self) -> dict[str, list[int]]:
        """Numbers of images without a partner, by kind."""
        used = zip(*self._pairs, strict=True) if self._pairs else ((), ())
        return {
            images.kind: [number for place, number in enumerate(images.series.numbers) if place not in taken]
            for images, taken in zip(self.sources, map(set, used), strict=False)
        }

    def read(self, places: Sequence[int]) -> Iterator[Pair]:
        """The pairs at ascending places, all of one size, with depth all of them or none. Raises InputError."""
        pairs, size = [self._pairs[place] for place in places], None
        colors = self.color.read([left for left, _ in pairs])
        depths = repeat(None, len(pairs)) if self.depth is None else self.depth.read([right for _, right in pairs])
        for color, depth in zip(colors, depths, strict=True):
            if depth is not None and color.shape[:2] != depth.shape:
                received = f"{depth.shape[1]} x {depth.shape[0]} for {color.shape[1]} x {color.shape[0]}"
                remedy = "Let the camera's software align depth to color (RealSense: rs.align; ROS: aligned_depth_to_color)."
                raise InputError(self.path, f"camera {self.name}: depth must be aligned to color, pixel by pixel", received, remedy)
            width, height = size = size or (color.shape[1], color.shape[0])
            if color.shape[:2] != (height, width):
                rule = f"camera {self.name}: all images must be {width} x {height}"
                raise InputError(self.path, rule, f"{color.shape[1]} x {color.shape[0]}")
            yield color, depth

    def files(self, places: Sequence[int]) -> list[Path]:
        """Those of color, then those of depth."""
        pairs = [self._pairs[place] for place in places]
        deep = [] if self.depth is None else self.depth.files([right for _, right in pairs])
        return self.color.files([left for left, _ in pairs]) + deep


def names_of(count: int, given: Sequence[str]) -> Sequence[str]:
    """Names of so many cameras: 0, 1, 2, ... where none is given. Raises InputError."""
    names = given or tuple(map(str, range(count)))
    if len(names) != count or len(set(names)) < count:
        raise InputError("--cameras", f"{count} different names are required", " ".join(names))
    return names


@dataclass(frozen=True, kw_only=True, eq=False)
class Recorded:
    """All that cameras gave, and what came along."""

    views: Sequence[Paired]
    rate: float | None = None
    """Frames per second, where it is known apart from the views."""
    up: Literal["+z", "-z"] | None = None
    """Up of its poses; None: found by the table."""
    train_end: int | None = None
    """End of the training frames, of all its frames."""
    tracks: np.ndarray | None = None
    """[T, K, 3], m, in its world: annotated points."""
    labels: Callable[[str, int], np.ndarray] | None = None
    """Camera and number of a frame -> mask [H, W] uint8; None: no masks. Raises InputError."""
    require_masks: Callable[[dict[str, list[int]]], None] = lambda numbers: None
    """Raises InputError unless there are masks of the frames, by number, of each camera."""
