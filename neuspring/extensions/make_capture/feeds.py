"""Color and depth of a camera in pairs: of two folders or videos, or color alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.camera import Lens
from neuspring.extensions.make_capture.formats import CameraFeed, ImageSource, Pair, open_images
from neuspring.extensions.make_capture.moments import Match, Series, matched


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
        """With depth all of them, or none."""
        pairs = [self._pairs[place] for place in places]
        colors = self.color.read([left for left, _ in pairs])
        if self.depth is None:
            return zip(colors, [None] * len(pairs), strict=True)
        return zip(colors, self.depth.read([right for _, right in pairs]), strict=True)

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


def pairs(colors: Sequence[Path], depths: Sequence[Path], names: Sequence[str] = ()) -> list[CameraFeed]:
    """The views of folders or videos, one of color and one of depth per camera; without depths color alone, of one camera.

    Raises InputError.
    """
    if len(colors) > 1 and not depths:
        rule = "without depth one camera is required: color alone is of one view"
        raise InputError("--color", rule, len(colors), "Give one folder or video, or --depth for each.")
    if not colors or (depths and len(colors) != len(depths)):
        rule = "as many folders or videos of depth as of color are required, one each per camera"
        raise InputError("--color, --depth", rule, f"{len(colors)} of color, {len(depths)} of depth")
    names = names_of(len(colors), names)
    deep: list[ImageSource | None] = [open_images(depth, "depth") for depth in depths]
    return [
        Paired(name, open_images(color, "color"), depth) for name, color, depth in zip(names, colors, deep or [None], strict=True)
    ]
