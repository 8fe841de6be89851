"""Dense tracking without a network: pyramidal Lucas-Kanade with a forward-backward check.

Points start in frame 0 on random pixels inside the masks. A point is lost if it fails the check, leaves the image or its mask, or
moves otherwise than its neighbors. Lost points are looked for again in every frame: where their neighbors of frame 0 went, by
Lucas-Kanade from frame 0, accepted if the patch looks alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from neuspring.config.perception import PointTracking
from neuspring.data.capture import HANDS, NOTHING, OBJECT, Capture
from neuspring.data.frames import gray
from neuspring.perception.film import PERCEPTION_SEED

MOST_TRACKED = 5000
"""Pixels that are followed per camera, drawn at random from the masks of frame 0."""
LEVELS = 3
"""Levels of the image pyramid, beside the image itself."""
TRACK_BACKWARD = 0.5
"""Largest distance, pixels, by which a point may miss its start when it is followed there and back."""
FLOW_SIDE = 9
"""Side of the Lucas-Kanade window, pixels. A large window averages over deformation and background."""
PATCH = 9
"""Side of compared patches, pixels."""
LIKENESS = 0.85
"""Least correlation of a patch that is found again with the point's patch of frame 0."""
LOST_GUIDES = 6
"""Nearest living points of frame 0, whose motion says where a lost point may be."""
VOTERS = 8
"""Neighbors that vote on a point's motion."""
CONSENSUS = 4.0
"""Pixels by which a point's motion since frame 0 may differ from the median of its neighbors'."""
EQUALIZED_WIDTH = 2.0
"""Width, pixels, over which brightness and contrast are made equal for Lucas-Kanade, so that shading does not pull."""
FAINT = 4.0
"""Gray levels of deviation below which contrast is not raised further: noise."""
CONTRAST = 40.0
"""Gray levels that one local deviation becomes."""
STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
REMAP_LIMIT = 30000
"""Points per call of cv2.remap, which takes images of less than 32768 points a side."""


@dataclass(frozen=True, eq=False)
class Followed:
    """Places of points of frame 0 in every frame."""

    pixels: np.ndarray
    """[T, Q, 2]."""
    visible: np.ndarray
    """[T, Q] bool."""

    @classmethod
    def starting_at(cls, start: np.ndarray, frames: int) -> Followed:
        """Points [Q, 2] that stay where they are and are visible in frame 0 alone."""
        visible = np.zeros((frames, len(start)), dtype=bool)
        visible[0] = True
        return cls(np.repeat(start[None], frames, axis=0), visible)


def track(capture: Capture, camera: str, labels: np.ndarray, settings: PointTracking) -> Followed:
    """Follow up to MOST_TRACKED pixels of the masks `labels` [T, H, W]; none where frame 0 shows neither object nor hands."""
    return follow(capture, camera, labels, choose(labels[0]), settings)


def follow(capture: Capture, camera: str, labels: np.ndarray, start: np.ndarray, settings: PointTracking) -> Followed:
    """Follow points (x, y) [Q, 2] float32 of frame 0; they belong to its nearest label, and vote on each other's motion.

    `labels` [T, H, W] are masks; frame 0 must show object or hands.
    """
    own = _labels_at(labels[0], start)
    if (beside := own == NOTHING).any():
        y, x = np.nonzero(np.isin(labels[0], (OBJECT, HANDS)))
        own[beside] = labels[0][y, x][cKDTree(np.stack([x, y], axis=1)).query(start[beside])[1]]
    result = Followed.starting_at(start, capture.frame_count)
    pixels, visible = result.pixels, result.visible
    first = before = equalized(gray(capture, camera, 0))
    last = 0
    for frame in range(1, capture.frame_count):
        pixels[frame] = pixels[frame - 1]
        if not capture.has(camera, frame):
            continue
        now = equalized(gray(capture, camera, frame))
        place, alive = pixels[last].copy(), visible[last].copy()
        if alive.any():
            place[alive], alive[alive] = lucas_kanade(before, now, place[alive], place[alive], FLOW_SIDE)
        alive &= inside(place, now.shape)
        alive |= _reacquire(first, now, start, place, alive)
        alive &= _held(labels[frame], place, own, settings.rim)
        for label in np.unique(own):
            _outvote(start, place, alive, own == label)
        pixels[frame], visible[frame] = np.where(alive[:, None], place, pixels[last]), alive
        before, last = now, frame
    return result


def choose(labels: np.ndarray, count: int | None = None) -> np.ndarray:
    """At most `count` (MOST_TRACKED) random pixels (x, y) [Q, 2] of object and hands."""
    count = count or MOST_TRACKED
    y, x = np.nonzero(np.isin(labels, (OBJECT, HANDS)))
    pixels = np.stack([x, y], axis=1).astype(np.float32)
    if len(pixels) <= count:
        return pixels
    return pixels[np.sort(np.random.default_rng(PERCEPTION_SEED).choice(len(pixels), count, replace=False))]


