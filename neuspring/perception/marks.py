"""Annotations: boxes, clicks, scribbles and polygons that a user draws on a few frames of each camera. `marks.json` of a capture
contains them.

    {"format": 1, "cameras": {"0": [{"frame": 0, "label": "object", "kind": "box", "points": [[40, 30], [200, 160]]}]}}

| kind | points | meaning |
|---|---|---|
| `box` | two opposite corners | the label is limited to its boxes in this frame; `ignore` and `person` fill them |
| `click` | one | the disk of this `radius` has the label |
| `scribble` | one or more | the line of half width `radius` has the label |
| `polygon` | three or more | the label fills it; border uncertain by `radius`, exact for `ignore` and `person` |

Labels are `object`, `hand`, `ignore` (background in this frame) and `person` (neither object, hand nor background, in all
frames). Points are pixels (x, y); pixel centers are at integer coordinates, as in data/capture.py.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, Self

import cv2
import numpy as np
from pydantic import Field

from neuspring.config import parse, plain
from neuspring.core.errors import InputError
from neuspring.core.files import load_json, write_text
from neuspring.core.section import STRICT, Finite, Name
from neuspring.data.capture import HANDS, NOTHING, OBJECT, PERSON, Capture

MARKS = "marks.json"
"""File name in a capture."""
MARK_VALUES = {"object": OBJECT, "hand": HANDS, "ignore": NOTHING, "person": PERSON}
"""Mask value of each label."""
FILLED_MARKS = ("ignore", "person")
"""Labels that fill their boxes and polygons."""
LEAST_POINTS = {"box": 2, "click": 1, "scribble": 1, "polygon": 3}
EXACT_POINTS = ("box", "click")


@dataclass(frozen=True, kw_only=True)
class Mark:
    """One annotation of one frame of one camera. Raises InputError for a wrong number of points or an empty box."""

    __pydantic_config__ = STRICT
    frame: Annotated[int, Field(ge=0)]
    label: Literal["object", "hand", "ignore", "person"]
    kind: Literal["box", "click", "scribble", "polygon"]
    points: tuple[tuple[Finite, Finite], ...]
    """(x, y), pixels."""
    radius: Annotated[float, Field(gt=0, le=200, allow_inf_nan=False)] = 3.0
    """Half width of clicks and scribbles, and uncertainty of a polygon's border, pixels; unused for boxes."""

    def __post_init__(self) -> None:
        least, count = LEAST_POINTS[self.kind], len(self.points)
        if count < least or (self.kind in EXACT_POINTS and count > least):
            rule = f"a {self.kind} must have {least} point{'s' * (least > 1)}{'' if self.kind in EXACT_POINTS else ' or more'}"
            raise InputError(f"frame {self.frame}, {self.label}", rule, count)
        if self.kind == "box":
            (x0, y0), (x1, y1) = self.points
            if min(abs(x1 - x0), abs(y1 - y0)) < 1:
                rule = "the corners of a box must be at least one pixel apart in x and in y"
                raise InputError(f"frame {self.frame}, {self.label}", rule, [list(point) for point in self.points])

    @property
    def value(self) -> int:
        """Mask value: 1 object, 2 hands, 3 person, 0 none of them."""
        return MARK_VALUES[self.label]


