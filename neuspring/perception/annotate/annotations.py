"""Clicks on points that a person follows through a video, as one small file: `annotations.json` in the capture's folder.

    {"format": 1, "points": [
      {"name": "left ear", "clicks": {"0": [{"frame": 0, "x": 61.5, "y": 40.0}, {"frame": 9, "hidden": true}]}}]}

A click says where the point is in a frame of a camera; pixels as in data/capture.py. `hidden` says that the camera does not see the
point from this frame on, until the next click. Between clicks the point is tracked; see follow.py.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, StringConstraints

from neuspring.config import parse, plain
from neuspring.config.parse import STRICT, Finite
from neuspring.core.errors import InputError
from neuspring.core.files import load_json, write_text
from neuspring.data.capture import Capture

ANNOTATIONS = "annotations.json"
MOST_POINTS, MOST_CLICKS = 500, 5000
"""Points in a file, and clicks on one point in one camera: limits for what a browser may send."""
Title = Annotated[str, StringConstraints(min_length=1, max_length=80, pattern=r"^[^\x00-\x1f\x7f]+$")]
CameraName = Annotated[str, StringConstraints(max_length=80)]


@dataclass(frozen=True, kw_only=True)
class Click:
    """Where a point is in one frame of one camera, or that it is hidden from here on."""

    __pydantic_config__ = STRICT
    frame: Annotated[int, Field(ge=0)]
    x: Finite | None = None
    """Pixels; null where hidden."""
    y: Finite | None = None
    """Pixels; null where hidden."""
    hidden: bool = False
    """The camera does not see the point from this frame on, until the next click."""

    @property
    def place(self) -> tuple[float, float] | None:
        """(x, y), pixels; None where hidden."""
        return None if self.hidden or self.x is None or self.y is None else (self.x, self.y)


@dataclass(frozen=True, kw_only=True)
class Point:
    """One point of the object, and its clicks by camera."""

    __pydantic_config__ = STRICT
    name: Title
    clicks: dict[CameraName, Annotated[tuple[Click, ...], Field(max_length=MOST_CLICKS)]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Annotations:
    """All points of a capture."""

    __pydantic_config__ = STRICT
    format: Literal[1] = 1
    points: Annotated[tuple[Point, ...], Field(max_length=MOST_POINTS)] = ()

    @classmethod
    def read(cls, values: Any, capture: Capture, where: str) -> Annotations:
        """From plain values; clicks are sorted by frame. Raises InputError that names the point, the camera and the rule."""
        if not isinstance(values, dict):
            raise InputError(where, "a JSON object is required", type(values).__name__)
        parsed = parse(cls, values, where)
        names = [point.name for point in parsed.points]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(where, "names of points must differ", twice[0])
        points = []
        for number, point in enumerate(parsed.points):
            clicks = {}
            for camera, given in point.clicks.items():
                _check(given, capture, camera, f"{where}: points.{number} ({point.name}), camera {camera}")
                clicks[camera] = tuple(sorted(given, key=lambda click: click.frame))
            points.append(Point(name=point.name, clicks=clicks))
        return cls(points=tuple(points))

    @classmethod
    def load(cls, capture: Capture) -> Annotations:
        """The capture's file; no points where there is none. Raises InputError."""
        path = capture.folder / ANNOTATIONS
        return cls.read(load_json(path), capture, str(path)) if path.exists() else cls()

    def save(self, folder: Path) -> None:
        """Write the file of a capture's folder."""
        write_text(folder / ANNOTATIONS, json.dumps(self.plain(), indent=1) + "\n")

    def plain(self) -> dict[str, Any]:
        """As plain JSON values; what a click does not say is left out."""
        values = plain(self)
        for point in values["points"]:
            for clicks in point["clicks"].values():
                for click in clicks:
                    for key in [key for key, value in click.items() if value is None or value is False]:
                        del click[key]
        return values


def _check(clicks: tuple[Click, ...], capture: Capture, camera: str, where: str) -> None:
    if camera not in capture.cameras:
        raise InputError(where, f"must be one of the cameras {list(capture.cameras)}", repr(camera))
    frames = [click.frame for click in clicks]
    if len(set(frames)) < len(frames):
        raise InputError(where, "one click a frame", f"two in frame {next(f for f in frames if frames.count(f) > 1)}")
    size = capture.cameras[camera]
    for click in clicks:
        if click.frame >= capture.frame_count:
            raise InputError(where, f"frames must lie below {capture.frame_count}", click.frame)
        if not capture.has(camera, click.frame):
            raise InputError(where, "a click needs an image", f"frame {click.frame}, which this camera missed")
        if click.hidden != (click.x is None) or click.hidden != (click.y is None):
            raise InputError(where, "a click has x and y, or it is hidden", f"frame {click.frame}")
        if click.place and not (-0.5 <= click.place[0] <= size.width - 0.5 and -0.5 <= click.place[1] <= size.height - 0.5):
            raise InputError(where, f"x and y must lie in the {size.width} x {size.height} image", click.place)
