"""Clicks on points that a person follows through a video: their file, and a point through the video of one camera.

The file is `annotations.json` in the capture's folder:

    {"format": 1, "points": [
      {"name": "left ear", "clicks": {"0": [{"frame": 0, "x": 61.5, "y": 40.0}, {"frame": 9, "hidden": true}]}}]}

A click says where the point is in a frame of a camera; pixels as in data/capture.py. `hidden` says that the camera does not see the
point from this frame on, until the next click.

From each click on the point is followed by Lucas-Kanade, forward and backward, blended in between: between the clicks of frames
a < b the place in frame t is ((b - t) f + (t - a) g) / (b - a), where f follows the point from a on and g from b back. Where only
one of them holds, it counts alone, and where none does the place is unknown. Beyond the first and the last click one direction is
all there is. Each step starts from the frame before. Then the patch of the click is looked for beside the result, so that small
errors do not add up.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import Field, StringConstraints

from neuspring.config import parse, plain
from neuspring.core.errors import InputError
from neuspring.core.files import load_json, write_text
from neuspring.core.section import STRICT, Finite
from neuspring.data.capture import Capture
from neuspring.data.frames import gray
from neuspring.perception.track_opencv import LEVELS, equalized, inside, likeness, lucas_kanade

ANNOTATIONS = "annotations.json"
MOST_CLICKED_POINTS, MOST_CLICKS = 500, 5000
"""Points in a file, and clicks on one point in one camera: limits for what a browser may send."""
FLOW_WINDOW = 13
"""Side of the Lucas-Kanade window, pixels: a point alone has no neighbors that vote, so it needs more texture than one of many."""
CROP = 80
"""Half the side, pixels, of the part of the images around a point that Lucas-Kanade sees."""
SLIP = 3.0
"""Pixels by which the click's patch may lie beside the place that was followed, for it to correct the place."""
ALIKE = 0.7
"""Smallest correlation with the click's patch for it to correct a place."""
FOUND_AGAIN = 0.85
"""Smallest correlation with the click's patch for a lost point to be found again."""
SURROUND = 17
"""Side of the part of an image, pixels, from which compared patches are cut."""
KEPT_BYTES = 400_000_000
"""Bytes of gray images that are kept."""
Title = Annotated[str, StringConstraints(min_length=1, max_length=80, pattern=r"^[^\x00-\x1f\x7f]+$")]
CameraName = Annotated[str, StringConstraints(max_length=80)]


