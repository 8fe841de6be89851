"""Markers of a C3D file, by ezc3d: FILE.c3d has all of them, FILE.c3d#LABEL,LABEL those that are named, in that order.

FILE.c3d#unit=mm says the unit of a file that has none; labels may follow. A marker is lost where its residual is negative or not
finite, whatever is written in its place; it may well be at (0, 0, 0).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import count, takewhile
from pathlib import Path

import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.extras import needed

FORM = re.compile(r"(?P<file>.+?\.c3d)(#(unit=(?P<unit>\w+)(,|$))?(?P<labels>.*))?", re.IGNORECASE)
C3D_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "meters": 1.0, "millimeters": 0.001}
"""m per unit."""
C3D_BLOCK = 512
"""Bytes: data begin and end at multiples. Word 4 of the header is the first frame's number, word 9 the block where data start."""
SGI = 86
"""Processor of a file, byte 4 of its parameters; 84: Intel, 85: DEC."""


def is_c3d(path: Path) -> bool:
    """True for FILE.c3d, with or without labels."""
    return FORM.fullmatch(str(path)) is not None


def plain_file(path: Path) -> Path:
    """The file itself."""
    form = FORM.fullmatch(str(path))
    return Path(form["file"]) if form else path


@dataclass(frozen=True, eq=False)
class Markers:
    """Labeled points over time."""

    points: np.ndarray
    """[T, K, 3], m, NaN where lost."""
    labels: tuple[str, ...]
    rate: float
    """Frames per second."""
    first: int = 1
    """Number of its first frame in the take, from 1."""

    @classmethod
    def read(cls, path: Path) -> Markers:
        """Those that `path` names. Raises InputError."""
        ezc3d, form, file = needed("ezc3d"), FORM.fullmatch(str(path)), plain_file(path)
        assert form is not None, "asked for by is_c3d"
        head = _head(file)
        try:
            content = ezc3d.c3d(str(file))
        except (OSError, RuntimeError, ValueError, IndexError) as error:
            raise InputError(file, "a C3D file is required", str(error)) from error
        data, about = content["data"], content["parameters"]["POINT"]
        points = np.moveaxis(data["points"][:3], -1, 0).swapaxes(1, 2)
        _require_whole(file, head, content, *points.shape[:2])
        keys = takewhile(lambda key: key in about, (f"LABELS{k}" if k > 1 else "LABELS" for k in count(1)))
        labels = [label.strip() for key in keys for label in about[key]["value"]][: points.shape[1]]
        said = next(iter(about.get("UNITS", {}).get("value", [])), "").strip().lower()
        unit = form["unit"] or said
        if unit not in C3D_UNITS or said not in (unit, ""):
            rule = f"POINT:UNITS must be one of {' '.join(C3D_UNITS)}, or be said if the file does not say it"
            asked = ",".join(["unit=mm", *filter(None, [form["labels"]])])
            remedy = (
                f"Say it, {file}#{asked}" if not said else "Leave unit= out." if said in C3D_UNITS else "Export it in one of them."
            )
            raise InputError(path, rule, f"{said or 'none'} in the file, {form['unit'] or 'none'} given", remedy)
        names = form["labels"].split(",") if form["labels"] else labels
        for name in names if form["labels"] else ():
            if labels.count(name) != 1:
                raise InputError(path, "labels of one marker each are required", repr(name), f"There are: {' '.join(labels)}.")
        rate = float(about["RATE"]["value"][0])
        # ezc3d 1.7.2 exchanges residual and camera byte of a point, but a lost one is -1 in both.
        lost = ~(data["meta_points"]["residuals"][0].T >= 0) | ~np.isfinite(points).all(axis=2)
        points = np.where(lost[..., None], np.nan, points * C3D_UNITS[unit])
        chosen = [labels.index(name) for name in names] if form["labels"] else slice(None)
        return cls(points[:, chosen], tuple(names), rate, int.from_bytes(head[6:8], "little"))

    def whole(self, path: Path) -> np.ndarray:
        """Their points, if none is lost. Raises InputError."""
        for label, lost in zip(self.labels, np.isnan(self.points[..., 0]).T, strict=False):
            if lost.any():
                rule = f"{label}: a controller must be seen in every frame"
                remedy = "Fill its gaps where it was recorded, or name markers that are never lost: FILE.c3d#LABEL,LABEL."
                raise InputError(path, rule, f"lost in {lost.sum()} frames, first in {int(lost.argmax())}", remedy)
        return self.points


def _head(file: Path) -> bytes:
    """The header. Raises InputError for a file of an SGI processor, whose numbers have the other order of bytes."""
    try:
        with file.open("rb") as stream:
            head = stream.read(C3D_BLOCK)
            stream.seek(C3D_BLOCK * (head[0] - 1) + 3)
            processor = stream.read(1)
    except (OSError, IndexError) as error:
        raise InputError(file, "a C3D file is required", str(error)) from error
    if processor == bytes([SGI]):
        raise InputError(file, "numbers of Intel or DEC processors are required", "SGI (MIPS)", "Export it for Intel (PC).")
    return head


def _require_whole(file: Path, head: bytes, content: dict, frames: int, points: int) -> None:
    """Raise InputError where the file holds more frames than it counts: the format's counter ends at 65,535."""
    about, data = content["parameters"]["POINT"], content["data"]
    if not frames or not points or np.size(data.get("rotations", ())):
        return
    width = 4 if about["SCALE"]["value"][0] < 0 else 2
    each = width * (4 * points + np.size(data["analogs"]) // frames)
    held = (file.stat().st_size - C3D_BLOCK * (int.from_bytes(head[16:18], "little") - 1)) // each
    if (held - frames) * each > C3D_BLOCK:
        rule = "the frames that the file counts must be all that it holds: its counter ends at 65,535"
        raise InputError(file, rule, f"{frames} of {held}", "Export it in parts.")
