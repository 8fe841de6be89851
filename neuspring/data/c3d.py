"""Markers of C3D files, read with ezc3d.

`FILE.c3d` selects all markers, and `FILE.c3d#LABEL,LABEL` the named ones in this order. `FILE.c3d#unit=mm` states the unit of a
file without one; labels may follow. A marker is lost where its residual is negative or not finite, whatever position is stored.
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
"""Bytes. Data begin and end at multiples. Word 4 of the header is the number of the first frame, word 9 the first block of data."""
SGI = 86
"""Code of SGI processors, byte 4 of the parameters; 84 is Intel, 85 is DEC."""


def is_c3d(path: Path) -> bool:
    """True for FILE.c3d, with or without labels."""
    return FORM.fullmatch(str(path)) is not None


def plain_file(path: Path) -> Path:
    """The path without unit and labels."""
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
    """Number of the first frame in the recording, from 1."""

    @classmethod
    def read(cls, path: Path) -> Markers:
        """Read the markers that `path` selects. Raises InputError."""
        ezc3d, form, file = needed("ezc3d"), FORM.fullmatch(str(path)), plain_file(path)
        assert form is not None, "is_c3d accepts the path"
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
        file_unit = next(iter(about.get("UNITS", {}).get("value", [])), "").strip().lower()
        unit = form["unit"] or file_unit
        if unit not in C3D_UNITS or file_unit not in (unit, ""):
            rule = f"POINT:UNITS must be one of {' '.join(C3D_UNITS)}; unit= is only for files without a unit"
            options = ",".join(["unit=mm", *filter(None, [form["labels"]])])
            remedy = (
                f"State the unit: {file}#{options}"
                if not file_unit
                else "Remove unit=."
                if file_unit in C3D_UNITS
                else "Export the file in one of these units."
            )
            raise InputError(path, rule, f"{file_unit or 'none'} in the file, {form['unit'] or 'none'} in the path", remedy)
        names = form["labels"].split(",") if form["labels"] else labels
        for name in names if form["labels"] else ():
            if labels.count(name) != 1:
                raise InputError(path, "each label must name exactly one marker", repr(name), f"Labels: {' '.join(labels)}.")
        rate = float(about["RATE"]["value"][0])
        # ezc3d 1.7.2 swaps residual and camera byte of a point; a lost point has -1 in both.
        lost = ~(data["meta_points"]["residuals"][0].T >= 0) | ~np.isfinite(points).all(axis=2)
        points = np.where(lost[..., None], np.nan, points * C3D_UNITS[unit])
        chosen = [labels.index(name) for name in names] if form["labels"] else slice(None)
        return cls(points[:, chosen], tuple(names), rate, int.from_bytes(head[6:8], "little"))

    def whole(self, path: Path) -> np.ndarray:
        """The points [T, K, 3], m. Raises InputError if a marker is lost in any frame."""
        for label, lost in zip(self.labels, np.isnan(self.points[..., 0]).T, strict=False):
            if lost.any():
                rule = f"{label}: a controller must be seen in every frame"
                remedy = "Fill its gaps in the recording software, or select markers that are never lost: FILE.c3d#LABEL,LABEL."
                raise InputError(path, rule, f"lost in {lost.sum()} frames, first in {int(lost.argmax())}", remedy)
        return self.points


def _head(file: Path) -> bytes:
    """The header of the file. Raises InputError for files of SGI processors, which have the opposite byte order."""
    try:
        with file.open("rb") as stream:
            head = stream.read(C3D_BLOCK)
            stream.seek(C3D_BLOCK * (head[0] - 1) + 3)
            processor = stream.read(1)
    except (OSError, IndexError) as error:
        raise InputError(file, "a C3D file is required", str(error)) from error
    if processor == bytes([SGI]):
        raise InputError(file, "the byte order of Intel or DEC is required", "SGI (MIPS)", "Export the file for Intel (PC).")
    return head


def _require_whole(file: Path, head: bytes, content: dict, frames: int, points: int) -> None:
    """Raise InputError if the file contains more frames than its counter states; the counter ends at 65,535."""
    about, data = content["parameters"]["POINT"], content["data"]
    if not frames or not points or np.size(data.get("rotations", ())):
        return
    width = 4 if about["SCALE"]["value"][0] < 0 else 2
    each = width * (4 * points + np.size(data["analogs"]) // frames)
    held = (file.stat().st_size - C3D_BLOCK * (int.from_bytes(head[16:18], "little") - 1)) // each
    if (held - frames) * each > C3D_BLOCK:
        rule = "the file must not contain more frames than its counter states (at most 65,535)"
        raise InputError(file, rule, f"{held} frames, {frames} counted", "Export the recording in several files.")