@dataclass(frozen=True, kw_only=True)
class Click:
    """Place of a point in one frame of one camera, or the mark that it is hidden from here on."""

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
class ClickedPoint:
    """One point of the object, and its clicks by camera."""

    __pydantic_config__ = STRICT
    name: Title
    clicks: dict[CameraName, Annotated[tuple[Click, ...], Field(max_length=MOST_CLICKS)]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Annotations:
    """All points of a capture."""

    __pydantic_config__ = STRICT
    format: Literal[1] = 1
    points: Annotated[tuple[ClickedPoint, ...], Field(max_length=MOST_CLICKED_POINTS)] = ()

    @classmethod
    def read(cls, values: Any, capture: Capture, where: str) -> Annotations:
        """Annotations of plain values, clicks sorted by frame. Raises InputError that names the point, the camera and the rule."""
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
            points.append(ClickedPoint(name=point.name, clicks=clicks))
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
        """The annotations as plain JSON values; fields that a click does not set are left out."""
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


@dataclass(frozen=True, eq=False)
class Trail:
    """Place of a point in every frame of one camera."""

    places: np.ndarray
    """(x, y) [T, 2], pixels; NaN where hidden, lost, or without an image."""
    apart: np.ndarray
    """Distance between the places of the two directions [T], pixels; NaN where one stands alone."""
    alike: np.ndarray
    """Correlation with the nearer click's patch [T]; NaN where unknown."""


@dataclass(frozen=True, eq=False)
class OneWay:
    """Result of following from one click: places (x, y), pixels, and likeness, by frame."""

    places: dict[int, np.ndarray]
    alike: dict[int, float]


class GrayImages:
    """Gray images [H, W] uint8 of a capture for Lucas-Kanade, by camera and frame; the last ones asked for are kept."""

    def __init__(self, capture: Capture) -> None:
        self.capture = capture
        largest = max(view.width * view.height for view in capture.cameras.values())
        kept = max(2, KEPT_BYTES // largest)
        self._read = lru_cache(kept)(lambda camera, frame: equalized(gray(capture, camera, frame)))

    def __call__(self, camera: str, frame: int) -> np.ndarray:
        """The image. Raises InputError."""
        return self._read(camera, frame)


def follow(images: GrayImages, camera: str, clicks: Sequence[Click], run: Callable[..., OneWay] | None = None) -> Trail:
    """The trail of a point that was clicked in some frames of a camera.

    `clicks` are sorted by frame. `run` stands in for `follow_from`, with results that it kept from before.
    """
    run = run or follow_from
    frames = images.capture.frame_count
    trail = Trail(np.full((frames, 2), np.nan), np.full(frames, np.nan), np.full(frames, np.nan))
    for number, click in enumerate(clicks):
        before, after = (clicks[number - 1] if number else None), (clicks[number + 1] if number + 1 < len(clicks) else None)
        if click.place is None:
            continue
        trail.places[click.frame], trail.apart[click.frame], trail.alike[click.frame] = click.place, 0.0, 1.0
        if before is None:
            _write(trail, run(images, camera, click, -1, None), None, click.frame, -1)
        if after is None or after.place is None:
            end = frames if after is None else after.frame
            _write(trail, run(images, camera, click, end, None), None, click.frame, end)
        else:
            forward, backward = run(images, camera, click, after.frame, after), run(images, camera, after, click.frame, click)
            _write(trail, forward, backward, click.frame, after.frame)
    return trail


def follow_from(images: GrayImages, camera: str, click: Click, stop: int, aim: Click | None) -> OneWay:
    """Follow a click to the frame before `stop`, in either direction; `aim` is the click there, if there is one."""
    assert click.place is not None
    start = np.array(click.place)
    template, before = images(camera, click.frame), images(camera, click.frame)
    last, motion, alive = start, np.zeros(2), True
    found = OneWay({}, {})
    step = 1 if stop > click.frame else -1
    for frame in range(click.frame + step, stop, step):
        if not images.capture.has(camera, frame):
            continue
        now = images(camera, frame)
        place = _best(before, now, last, [last + motion, last]) if alive else None
        if place is not None:
            sharper = _look(template, now, start, place)
            near = sharper is not None and np.linalg.norm(sharper - place) < SLIP
            if sharper is not None and near and _alike(template, now, start, sharper) > ALIKE:
                place = sharper
        else:
            # A lost point is looked for on the way from the click to the next one, or where it was last seen.
            share = (frame - click.frame) / (stop - click.frame)
            guess = last if aim is None or aim.place is None else (1 - share) * start + share * np.array(aim.place)
            place = _look(template, now, start, guess)
            if place is not None and (
                np.linalg.norm(place - guess) > 2 * FLOW_WINDOW or _alike(template, now, start, place) < FOUND_AGAIN
            ):
                place = None
        alive = place is not None
        if place is not None:
            found.places[frame], found.alike[frame] = place, _alike(template, now, start, place)
            motion = np.clip(place - last, -CROP / 2, CROP / 2) if frame - step in found.places else np.zeros(2)
            last, before = place, now
    return found


def _write(trail: Trail, forward: OneWay, backward: OneWay | None, start: int, stop: int) -> None:
    """Blend the runs of the frames between `start` and `stop` into the trail."""
    step = 1 if stop > start else -1
    for frame in range(start + step, stop, step):
        one, other = forward.places.get(frame), backward.places.get(frame) if backward else None
        if one is not None and other is not None and backward:
            share = (frame - start) / (stop - start)
            trail.places[frame] = (1 - share) * one + share * other
            trail.apart[frame] = np.linalg.norm(one - other)
            trail.alike[frame] = forward.alike[frame] if share < 0.5 else backward.alike[frame]
        elif one is not None:
            trail.places[frame], trail.alike[frame] = one, forward.alike[frame]
        elif other is not None and backward:
            trail.places[frame], trail.alike[frame] = other, backward.alike[frame]


def _best(source: np.ndarray, target: np.ndarray, point: np.ndarray, guesses: Sequence[np.ndarray]) -> np.ndarray | None:
    """The place in the target that looks most like the point in the source: from several guesses, with all levels and with few."""
    places = [_look(source, target, point, guess, levels) for guess in guesses for levels in (LEVELS, 1)]
    known = [place for place in places if place is not None]
    return max(known, key=lambda place: _alike(source, target, point, place), default=None)


def _look(source: np.ndarray, target: np.ndarray, point: np.ndarray, guess: np.ndarray, levels: int = LEVELS) -> np.ndarray | None:
    """Lucas-Kanade in parts of the images around the point and the guess; None where it fails or leaves the image."""
    if not inside(guess[None], target.shape)[0]:
        return None
    here, there = _corner(point, source.shape), _corner(guess, target.shape)
    parts = _part(source, here), _part(target, there)
    place, ok = lucas_kanade(*parts, (point - here)[None], (guess - there)[None], FLOW_WINDOW, levels)
    found = place[0].astype(float) + there
    return found if ok[0] and inside(found[None], target.shape)[0] else None


def _corner(point: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The corner (x, y) of the part around a point."""
    most = np.maximum(np.array(shape[1::-1]) - 2 * CROP, 0)
    return np.asarray(np.clip(np.round(point).astype(int) - CROP, 0, most))


def _part(image: np.ndarray, corner: np.ndarray) -> np.ndarray:
    x, y = corner
    return np.ascontiguousarray(image[y : y + 2 * CROP, x : x + 2 * CROP])


def _alike(source: np.ndarray, target: np.ndarray, point: np.ndarray, place: np.ndarray) -> float:
    """Correlation of the patches around two places."""
    size = (SURROUND, SURROUND)
    one, other = (cv2.getRectSubPix(image, size, tuple(map(float, at))) for image, at in ((source, point), (target, place)))
    middle = np.full((1, 2), SURROUND // 2)
    return float(likeness(one, other, middle, middle)[0])
