"""One point through the video of one camera: Lucas-Kanade from each click on, forward and backward, blended in between.

Between the clicks of frames a < b the place in frame t is ((b - t) f + (t - a) g) / (b - a), where f follows the point from a on
and g from b back. Where only one of them holds, it counts alone, and where none does the place is unknown. Beyond the first and the
last click one direction is all there is. Each step starts from the frame before. Then the patch of the click is looked for beside
the result, so that small errors do not add up.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Lock

import cv2
import numpy as np

from neuspring.data.capture import Capture
from neuspring.perception.annotate.annotations import Click
from neuspring.perception.frames import gray
from neuspring.perception.track_opencv import LEVELS, equalized, inside, likeness, lucas_kanade

WINDOW = 13
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
CACHE_BYTES = 400_000_000
"""Gray images that are kept."""


@dataclass(frozen=True, eq=False)
class Trail:
    """Where a point is in every frame of one camera."""

    places: np.ndarray
    """(x, y) [T, 2], pixels; NaN where hidden, lost, or without an image."""
    apart: np.ndarray
    """How far the two directions lie apart [T], pixels; NaN where one stands alone."""
    alike: np.ndarray
    """Correlation with the nearer click's patch [T]; NaN where unknown."""

    @classmethod
    def empty(cls, frames: int) -> Trail:
        """Nothing is known."""
        return cls(np.full((frames, 2), np.nan), np.full(frames, np.nan), np.full(frames, np.nan))


@dataclass(frozen=True, eq=False)
class OneWay:
    """What following from one click found in other frames, by frame."""

    places: dict[int, np.ndarray]
    alike: dict[int, float]


class GrayImages:
    """Gray images of a capture for Lucas-Kanade; the last ones asked for are kept."""

    def __init__(self, capture: Capture) -> None:
        self.capture = capture
        self._kept: OrderedDict[tuple[str, int], np.ndarray] = OrderedDict()
        self._bytes, self._lock = 0, Lock()

    def __call__(self, camera: str, frame: int) -> np.ndarray:
        """The image [H, W] uint8. Raises InputError."""
        key = (camera, frame)
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        image = equalized(gray(self.capture, camera, frame))
        with self._lock:
            if key not in self._kept:
                self._bytes += image.nbytes
            self._kept[key] = image
            while self._bytes > CACHE_BYTES and len(self._kept) > 2:
                self._bytes -= self._kept.popitem(last=False)[1].nbytes
        return image


def follow(images: GrayImages, camera: str, clicks: Sequence[Click], *, run: Callable[..., OneWay] | None = None) -> Trail:
    """The trail of a point that was clicked in some frames of a camera.

    `clicks` are sorted by frame. `run` stands in for `follow_from`, with results that it kept from before.
    """
    run = run or follow_from
    frames = images.capture.frame_count
    trail = Trail.empty(frames)
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
            place = _again(template, now, start, _guess(last, click, frame, stop, aim))
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


def _guess(last: np.ndarray, click: Click, frame: int, stop: int, aim: Click | None) -> np.ndarray:
    """Where a lost point may be: on the way from the click to the next one, or where it was last seen."""
    if aim is None or aim.place is None or click.place is None:
        return last
    share = (frame - click.frame) / (stop - click.frame)
    return (1 - share) * np.array(click.place) + share * np.array(aim.place)


def _best(source: np.ndarray, target: np.ndarray, point: np.ndarray, guesses: Sequence[np.ndarray]) -> np.ndarray | None:
    """The place in the target that looks most like the point in the source: from several guesses, with all levels and with few."""
    places = [_look(source, target, point, guess, levels) for guess in guesses for levels in (LEVELS, 1)]
    known = [place for place in places if place is not None]
    return max(known, key=lambda place: _alike(source, target, point, place), default=None)


def _again(template: np.ndarray, now: np.ndarray, start: np.ndarray, guess: np.ndarray) -> np.ndarray | None:
    """A lost point, where it is seen again near the guess."""
    place = _look(template, now, start, guess)
    if place is None or np.linalg.norm(place - guess) > 2 * WINDOW or _alike(template, now, start, place) < FOUND_AGAIN:
        return None
    return place


def _look(source: np.ndarray, target: np.ndarray, point: np.ndarray, guess: np.ndarray, levels: int = LEVELS) -> np.ndarray | None:
    """Lucas-Kanade in parts of the images around the point and the guess; None where it fails or leaves the image."""
    if not inside(guess[None], target.shape)[0]:
        return None
    here, there = _corner(point, source.shape), _corner(guess, target.shape)
    place, ok = lucas_kanade(_part(source, here), _part(target, there), (point - here)[None], (guess - there)[None], WINDOW, levels)
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
    one, other = (
        cv2.getRectSubPix(image, (SURROUND, SURROUND), tuple(map(float, at))) for image, at in ((source, point), (target, place))
    )
    middle = np.full((1, 2), SURROUND // 2)
    return float(likeness(one, other, middle, middle)[0])
