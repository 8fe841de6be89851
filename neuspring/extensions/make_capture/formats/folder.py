"""Folders of images, sorted by the numbers in their names; a file stamps.csv (file,seconds) states their times."""

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
from neuspring.extensions.make_capture.formats import ENDINGS, CaptureFormat, require_kind
from neuspring.extensions.make_capture.streams import Kind, Series

STAMPS = "stamps.csv"
DIGITS = re.compile(r"([0-9]+)")


@dataclass(frozen=True)
class ImageFolder:
    """Images in one folder, sorted by stamps, else by names, in which digits are numbers: 10 comes after 9."""

    path: Path
    kind: Kind

    @cached_property
    def stamps(self) -> dict[str, float]:
        """File -> time, s; empty without stamps.csv. Raises InputError."""
        if not (file := self.path / STAMPS).is_file():
            return {}
        import pandas as pd

        table = pd.read_csv(file)
        if list(table) != ["file", "seconds"] or table["seconds"].dtype.kind not in "if" or table.duplicated("file").any():
            raise InputError(file, "columns file,seconds are required, one row for each image", ",".join(map(str, table)))
        return dict(zip(table["file"], table["seconds"].astype(float), strict=True))

    @cached_property
    def paths(self) -> list[Path]:
        """The images of the folder. Raises InputError for no images or several formats."""
        found = [path for path in self.path.iterdir() if path.suffix.lower() in ENDINGS[self.kind] and path.name[0] != "."]
        endings = sorted({path.suffix.lower() for path in found})
        if len(endings) != 1:
            rule = f"{self.kind} images of one format are required ({' '.join(ENDINGS[self.kind])})"
            raise InputError(self.path, rule, " and ".join(endings) or "none", "Use separate folders for color and depth.")
        if self.stamps and (missing := {path.name for path in found} ^ self.stamps.keys()):
            raise InputError(
                self.path / STAMPS, "exactly one row for each image is required", f"{min(missing)} in only one of them"
            )
        parts = {path: [int(part) if part.isdigit() else part for part in DIGITS.split(path.stem)] for path in found}
        return sorted(found, key=lambda path: (self.stamps.get(path.name, 0.0), parts[path]))

    @cached_property
    def series(self) -> Series:
        """Times from stamps; otherwise frame numbers, which are the digits in which the names differ."""
        count = list(range(len(self.paths)))
        if self.stamps:
            return Series(count, np.array([self.stamps[path.name] for path in self.paths]), clock=STAMPS)
        names = [DIGITS.split(path.stem) for path in self.paths]
        moving = [column for column in zip(*(name[1::2] for name in names), strict=False) if len(set(column)) > 1]
        numbers = [int("".join(digits)) for digits in zip(*moving, strict=True)]
        plain = len({tuple(name[::2]) for name in names}) == 1 and numbers == sorted(set(numbers))
        return Series(numbers, named=True) if plain and numbers else Series(count, named=False)

    def read(self, places: Sequence[int]) -> Iterator[np.ndarray]:
        """RGB [H, W, 3] uint8, or depth [H, W] as stored. Raises InputError for a damaged image or one of the wrong kind."""
        for path in self.files(places):
            if path.suffix.lower() == ".npy":
                yield require_kind(path, self.kind, read_npy(path))
                continue
            image = read_picture(path, cv2.IMREAD_COLOR if self.kind == "color" else cv2.IMREAD_UNCHANGED)
            yield require_kind(path, self.kind, image[..., ::-1] if self.kind == "color" else image)

    def files(self, places: Sequence[int]) -> list[Path]:
        """One file per image."""
        return [self.paths[place] for place in places]


def holds_images(path: Path) -> bool:
    """True for a folder that contains an image."""
    return path.is_dir() and any(file.suffix.lower() in (*ENDINGS["color"], *ENDINGS["depth"]) for file in path.iterdir())


capture_format = CaptureFormat(about="a folder of {kind} images ({endings})", recognizes=holds_images, pictures=ImageFolder)
