"""What one camera gave: color and depth in pairs, or color alone, and what its files say about the camera."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.intake.images import Film, Images, open_images

Pair: TypeAlias = tuple[np.ndarray, np.ndarray | None]
"""RGB [H, W, 3] uint8, and depth [H, W] as stored; None: color alone."""
COMMON = 0.5
"""Color and depth are paired by their numbers if this part of them is common, else by their order."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Lens:
    """A camera's intrinsics."""

    matrix: np.ndarray
    """K [3, 3], pixels."""
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Coefficients of OpenCV's model (4, 5, 8, 12 or 14); none: no distortion."""
    size: tuple[int, int] | None = None
    """(width, height) for which it holds, where it is said."""


class View(Protocol):
    """One camera's pairs of pictures, and what is known of it."""

    @property
    def name(self) -> str:
        """Its name in the capture."""

    @property
    def path(self) -> Path:
        """For messages."""

    @property
    def numbers(self) -> list[int]:
        """The number of every pair, ascending."""

    @property
    def rate(self) -> float | None:
        """Frames per second, where the source knows."""

    @property
    def unit(self) -> float | None:
        """Meters per count of depth, where the source knows."""

    @property
    def lens(self) -> Lens | None:
        """Intrinsics, where the source knows."""

    @property
    def pose(self) -> np.ndarray | None:
        """Camera to world [4, 4], m, where the source knows."""

    @property
    def remarks(self) -> list[str]:
        """What the user should know about the files."""

    def read(self, places: Sequence[int]) -> Iterator[Pair]:
        """The pairs at ascending places: with depth all of them, or none."""

    def files(self, places: Sequence[int]) -> list[Path]:
        """The files that hold them."""


@dataclass(frozen=True, eq=False)
class Paired:
    """Color and depth of two folders or videos, or color alone."""

    name: str
    color: Images
    depth: Images | None
    unit: float | None = None
    lens: Lens | None = None
    pose: np.ndarray | None = None

    @property
    def path(self) -> Path:
        """That of color."""
        return self.color.path

    @cached_property
    def _pairs(self) -> list[tuple[int, int, int]]:
        """(number, place of color, place of depth). Raises InputError where they cannot be paired."""
        if self.depth is None:
            return [(number, place, place) for place, number in enumerate(self.color.numbers)]
        left, right = ({number: place for place, number in enumerate(images.numbers)} for images in (self.color, self.depth))
        common = sorted(left.keys() & right.keys())
        if len(common) >= COMMON * max(len(left), len(right)) and len(common):
            return [(number, left[number], right[number]) for number in common]
        if len(left) == len(right):
            return [(number, place, place) for place, number in enumerate(self.color.numbers)]
        rule = f"camera {self.name} needs as many depth images as color images, or the same numbers in their names"
        remedy = "Where both have time stamps for names, copy the nearest pairs to two folders first."
        raise InputError(self.depth.path, rule, f"{len(right)} for {len(left)}, {len(common)} numbers in common", remedy)

    @property
    def numbers(self) -> list[int]:
        """See `View`."""
        return [number for number, *_ in self._pairs]

    @property
    def rate(self) -> float | None:
        """That of the color video."""
        return self.color.rate

    @cached_property
    def remarks(self) -> list[str]:
        """Images without a partner, dropped pictures of a video."""
        found, sources = [], [images for images in (self.color, self.depth) if images is not None]
        alone = max(len(images.numbers) for images in sources) - len(self._pairs)
        if alone:
            found.append(f"camera {self.name}: {alone} images without their partner are left out")
        for images in sources:
            if isinstance(images, Film) and (dropped := images.dropped()):
                found.append(f"{images.path}: about {dropped} pictures were dropped when it was filmed; time jumps there")
        return found

    def read(self, places: Sequence[int]) -> Iterator[Pair]:
        """See `View`."""
        pairs = [self._pairs[place] for place in places]
        colors = self.color.read([left for _, left, _ in pairs])
        if self.depth is None:
            return zip(colors, [None] * len(pairs), strict=True)
        return zip(colors, self.depth.read([right for *_, right in pairs]), strict=True)

    def files(self, places: Sequence[int]) -> list[Path]:
        """See `View`."""
        pairs = [self._pairs[place] for place in places]
        deep = [] if self.depth is None else self.depth.files([right for *_, right in pairs])
        return self.color.files([left for _, left, _ in pairs]) + deep


def pairs(colors: Sequence[Path], depths: Sequence[Path], names: Sequence[str] = ()) -> list[View]:
    """The views of folders or videos, one of color and one of depth per camera; without depths color alone, of one camera.

    Raises InputError.
    """
    if len(colors) > 1 and not depths:
        rule = "without depth one camera is required: color alone is of one view"
        raise InputError("--color", rule, len(colors), "Give one folder or video, or --depth for each.")
    if not colors or (depths and len(colors) != len(depths)):
        rule = "as many folders or videos of depth as of color are required, one each per camera"
        raise InputError("--color, --depth", rule, f"{len(colors)} of color, {len(depths)} of depth")
    names = names or tuple(map(str, range(len(colors))))
    if len(names) != len(colors) or len(set(names)) < len(names):
        raise InputError("--cameras", f"{len(colors)} different names are required", " ".join(names))
    deep: list[Images | None] = [open_images(depth, "depth") for depth in depths]
    views: list[View] = [
        Paired(name, open_images(color, "color"), depth) for name, color, depth in zip(names, colors, deep or [None], strict=True)
    ]
    return views