@dataclass(frozen=True, kw_only=True)
class Marks:
    """marks.json: the annotations of all cameras."""

    __pydantic_config__ = STRICT
    format: Literal[1] = 1
    cameras: dict[Name, tuple[Mark, ...]] = field(default_factory=dict)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file, and check all keys, types and counts. Raises InputError with a list of all problems."""
        if not Path(path).exists():
            folder = Path(path).parent if Path(path).name == MARKS else "CAPTURE"
            remedy = f"Draw them in the browser: `neuspring annotate {folder}`."
            raise InputError(path, "annotations of object and hands are required", "no such file", remedy)
        values = load_json(Path(path))
        if not isinstance(values, dict):
            raise InputError(path, "a JSON object is required", type(values).__name__)
        return parse(cls, values, str(path))

    def save(self, path: Path) -> None:
        """Write the file atomically."""
        cameras = {name: [plain(mark) for mark in marks] for name, marks in self.cameras.items()}
        lines = [f' "{name}": [\n  ' + ",\n  ".join(map(json.dumps, own)) + "\n ]" for name, own in cameras.items()]
        write_text(Path(path), f'{{"format": {self.format}, "cameras": {{\n' + ",\n".join(lines) + "\n}}\n")

    def of(self, camera: str) -> tuple[Mark, ...]:
        """The annotations of one camera."""
        return self.cameras.get(camera, ())

    def require(self, capture: Capture, where: object = MARKS, *, whole: bool = True) -> None:
        """Check cameras, frames and points against a capture. Raises InputError.

        `whole`: the annotations are complete, so each annotated camera must have an object.
        """
        for name, marks in self.cameras.items():
            if name not in capture.cameras:
                raise InputError(f"{where}, cameras.{name}", "the capture must have this camera", sorted(capture.cameras))
            camera = capture.cameras[name]
            require_marks(marks, capture.frame_count, (camera.height, camera.width), f"{where}, cameras.{name}", whole=whole)
            for mark in marks:
                if not capture.has(name, mark.frame):
                    raise InputError(f"{where}, cameras.{name}", "annotations must be on recorded frames", mark.frame)


def require_marks(
    marks: tuple[Mark, ...], count: int, size: tuple[int, int], where: object = "marks", *, whole: bool = True
) -> None:
    """Check annotations of one camera against its number of frames and its size (height, width). Raises InputError.

    `whole`: the annotations are complete, so they must include an object.
    """
    height, width = size
    for index, mark in enumerate(marks):
        at = f"{where}[{index}]"
        if mark.frame >= count:
            raise InputError(f"{at}.frame", f"must be below {count}, the number of frames", mark.frame)
        for x, y in mark.points:
            if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
                raise InputError(f"{at}.points", f"must be inside the image of {width} x {height} pixels", [x, y])
    if whole and marks and not any(mark.label == "object" for mark in marks):
        labels = sorted({mark.label for mark in marks})
        raise InputError(where, "an object must be annotated in at least one frame", labels, 'Add one with "label": "object".')


def marks_digest(marks: tuple[Mark, ...]) -> str:
    """SHA-256 over annotations, independent of their order."""
    lines = sorted(json.dumps(plain(mark), sort_keys=True) for mark in marks)
    return f"sha256:{hashlib.sha256(chr(10).join(lines).encode()).hexdigest()}"


def drawn(mark: Mark, size: tuple[int, int], scale: float, *, grown: int = -1) -> np.ndarray:
    """Pixels [H, W] bool of an annotation; `grown`: a polygon without its uncertain border (-1), as drawn (0), or with it (1)."""
    image: np.ndarray = np.zeros(size, np.uint8)
    # Pixel centers are at integer coordinates, so the image begins at -0.5.
    points = (np.array(mark.points) + 0.5) * scale - 0.5
    radius = max(mark.radius * scale, 0.5)
    if mark.kind == "box":
        (x0, y0), (x1, y1) = np.round(np.sort(points, axis=0)).astype(int).tolist()
        image[max(y0, 0) : y1 + 1, max(x0, 0) : x1 + 1] = 1
        return image.astype(bool)
    corners = np.round(points).astype(np.int32)[:, None]
    if mark.kind == "polygon":
        cv2.fillPoly(image, [corners], 1)
        if mark.label not in FILLED_MARKS and grown:
            ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(radius) + 1,) * 2)
            # The polygon continues outside the image: its label is certain at the image border.
            eroded = cv2.erode(image, ellipse, borderType=cv2.BORDER_REPLICATE)
            image = np.asarray(cv2.dilate(image, ellipse) if grown > 0 else eroded)
        return image.astype(bool)
    cv2.polylines(image, [corners], False, 1, max(round(2 * radius), 1))
    for x, y in corners[:, 0].tolist():
        cv2.circle(image, (x, y), max(round(radius), 0), 1, -1)
    return image.astype(bool)
