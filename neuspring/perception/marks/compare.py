"""How two folders of masks agree."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT


@dataclass(frozen=True)
class Agreement:
    """Of one frame. NaN where neither mask shows the thing."""

    frame: int
    object: float
    """Intersection over union."""
    hands: float


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two masks [...] bool; NaN if both are empty."""
    union = int((one | other).sum())
    return float((one & other).sum() / union) if union else float("nan")


def compare(masks: Path, truth: Path) -> list[Agreement]:
    """Of all frames in `truth`, by their number. Raises InputError where masks lack one or differ in size."""
    there, known = (_numbered(folder) for folder in (masks, truth))
    rows = []
    for frame, path in known.items():
        if frame not in there:
            raise InputError(masks, f"a mask of frame {frame} is required: {truth} has one", sorted(there)[:5])
        one, other = (cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in (there[frame], path))
        if one is None or other is None or one.shape != other.shape or one.ndim != 2:
            sizes = [None if image is None else image.shape for image in (one, other)]
            raise InputError(there[frame], f"must be a gray image of the size of {path}", sizes)
        rows.append(Agreement(frame, *(overlap(one == label, other == label) for label in (OBJECT, HANDS))))
    return rows


def table(rows: list[Agreement]) -> str:
    """Text of a table: IoU per frame, and the mean."""
    lines = ["frame  object  hands"] + [f"{row.frame:5d}  {row.object:6.3f}  {row.hands:5.3f}" for row in rows]
    values = np.array([[row.object, row.hands] for row in rows])
    known = np.isfinite(values)
    means = np.where(known, values, 0.0).sum(axis=0) / np.where(known.any(axis=0), known.sum(axis=0), np.nan)
    return "\n".join([*lines, f" mean  {means[0]:6.3f}  {means[1]:5.3f}"]) + "\n"


def _numbered(folder: Path) -> dict[int, Path]:
    found = {int(path.stem): path for path in sorted(Path(folder).glob("*.png")) if path.stem.isdigit()}
    if not found:
        raise InputError(folder, "a folder of masks named by their frame is required: 00000.png", "none")
    return found
