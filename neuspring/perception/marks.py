"""Marks: boxes, clicks, scribbles and polygons that a user drew on a few frames of each camera, as `marks.json` of a capture, and
what they say about the pixels of a frame.

    {"format": 1, "cameras": {"0": [{"frame": 0, "label": "object", "kind": "box", "points": [[40, 30], [200, 160]]}]}}

| kind | points | what it says |
|---|---|---|
| `box` | two opposite corners | the label's pixels of this frame lie in its boxes; `ignore` and `person`: they fill it |
| `click` | one | the disk of `radius` has this label |
| `scribble` | one or more | the line of half width `radius` has this label |
| `polygon` | three or more | the label fills it, up to `radius` at its border; `ignore` and `person`: exactly |

Labels are `object`, `hand`, `ignore` (neither) and `person` (neither in any frame, nor background).
Points are pixels (x, y), pixel centers at whole coordinates, as in data/capture.py.
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
"""Its name in a capture's folder."""
MARK_VALUES = {"object": OBJECT, "hand": HANDS, "ignore": NOTHING, "person": PERSON}
"""Label in a mask of a mark's word."""
FILLED_MARKS = ("ignore", "person")
"""Labels whose boxes and polygons are filled: all that is inside has the label."""
LEAST_POINTS = {"box": 2, "click": 1, "scribble": 1, "polygon": 3}
EXACT_POINTS = ("box", "click")


@dataclass(frozen=True, kw_only=True)
class Mark:
    """One mark on one frame of one camera. Raises InputError for a wrong number of points or an empty box."""

    __pydantic_config__ = STRICT
    frame: Annotated[int, Field(ge=0)]
    label: Literal["object", "hand", "ignore", "person"]
    kind: Literal["box", "click", "scribble", "polygon"]
    points: tuple[tuple[Finite, Finite], ...]
    """(x, y), pixels."""
    radius: Annotated[float, Field(gt=0, le=200, allow_inf_nan=False)] = 3.0
    """Half width of a click's disk and of a scribble's line, and how far a polygon's border may be off; pixels. Not of a box."""

    def __post_init__(self) -> None:
        least, count = LEAST_POINTS[self.kind], len(self.points)
        if count < least or (self.kind in EXACT_POINTS and count > least):
            rule = f"a {self.kind} needs {least} point{'s' * (least > 1)}{'' if self.kind in EXACT_POINTS else ' or more'}"
            raise InputError(f"frame {self.frame}, {self.label}", rule, count)
        if self.kind == "box":
            (x0, y0), (x1, y1) = self.points
            if min(abs(x1 - x0), abs(y1 - y0)) < 1:
                rule = "the corners of a box must be a pixel or more apart in x and in y"
                raise InputError(f"frame {self.frame}, {self.label}", rule, [list(point) for point in self.points])

    @property
    def value(self) -> int:
        """Its label in a mask: 1 object, 2 hands, 3 person, 0 none of them."""
        return MARK_VALUES[self.label]


