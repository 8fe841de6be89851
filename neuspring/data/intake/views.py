"""What one camera gave: color and depth in pairs, and what its files say about the camera."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.intake.images import Film, Images, open_images

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

    def read(self, places: Sequence[int]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """RGB [H, W, 3] uint8 and depth [H, W] as stored, of the pairs at ascending places."""

    def files(self, places: Sequence[int]) -> list[Path]:
        """The files that hold them."""


@dataclass(frozen=True, eq=False)
class Paired:
    """Color and depth of two folders or videos."""

    name: str
    color: Images
    depth: Images
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
        found = []
        alone = max(len(self.color.numbers), len(self.depth.numbers)) - len(self._pairs)
        if alone:
            found.append(f"camera {self.name}: {alone} images without their partner are left out")
        for images in (self.color, self.depth):
            if isinstance(images, Film) and (dropped := images.dropped()):
                found.append(f"{images.path}: about {dropped} pictures were dropped when it was filmed; time jumps there")
        return found

    def read(self, places: Sequence[int]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """See `View`."""
        pairs = [self._pairs[place] for place in places]
        return zip(self.color.read([left for _, left, _ in pairs]), self.depth.read([right for *_, right in pairs]), strict=True)

    def files(self, places: Sequence[int]) -> list[Path]:
        """See `View`."""
        pairs = [self._pairs[place] for place in places]
        return self.color.files([left for _, left, _ in pairs]) + self.depth.files([right for *_, right in pairs])


def pairs(colors: Sequence[Path], depths: Sequence[Path], names: Sequence[str] = ()) -> list[View]:
    """The views of folders or videos, one of color and one of depth per camera. Raises InputError."""
    if not colors or len(colors) != len(depths):
        rule = "as many folders or videos of depth as of color are required, one each per camera"
        raise InputError("--color, --depth", rule, f"{len(colors)} of color, {len(depths)} of depth")
    names = names or tuple(map(str, range(len(colors))))
    if len(names) != len(colors) or len(set(names)) < len(names):
        raise InputError("--cameras", f"{len(colors)} different names are required", " ".join(names))
    views: list[View] = [
        Paired(name, open_images(color, "color"), open_images(depth, "depth"))
        for name, color, depth in zip(names, colors, depths, strict=True)
    ]
    return views