def lucas_kanade(
    source: np.ndarray, target: np.ndarray, points: np.ndarray, guess: np.ndarray, window: int, levels: int = LEVELS
) -> tuple[np.ndarray, np.ndarray]:
    """Places in the target [n, 2] near the `guess`, and whether going back returns to the start [n]."""
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    options: dict[str, Any] = {"winSize": (window, window), "maxLevel": levels, "criteria": STOP, "flags": flags}
    points = np.ascontiguousarray(points, dtype=np.float32)
    # OpenCV writes its result into the guess.
    moved, there, _ = cv2.calcOpticalFlowPyrLK(source, target, points, np.array(guess, dtype=np.float32), **options)
    returned, back, _ = cv2.calcOpticalFlowPyrLK(target, source, moved, points.copy(), **options)
    near = np.linalg.norm(returned - points, axis=1) < TRACK_BACKWARD
    return np.asarray(moved), there.ravel().astype(bool) & back.ravel().astype(bool) & near


def _reacquire(first: np.ndarray, now: np.ndarray, start: np.ndarray, place: np.ndarray, alive: np.ndarray) -> np.ndarray:
    """Which lost points are seen again [Q] bool; their places are written into `place`."""
    lost, guides = np.flatnonzero(~alive), np.flatnonzero(alive)
    again = np.zeros(len(start), dtype=bool)
    if not len(lost):
        return again
    guess = place[lost]
    if len(guides) >= LOST_GUIDES:
        nearest = guides[cKDTree(start[guides]).query(start[lost], k=LOST_GUIDES)[1]]
        guess = start[lost] + np.median((place - start)[nearest], axis=1)
    moved, ok = lucas_kanade(first, now, start[lost], guess, FLOW_SIDE)
    ok &= np.linalg.norm(moved - guess, axis=1) < FLOW_SIDE
    ok &= inside(moved, now.shape)
    if ok.any():
        ok[ok] = likeness(first, now, start[lost][ok], moved[ok]) > LIKENESS
        place[lost[ok]] = moved[ok]
        again[lost[ok]] = True
    return again


def _outvote(start: np.ndarray, place: np.ndarray, alive: np.ndarray, group: np.ndarray) -> None:
    """Points of the group that move otherwise than their neighbors of frame 0 are no longer alive."""
    points = np.flatnonzero(alive & group)
    if len(points) <= VOTERS:
        return
    motion = (place - start)[points]
    near = cKDTree(start[points]).query(start[points], k=VOTERS + 1)[1][:, 1:]
    off = np.linalg.norm(motion - np.median(motion[near], axis=1), axis=1)
    alive[points[off > CONSENSUS]] = False


def _labels_at(labels: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Labels [n] of the pixels nearest to points (x, y)."""
    x, y = np.round(points).astype(int).T
    return np.asarray(labels[np.clip(y, 0, labels.shape[0] - 1), np.clip(x, 0, labels.shape[1] - 1)])


def _held(labels: np.ndarray, points: np.ndarray, own: np.ndarray, rim: float) -> np.ndarray:
    """The points (x, y) [n, 2] that lie within `rim` pixels of their own labels [n], as bool [n]."""
    on: np.ndarray = _labels_at(labels, points) == own
    if rim > 0:
        for label in np.unique(own[~on]):
            off = np.flatnonzero(~on & (own == label))
            away = cv2.distanceTransform((labels != label).astype(np.uint8), cv2.DIST_L2, 5)
            on[off] = _labels_at(away, points[off]) <= rim
    return on


def likeness(first: np.ndarray, now: np.ndarray, here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Normalized correlation [n] of the patches around the points `here` in the first image and `there` in the other."""
    one, other = _patches(first, here), _patches(now, there)
    norms = np.maximum(np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1), 1e-6)
    return np.asarray((one * other).sum(axis=1) / norms)


def _patches(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The patches [n, PATCH^2] around points (x, y), less their means."""
    offsets = np.stack(np.meshgrid(*[np.arange(PATCH) - PATCH // 2] * 2), axis=-1).reshape(-1, 2)
    places = (points[:, None] + offsets).reshape(-1, 2)
    patches = _sample(image.astype(np.float32)[..., None], places).reshape(len(points), -1)
    return np.asarray(patches - patches.mean(axis=1, keepdims=True))


def _sample(field: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Bilinear values [n, k] of an image [H, W, k] at points (x, y); the border is continued."""
    x, y = points.astype(np.float32).T[..., None]
    parts = [slice(k, k + REMAP_LIMIT) for k in range(0, len(x), REMAP_LIMIT)]
    rows = [cv2.remap(field, x[part], y[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for part in parts]
    return np.concatenate(rows).reshape(len(points), -1)


def inside(points: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The points (x, y) [n, 2] that lie in an image of a shape, as bool [n]."""
    return np.asarray((points >= 0).all(axis=1) & (points[:, 0] <= shape[1] - 1) & (points[:, 1] <= shape[0] - 1))


def equalized(image: np.ndarray) -> np.ndarray:
    """A gray image [H, W] uint8, less its local mean and divided by its local deviation: what Lucas-Kanade gets."""
    centered = image.astype(np.float32) - cv2.GaussianBlur(image.astype(np.float32), (0, 0), EQUALIZED_WIDTH)
    deviation = np.sqrt(cv2.GaussianBlur(centered**2, (0, 0), EQUALIZED_WIDTH) + FAINT**2)
    return np.asarray(np.clip(128.0 + CONTRAST * centered / deviation, 0, 255).astype(np.uint8))
