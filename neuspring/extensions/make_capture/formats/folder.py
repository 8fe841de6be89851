"""A folder of images."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.images import read_npy, read_picture
from neuspring.extensions.make_capture.feeds import Kind
from neuspring.extensions.make_capture.formats import ENDINGS, CaptureFormat, require_kind
from neuspring.extensions.make_capture.moments import Series
from neuspring.extensions.make_capture.stamps import times_of


@dataclass(frozen=True)
class ImageFolder:
    """Images in one folder, in the order of their names, in which runs of digits count as numbers: 10 comes after 9."""

    path: Path
    kind: Kind

    @cached_property
    def paths(self) -> list[Path]:
        """Its images. Raises InputError where there are none, or of two formats."""
        found = [path for path in self.path.iterdir() if path.suffix.lower() in ENDINGS[self.kind] and path.name[0] != "."]
        endings = sorted({path.suffix.lower() for path in found})
        if len(endings) != 1:
            rule = f"{self.kind} images of one format are required ({' '.join(ENDINGS[self.kind])})"
            raise InputError(self.path, rule, " and ".join(endings) or "none", "Color and depth need a folder of their own each.")
        # re.split with a group alternates text and digits.
        words = {path: [(p.isdigit(), int(p) if p.isdigit() else 0, p) for p in re.split(r"([0-9]+)", path.stem)] for path in found}
        told = times_of([path.stem for path in found])
        times = dict(zip(found, told[0].tolist(), strict=True)) if told else {}
        return sorted(found, key=lambda path: (times.get(path, 0.0), words[path]))

    @cached_property
    def series(self) -> Series:
        """Times in the names, with places as numbers; else the only number in which names differ; else places."""
        stems = [path.stem for path in self.paths]
        if told := times_of(stems):
            return Series(list(range(len(stems))), times=told[0], clock=told[1])
        words = [re.split(r"([0-9]+)", stem) for stem in stems]
        counts = list(zip(*(word[1::2] for word in words), strict=True)) if len({tuple(word[::2]) for word in words}) == 1 else []
        moving = [column for column in counts if len(set(column)) > 1]
        numbers = [int(digits) for digits in moving[0]] if len(moving) == 1 else []
        return Series(numbers, named=True) if len(set(numbers)) == len(stems) else Series(list(range(len(stems))))

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """RGB [H, W, 3] uint8, or depth [H, W] as stored. Raises InputError for a damaged image or one of the wrong kind."""
        for path in self.files(places):
            if path.suffix.lower() == ".npy":
                yield require_kind(path, self.kind, read_npy(path))
                continue
            image = read_picture(path, cv2.IMREAD_COLOR if self.kind == "color" else cv2.IMREAD_UNCHANGED)
            yield require_kind(path, self.kind, image[..., ::-1] if self.kind == "color" else image)

    def files(self, places: Sequence[int]) -> list[Path]:
        """One per picture."""
        return [self.paths[place] for place in places]


def holds_images(path: Path) -> bool:
    """True for a folder with an image in it; folders of other files are left to other formats."""
    return path.is_dir() and any(file.suffix.lower() in (*ENDINGS["color"], *ENDINGS["depth"]) for file in path.iterdir())


capture_format = CaptureFormat(about="a folder of {kind} images ({endings})", recognizes=holds_images, pictures=ImageFolder)
