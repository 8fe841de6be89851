"""Dense tracking without a network: pyramidal Lucas-Kanade with a forward-backward check.

Points start in frame 0 on random pixels inside the masks. A point is lost if it fails the check, leaves the image or its mask, or
disagrees with the motion of its neighbors. In each later frame, Lucas-Kanade from frame 0 searches lost points where their
neighbors moved, and accepts a match if the patches correlate.
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
"""Largest number of tracked pixels per camera, random in the masks of frame 0."""
LEVELS = 3
"""Levels of the image pyramid above the image itself."""
TRACK_BACKWARD = 0.5
"""Largest forward-backward error, pixels."""
FLOW_SIDE = 9
"""Side of the Lucas-Kanade window, pixels; a large window averages over deformation and background."""
PATCH = 9
"""Side of compared patches, pixels."""
LIKENESS = 0.85
"""Smallest correlation of a recovered patch with the patch of frame 0."""
LOST_GUIDES = 6
"""Number of nearest tracked points in frame 0 whose motion predicts a lost point."""
VOTERS = 8
"""Number of neighbors that vote on the motion of a point."""
CONSENSUS = 4.0
"""Largest difference of a point's motion since frame 0 from the median of its neighbors, pixels."""
EQUALIZED_WIDTH = 2.0
"""Width over which brightness and contrast are normalized, pixels, so that shading does not bias Lucas-Kanade."""
FAINT = 4.0
"""Local deviation below which contrast is not amplified further, gray levels; weaker contrast is noise."""
CONTRAST = 40.0
"""Gray levels of one local standard deviation after normalization."""
STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
REMAP_LIMIT = 30000
"""Largest number of points per call of cv2.remap, which accepts fewer than 32768 per side."""


@dataclass(frozen=True, eq=False)
class Followed:
    """Positions of the points of frame 0 in all frames."""

    pixels: np.ndarray
    """[T, Q, 2] (x, y)."""
    visible: np.ndarray
    """[T, Q] bool."""

    @classmethod
    def starting_at(cls, start: np.ndarray, frames: int) -> Followed:
        """Points [Q, 2] that do not move and are visible only in frame 0."""
        visible = np.zeros((frames, len(start)), dtype=bool)
        visible[0] = True
        return cls(np.repeat(start[None], frames, axis=0), visible)


def track(capture: Capture, camera: str, labels: np.ndarray, settings: PointTracking) -> Followed:
    """Track up to MOST_TRACKED pixels of the masks `labels` [T, H, W]; none if frame 0 shows neither object nor hands."""
    return follow(capture, camera, labels, choose(labels[0]), settings)


def follow(capture: Capture, camera: str, labels: np.ndarray, start: np.ndarray, settings: PointTracking) -> Followed:
    """Track points (x, y) [Q, 2] float32 of frame 0 through the masks `labels` [T, H, W].

    Each point belongs to the nearest label in frame 0, which must show object or hands. Points of one label vote on their motion.
    """
    own = _labels_at(labels[0], start)
    if (outside := own == NOTHING).any():
        y, x = np.nonzero(np.isin(labels[0], (OBJECT, HANDS)))
        own[outside] = labels[0][y, x][cKDTree(np.stack([x, y], axis=1)).query(start[outside])[1]]
    result = Followed.starting_at(start, capture.frame_count)
    pixels, visible = result.pixels, result.visible
    first = before = equalized(gray(capture, camera, 0))
    last = 0
    for frame in range(1, capture.frame_count):
        pixels[frame] = pixels[frame - 1]
        if not capture.has(camera, frame):
            continue
        now = equalized(gray(capture, camera, frame))
        position, alive = pixels[last].copy(), visible[last].copy()
        if alive.any():
            position[alive], alive[alive] = lucas_kanade(before, now, position[alive], position[alive], FLOW_SIDE)
        alive &= inside(position, now.shape)
        alive |= _reacquire(first, now, start, position, alive)
        alive &= _held(labels[frame], position, own, settings.rim)
        for label in np.unique(own):
            _outvote(start, position, alive, own == label)
        pixels[frame], visible[frame] = np.where(alive[:, None], position, pixels[last]), alive
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
    """Positions in the target [n, 2] near the `guess`, and whether the forward-backward check succeeds [n]."""
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    options: dict[str, Any] = {"winSize": (window, window), "maxLevel": levels, "criteria": STOP, "flags": flags}
    points = np.ascontiguousarray(points, dtype=np.float32)
    # OpenCV writes its result into the guess.
    moved, there, _ = cv2.calcOpticalFlowPyrLK(source, target, points, np.array(guess, dtype=np.float32), **options)
    returned, back, _ = cv2.calcOpticalFlowPyrLK(target, source, moved, points.copy(), **options)
    near = np.linalg.norm(returned - points, axis=1) < TRACK_BACKWARD
    return np.asarray(moved), there.ravel().astype(bool) & back.ravel().astype(bool) & near