@dataclass(frozen=True, kw_only=True)
class Marks:
    """marks.json: the marks of all cameras."""

    __pydantic_config__ = STRICT
    format: Literal[1] = 1
    cameras: dict[Name, tuple[Mark, ...]] = field(default_factory=dict)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file, every key, type and count checked. Raises InputError that lists each problem."""
        if not Path(path).exists():
            folder = Path(path).parent if Path(path).name == MARKS else "CAPTURE"
            remedy = f"Draw them in the browser: `neuspring annotate {folder}`."
            raise InputError(path, "marks of object and hands are required", "no such file", remedy)
        values = load_json(Path(path))
        if not isinstance(values, dict):
            raise InputError(path, "a JSON object is required", type(values).__name__)
        return parse(cls, values, str(path))

    def save(self, path: Path) -> None:
        """Write the file whole or not at all."""
        cameras = {name: [plain(mark) for mark in marks] for name, marks in self.cameras.items()}
        lines = [f' "{name}": [\n  ' + ",\n  ".join(map(json.dumps, own)) + "\n ]" for name, own in cameras.items()]
        write_text(Path(path), f'{{"format": {self.format}, "cameras": {{\n' + ",\n".join(lines) + "\n}}\n")

    def of(self, camera: str) -> tuple[Mark, ...]:
        """The marks of one camera."""
        return self.cameras.get(camera, ())

    def require(self, capture: Capture, where: object = MARKS, *, whole: bool = True) -> None:
        """Check cameras, frames and points against a capture. Raises InputError.

        `whole`: they are all of them, so a camera with marks must have an object among them.
        """
        for name, marks in self.cameras.items():
            if name not in capture.cameras:
                raise InputError(f"{where}, cameras.{name}", "the capture must have this camera", sorted(capture.cameras))
            camera = capture.cameras[name]
            require_marks(marks, capture.frame_count, (camera.height, camera.width), f"{where}, cameras.{name}", whole=whole)
            for mark in marks:
                if not capture.has(name, mark.frame):
                    raise InputError(f"{where}, cameras.{name}", "marks must lie on frames that the camera has", mark.frame)


def require_marks(
    marks: tuple[Mark, ...], count: int, size: tuple[int, int], where: object = "marks", *, whole: bool = True
) -> None:
    """Check marks of one camera against its count of frames and its size (height, width). Raises InputError.

    `whole`: they are all of them, so an object must be among them.
    """
    height, width = size
    for index, mark in enumerate(marks):
        at = f"{where}[{index}]"
        if mark.frame >= count:
            raise InputError(f"{at}.frame", f"must lie below {count}, the number of frames", mark.frame)
        for x, y in mark.points:
            if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
                raise InputError(f"{at}.points", f"must lie in the image of {width} x {height} pixels", [x, y])
    if whole and marks and not any(mark.label == "object" for mark in marks):
        labels = sorted({mark.label for mark in marks})
        raise InputError(where, "an object must be marked in one frame or more", labels, 'Add a mark with "label": "object".')


def marks_digest(marks: tuple[Mark, ...]) -> str:
    """SHA-256 over marks; their order does not count."""
    lines = sorted(json.dumps(plain(mark), sort_keys=True) for mark in marks)
    return f"sha256:{hashlib.sha256(chr(10).join(lines).encode()).hexdigest()}"


def drawn(mark: Mark, size: tuple[int, int], scale: float, *, grown: int = -1) -> np.ndarray:
    """The pixels [H, W] bool that a mark covers: a polygon without its uncertain border (-1), as it is (0), or grown by it (1)."""
    image: np.ndarray = np.zeros(size, np.uint8)
    # Pixel centers lie at whole coordinates, so the image begins at -0.5.
    points = (np.array(mark.points) + 0.5) * scale - 0.5
    radius = max(mark.radius * scale, 0.5)
    if mark.kind == "box":
        (x0, y0), (x1, y1) = np.round(np.sort(points, axis=0)).astype(int).tolist()
        image[max(y0, 0) : y1 + 1, max(x0, 0) : x1 + 1] = 1
        return image.astype(bool)
    whole = np.round(points).astype(np.int32)[:, None]
    if mark.kind == "polygon":
        cv2.fillPoly(image, [whole], 1)
        if mark.label not in FILLED_MARKS and grown:
            ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(radius) + 1,) * 2)
            # Outside of the image the polygon goes on: a hand is not uncertain where the image ends.
            eroded = cv2.erode(image, ellipse, borderType=cv2.BORDER_REPLICATE)
            image = np.asarray(cv2.dilate(image, ellipse) if grown > 0 else eroded)
        return image.astype(bool)
    cv2.polylines(image, [whole], False, 1, max(round(2 * radius), 1))
    for x, y in whole[:, 0].tolist():
        cv2.circle(image, (x, y), max(round(radius), 0), 1, -1)
    return image.astype(bool)
