"""Dense tracking without a network: pyramidal Lucas-Kanade, or DIS optical flow, both with a forward-backward check.

Points start in frame 0 on a grid of random pixels inside the masks. A point that fails the check, leaves the image or its mask, or
moves otherwise than its neighbours is lost. Lost points are looked for again from their first appearance: where their neighbours
of frame 0 went, by Lucas-Kanade from frame 0, accepted if the patch looks alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from neuspring.config.perception import OpenCvTracking
from neuspring.data.capture import Capture

PATCH = 9
"""Side of compared patches, pixels."""
GUIDES = 6
"""Nearest living points of frame 0, whose motion says where a lost point may be."""
NEIGHBOURS = 8
"""That vote on a point's motion."""
FAINT = 4.0
"""Grey levels of deviation below which contrast is not raised further: noise."""
CONTRAST = 40.0
"""Grey levels that one local deviation becomes."""
STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)


@dataclass(frozen=True, eq=False)
class Followed:
    """Points so far."""

    pixels: np.ndarray
    """[T, Q, 2]."""
    visible: np.ndarray
    """[T, Q] bool."""


def track(capture: Capture, camera: str, labels: np.ndarray, settings: OpenCvTracking, seed: int) -> Followed:
    """Follow up to `settings.points` pixels of the masks `labels` [T, H, W]; none where frame 0 shows neither object nor hands."""
    start = choose(labels[0], settings.points, seed)
    frames, count = capture.frame_count, len(start)
    own = _labels_at(labels[0], start)
    found = Followed(np.repeat(start[None], frames, axis=0), np.zeros((frames, count), dtype=bool))
    found.visible[0] = True
    first = before = _seen(capture, camera, 0, settings)
    flow = _dense_flow() if settings.method == "dis" else None
    last = 0
    for frame in range(1, frames):
        found.pixels[frame] = found.pixels[frame - 1]
        if not capture.has(camera, frame):
            continue
        now = _seen(capture, camera, frame, settings)
        alive = found.visible[last].copy()
        place = found.pixels[last].copy()
        if alive.any():
            moved, kept = _follow(before, now, place[alive], settings, flow)
            place[alive] = moved
            alive = _put(alive, kept)
        alive &= _inside(place, now.shape)
        if settings.reacquire:
            alive |= _reacquire(first, now, start, place, alive, settings)
        alive &= _labels_at(labels[frame], place) == own
        for label in np.unique(own):
            _outvote(start, place, alive, own == label, settings)
        found.pixels[frame], found.visible[frame] = np.where(alive[:, None], place, found.pixels[last]), alive
        before, last = now, frame
    return found


def choose(labels: np.ndarray, count: int, seed: int) -> np.ndarray:
    """At most `count` random pixels (x, y) [Q, 2] of object and hands."""
    y, x = np.nonzero(labels)
    pixels = np.stack([x, y], axis=1).astype(np.float32)
    if len(pixels) <= count:
        return pixels
    return pixels[np.sort(np.random.default_rng(seed).choice(len(pixels), count, replace=False))]