def _reacquire(first: np.ndarray, now: np.ndarray, start: np.ndarray, position: np.ndarray, alive: np.ndarray) -> np.ndarray:
    """True for lost points that are found again [Q]; writes their positions into `position`."""
    lost, guides = np.flatnonzero(~alive), np.flatnonzero(alive)
    again = np.zeros(len(start), dtype=bool)
    if not len(lost):
        return again
    guess = position[lost]
    if len(guides) >= LOST_GUIDES:
        nearest = guides[cKDTree(start[guides]).query(start[lost], k=LOST_GUIDES)[1]]
        guess = start[lost] + np.median((position - start)[nearest], axis=1)
    moved, ok = lucas_kanade(first, now, start[lost], guess, FLOW_SIDE)
    ok &= np.linalg.norm(moved - guess, axis=1) < FLOW_SIDE
    ok &= inside(moved, now.shape)
    if ok.any():
        ok[ok] = likeness(first, now, start[lost][ok], moved[ok]) > LIKENESS
        position[lost[ok]] = moved[ok]
        again[lost[ok]] = True
    return again


def _outvote(start: np.ndarray, position: np.ndarray, alive: np.ndarray, group: np.ndarray) -> None:
    """Mark points of the group as lost if they disagree with the motion of their neighbors in frame 0."""
    points = np.flatnonzero(alive & group)
    if len(points) <= VOTERS:
        return
    motion = (position - start)[points]
    near = cKDTree(start[points]).query(start[points], k=VOTERS + 1)[1][:, 1:]
    off = np.linalg.norm(motion - np.median(motion[near], axis=1), axis=1)
    alive[points[off > CONSENSUS]] = False


def _labels_at(labels: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Labels [n] at the pixels nearest to points (x, y)."""
    x, y = np.round(points).astype(int).T
    return np.asarray(labels[np.clip(y, 0, labels.shape[0] - 1), np.clip(x, 0, labels.shape[1] - 1)])


def _held(labels: np.ndarray, points: np.ndarray, own: np.ndarray, rim: float) -> np.ndarray:
    """True for points (x, y) [n, 2] within `rim` pixels of their own labels [n]."""
    on: np.ndarray = _labels_at(labels, points) == own
    if rim > 0:
        for label in np.unique(own[~on]):
            off = np.flatnonzero(~on & (own == label))
            away = cv2.distanceTransform((labels != label).astype(np.uint8), cv2.DIST_L2, 5)
            on[off] = _labels_at(away, points[off]) <= rim
    return on


def likeness(first: np.ndarray, now: np.ndarray, here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Normalized correlation [n] of the patches around `here` in the first image and `there` in the present one."""
    before, after = _patches(first, here), _patches(now, there)
    norms = np.maximum(np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1), 1e-6)
    return np.asarray((before * after).sum(axis=1) / norms)


def _patches(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Patches [n, PATCH^2] around points (x, y), minus their means."""
    offsets = np.stack(np.meshgrid(*[np.arange(PATCH) - PATCH // 2] * 2), axis=-1).reshape(-1, 2)
    pixels = (points[:, None] + offsets).reshape(-1, 2)
    patches = _sample(image.astype(np.float32)[..., None], pixels).reshape(len(points), -1)
    return np.asarray(patches - patches.mean(axis=1, keepdims=True))


def _sample(field: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Bilinear samples [n, k] of an image [H, W, k] at points (x, y); the border is replicated."""
    x, y = points.astype(np.float32).T[..., None]
    parts = [slice(k, k + REMAP_LIMIT) for k in range(0, len(x), REMAP_LIMIT)]
    rows = [cv2.remap(field, x[part], y[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for part in parts]
    return np.concatenate(rows).reshape(len(points), -1)


def inside(points: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """True for points (x, y) [n, 2] inside an image of a shape."""
    return np.asarray((points >= 0).all(axis=1) & (points[:, 0] <= shape[1] - 1) & (points[:, 1] <= shape[0] - 1))


def equalized(image: np.ndarray) -> np.ndarray:
    """Normalize a gray image [H, W] uint8 for Lucas-Kanade: subtract its local mean, divide by its local deviation."""
    centered = image.astype(np.float32) - cv2.GaussianBlur(image.astype(np.float32), (0, 0), EQUALIZED_WIDTH)
    deviation = np.sqrt(cv2.GaussianBlur(centered**2, (0, 0), EQUALIZED_WIDTH) + FAINT**2)
    return np.asarray(np.clip(128.0 + CONTRAST * centered / deviation, 0, 255).astype(np.uint8))