def _dense_flow() -> cv2.DISOpticalFlow:
    """DIS flow down to whole pixels; its presets stop at every second or fourth."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setFinestScale(0)
    return flow


def _follow(
    before: np.ndarray, now: np.ndarray, points: np.ndarray, settings: OpenCvTracking, flow: cv2.DISOpticalFlow | None
) -> tuple[np.ndarray, np.ndarray]:
    """Places in the next frame [n, 2], and whether going back returns to the start [n]."""
    if flow is None:
        return _lucas_kanade(before, now, points, points, settings)
    there, back = flow.calc(before, now, None), flow.calc(now, before, None)  # type: ignore[call-overload]
    moved = points + _sample(there, points)
    returned = moved + _sample(back, moved)
    return moved, np.linalg.norm(returned - points, axis=1) < settings.forward_backward


def _lucas_kanade(
    source: np.ndarray, target: np.ndarray, points: np.ndarray, guess: np.ndarray, settings: OpenCvTracking
) -> tuple[np.ndarray, np.ndarray]:
    points = np.ascontiguousarray(points, dtype=np.float32)
    # OpenCV writes its result into the guess.
    moved, ok = _pyramidal(source, target, points, np.array(guess, dtype=np.float32), settings)
    returned, back = _pyramidal(target, source, moved, points.copy(), settings)
    near = np.linalg.norm(returned - points, axis=1) < settings.forward_backward
    return moved, ok & back & near


def _pyramidal(
    source: np.ndarray, target: np.ndarray, points: np.ndarray, guess: np.ndarray, settings: OpenCvTracking
) -> tuple[np.ndarray, np.ndarray]:
    """Places [n, 2], and whether they were found [n]."""
    moved, ok, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        points,
        guess,
        winSize=(settings.window, settings.window),
        maxLevel=settings.levels,
        criteria=STOP,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(moved), np.asarray(ok).ravel().astype(bool)


def _reacquire(
    first: np.ndarray,
    now: np.ndarray,
    start: np.ndarray,
    place: np.ndarray,
    alive: np.ndarray,
    settings: OpenCvTracking,
) -> np.ndarray:
    """Look for lost points; writes the places of those found into `place` and returns which they are."""
    searched, guides = np.flatnonzero(~alive), np.flatnonzero(alive)
    found = np.zeros(len(start), dtype=bool)
    if not len(searched):
        return found
    guess = place[searched]
    if len(guides) >= GUIDES:
        nearest = guides[cKDTree(start[guides]).query(start[searched], k=GUIDES)[1]]
        guess = start[searched] + np.median((place - start)[nearest], axis=1)
    moved, ok = _lucas_kanade(first, now, start[searched], guess, settings)
    ok &= np.linalg.norm(moved - guess, axis=1) < settings.window
    ok &= _inside(moved, now.shape)
    if not ok.any():
        return found
    ok[ok] = _alike(first, now, start[searched][ok], moved[ok]) > settings.likeness
    place[searched[ok]] = moved[ok]
    found[searched[ok]] = True
    return found


def _outvote(start: np.ndarray, place: np.ndarray, alive: np.ndarray, group: np.ndarray, settings: OpenCvTracking) -> None:
    """Points of the group that move otherwise than their neighbours of frame 0 are no longer alive."""
    points = np.flatnonzero(alive & group)
    if len(points) <= NEIGHBOURS:
        return
    motion = (place - start)[points]
    near = cKDTree(start[points]).query(start[points], k=NEIGHBOURS + 1)[1][:, 1:]
    off = np.linalg.norm(motion - np.median(motion[near], axis=1), axis=1)
    alive[points[off > settings.consensus]] = False


def _labels_at(labels: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Labels [n] of the pixels nearest to points (x, y)."""
    x, y = np.round(points).astype(int).T
    return np.asarray(labels[np.clip(y, 0, labels.shape[0] - 1), np.clip(x, 0, labels.shape[1] - 1)])


def _alike(first: np.ndarray, now: np.ndarray, here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Normalised correlation [n] of the patches around the points."""
    patches = [_patches(image, points) for image, points in ((first, here), (now, there))]
    centred = [patch - patch.mean(axis=1, keepdims=True) for patch in patches]
    norms = np.maximum(np.linalg.norm(centred[0], axis=1) * np.linalg.norm(centred[1], axis=1), 1e-6)
    return np.asarray((centred[0] * centred[1]).sum(axis=1) / norms)


def _patches(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    offsets = np.stack(np.meshgrid(*[np.arange(PATCH) - PATCH // 2] * 2), axis=-1).reshape(-1, 2)
    return _sample(image.astype(np.float32)[..., None], (points[:, None] + offsets).reshape(-1, 2)).reshape(len(points), -1)


def _sample(field: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Bilinear values [n, k] of an image [H, W, k] at points (x, y); the border is continued."""
    x, y = points[:, 0].astype(np.float32), points[:, 1].astype(np.float32)
    # remap takes images of less than 32768 points a side.
    rows = [
        cv2.remap(field, x[k : k + 30000, None], y[k : k + 30000, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for k in range(0, len(x), 30000)
    ]
    return np.concatenate(rows).reshape(len(points), -1)


def _inside(points: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return np.asarray((points >= 0).all(axis=1) & (points[:, 0] <= shape[1] - 1) & (points[:, 1] <= shape[0] - 1))


def _put(mask: np.ndarray, values: np.ndarray) -> np.ndarray:
    """`mask` with its True entries replaced by `values`."""
    result = mask.copy()
    result[mask] = values
    return result


def _seen(capture: Capture, camera: str, frame: int, settings: OpenCvTracking) -> np.ndarray:
    """The grey image [H, W] uint8; for Lucas-Kanade less its local mean and divided by its local deviation."""
    grey = cv2.cvtColor(np.ascontiguousarray(capture.colour(camera, frame)), cv2.COLOR_RGB2GRAY)
    if settings.method == "dis" or not settings.local_contrast:
        return np.asarray(grey)
    width = settings.local_contrast
    centred = grey.astype(np.float32) - cv2.GaussianBlur(grey.astype(np.float32), (0, 0), width)
    deviation = np.sqrt(cv2.GaussianBlur(centred**2, (0, 0), width) + FAINT**2)
    return np.asarray(np.clip(128.0 + CONTRAST * centred / deviation, 0, 255).astype(np.uint8))
