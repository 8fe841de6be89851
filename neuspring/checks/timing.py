"""Time between two streams of one scene, measured: what moves, moves in both at the same moments.

A stream is motion per step and cell, a [T, n]: row t says how much changed from frame t - 1 to t, in n cells that both streams
share: parts of the image for color, depth and masks of a camera, parts of space for two cameras. With m(s) the mean over cells and
the steps that both have, the agreement after a shift by s frames is the correlation

    c(s) = sum (a_t - m) (b_{t+s} - m) / sqrt(sum (a_t - m)^2 sum (b_{t+s} - m)^2)

and the shift is where it is greatest, with a fraction by the parabola through three values. It is clear if it stays where it is
when any quarter of the time is left out. No name, number or time stamp is read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from neuspring.core.text import spans
from neuspring.data.camera import Camera, depth_noise
from neuspring.data.capture import Capture

WATCHED_WIDE, CELLS = 320, (24, 14)
"""Width, pixels, at which pictures are compared, and cells across and down."""
COLOR_STILL, COLOR_MOST = 6.0, 30.0
"""Change of a color value that is noise, and beyond which more says nothing."""
DEPTH_STILL = 4.0
"""Change of depth that is noise, in standard deviations of a sensor; beyond 5 times as much more says nothing."""
FEWEST = 8
"""Steps that both streams must have."""
AGREE = 0.25
"""Correlation from which two streams show the same motion. Real and rendered recordings have 0.5 to 0.85, two cameras 0.4."""
STALL, FEWEST_STALLS = 0.1, 3
"""Motion in a step, as a part of that in the steps before and after it, below which an encoded image repeats its predecessor; and
the number of such steps amid fast motion from which a recording repeats images. None of 67 real videos has so many."""
HALF, MENDABLE = 0.5, 0.75
"""Frames: a shift that is a finding, as is how far a clear one may move without a quarter of the time; and one that whole frames
mend."""
QUARTERS = 4
SPACE_CELLS, CELL = 9, (0.02, 0.25)
"""Cells across what moves in space, and the least and greatest side of one, m."""


@dataclass(frozen=True)
class Shift:
    """Shift in time of a stream against another."""

    frames: float
    """Frames by which the second shows what moves later than the first."""
    agreement: float
    """c at the shift."""
    spread: float
    """Frames: the most that it moves without a quarter of the time."""

    @property
    def known(self) -> bool:
        """True where both streams show one motion, so that their time is measured."""
        return self.agreement >= AGREE and self.spread < HALF

    @property
    def wrong(self) -> bool:
        """True where time is clearly off by half a frame or more."""
        return self.known and abs(self.frames) >= max(HALF, 2 * self.spread)

    def text(self, one: str, other: str) -> str:
        """The shift in words."""
        side = "later" if self.frames > 0 else "earlier"
        return f"{other} is {abs(self.frames):.1f} frames {side} than {one}, by what moves"


def measure(one: np.ndarray, other: np.ndarray, most: int | None = None) -> Shift | None:
    """The shift of `other` [T2, n] against `one` [T1, n], by at most `most` frames; NaN rows are unknown.

    None where too little moves.
    """
    a, b = (np.sqrt(rows.reshape(len(rows), -1)) for rows in (one, other))
    reach = min(most or max(len(a), len(b)), max(len(a), len(b)) - FEWEST)
    known = [np.isfinite(rows).all(axis=1) for rows in (a, b)]
    if reach < 1 or min(np.nansum(a), np.nansum(b)) <= 0 or min(map(np.sum, known)) < FEWEST:
        return None
    shifts = np.arange(-reach, reach + 1)
    if (whole := _peak(a, b, shifts, np.ones(len(a), bool))) is None:
        return None
    parts = []
    for part in np.array_split(np.flatnonzero(known[0] & (np.nansum(a, axis=1) > 0)), QUARTERS):
        kept = np.ones(len(a), bool)
        kept[part] = False
        parts.append(_peak(a, b, shifts[np.abs(shifts - round(whole[0])) <= 3], kept))
    spread = max(np.inf if part is None else abs(part[0] - whole[0]) for part in parts)
    return Shift(*whole, float(spread))


def _peak(a: np.ndarray, b: np.ndarray, shifts: np.ndarray, kept: np.ndarray) -> tuple[float, float] | None:
    """The shift with the greatest agreement, and that, over the rows of `a` that are `kept`."""
    values = np.array([_agreement(a, b, int(shift), kept) for shift in shifts])
    if not np.isfinite(values).any():
        return None
    k = int(np.nanargmax(values))
    fraction = 0.0
    if 0 < k < len(values) - 1 and np.isfinite(values[k - 1 : k + 2]).all():
        before, here, after = values[k - 1 : k + 2]
        fraction = 0.5 * (before - after) / min(before - 2 * here + after, -1e-12)
    return float(shifts[k] + np.clip(fraction, -0.5, 0.5)), float(values[k])


def _agreement(a: np.ndarray, b: np.ndarray, shift: int, kept: np.ndarray) -> float:
    """c(shift) over the rows of `a` that are `kept`; NaN of too few."""
    first, last = max(0, -shift), min(len(a), len(b) - shift)
    if last - first < FEWEST:
        return np.nan
    x, y = a[first:last], b[first + shift : last + shift]
    both = kept[first:last] & np.isfinite(x[:, 0]) & np.isfinite(y[:, 0])
    if both.sum() < FEWEST:
        return np.nan
    x, y = x[both] - x[both].mean(axis=0), y[both] - y[both].mean(axis=0)
    size = np.sqrt((x * x).sum() * (y * y).sum())
    return float((x * y).sum() / size) if size > 0 else np.nan


class Watched:
    """Motion in the pictures of one camera, frame by frame."""

    def __init__(self, frames: int) -> None:
        """Nothing so far, of a capture with so many frames."""
        self.color, self.depth, self.masks = (np.full((frames, CELLS[0] * CELLS[1]), np.nan) for _ in range(3))
        """[T, n] by cell of the image; NaN where the frame or the one before it is unknown."""
        self.moving: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        """Frame -> pixels (x, y) [m, 2] that moved there, and their depth [m], m."""
        self._last: tuple[int, np.ndarray, np.ndarray | None, np.ndarray | None] | None = None

    def see(self, frame: int, color: np.ndarray, depth: np.ndarray | None = None, mask: np.ndarray | None = None) -> None:
        """The next frame: RGB [H, W, 3] uint8, depth [H, W], m, 0: none, labels [H, W]."""
        picture = small(color)
        size = picture.shape[1::-1]
        near = None if depth is None else cv2.resize(depth.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
        labels = None if mask is None else cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
        last, self._last = self._last, (frame, picture, near, labels)
        if last is None or last[0] != frame - 1:
            return
        change = np.clip(np.abs(picture - last[1]).max(axis=-1) - COLOR_STILL, 0, COLOR_MOST).astype(np.float32)
        self.color[frame] = _cells(change)
        if near is not None and last[2] is not None:
            both, noise = (near > 0) & (last[2] > 0), DEPTH_STILL * depth_noise(np.maximum(near, 0.1))
            moved = np.where(both, np.clip(np.abs(near - last[2]) / noise - 1, 0, 5), 0).astype(np.float32)
            self.depth[frame] = _cells(cv2.medianBlur(moved, 3))
            # What is uncovered lies behind what moved.
            nearest = np.where(both, np.minimum(near, last[2]), 0.0)
            y, x = np.nonzero((change > 0) & both)
            y, x = y[::2], x[::2]
            self.moving[frame] = np.stack([x, y], axis=1) * color.shape[1] / size[0], nearest[y, x]
        # A label that appears or vanishes is no motion.
        if labels is not None and last[3] is not None and {*np.unique(labels)} == {*np.unique(last[3])}:
            self.masks[frame] = _cells((labels != last[3]).astype(np.float32))


def small(image: np.ndarray) -> np.ndarray:
    """An image [H, W, 3] of at most WATCHED_WIDE pixels across [h, w, 3], float32, without its finest noise."""
    scale = min(1.0, WATCHED_WIDE / image.shape[1])
    size = round(scale * image.shape[1]), round(scale * image.shape[0])
    resized = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(resized.astype(np.float32), (0, 0), 1.0)


def _cells(change: np.ndarray) -> np.ndarray:
    """Means [n] of a picture [h, w] in CELLS."""
    return cv2.resize(change, CELLS, interpolation=cv2.INTER_AREA).ravel()


def in_space(watched: Mapping[str, Watched], cameras: Mapping[str, Camera]) -> dict[str, np.ndarray]:
    """Motion of each camera by cells of space [T, n], which all share; nothing where too little moves."""
    placed = {name: {frame: cameras[name].lift(*there) for frame, there in one.moving.items()} for name, one in watched.items()}
    points = [points for one in placed.values() for points in one.values() if len(points)]
    if not points:
        return {}
    low, high = np.quantile(np.concatenate(points), (0.02, 0.98), axis=0)
    side = float(np.clip((high - low).max() / SPACE_CELLS, *CELL))
    shape = np.floor((high - low) / side).astype(int) + 1
    maps = {}
    for name, one in placed.items():
        rows = np.full((len(watched[name].color), int(np.prod(shape))), np.nan)
        for frame, there in one.items():
            cell = np.floor((there - low) / side).astype(int)
            inside = ((cell >= 0) & (cell < shape)).all(axis=1)
            area = watched[name].moving[frame][1][inside] ** 2  # of a pixel
            rows[frame] = np.bincount(np.ravel_multi_index(tuple(cell[inside].T), tuple(shape)), area, len(rows[frame]))
        maps[name] = rows
    return maps


def on_images(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Motion of points [T, K, 3], m, NaN: unknown, in the cells of a camera's image [T, n]; NaN where none is known."""
    pixels, depth = camera.project(points)
    rows = np.full((len(points), CELLS[0] * CELLS[1]), np.nan)
    for frame in range(1, len(points)):
        both = (depth[frame - 1 : frame + 1] > 0).all(axis=0) & np.isfinite(pixels[frame - 1 : frame + 1]).all(axis=(0, 2))
        both[both] &= camera.sees(pixels[frame, both])
        if both.any():
            speed = np.linalg.norm(pixels[frame, both] - pixels[frame - 1, both], axis=1)
            middle = pixels[frame - 1 : frame + 1, both].mean(axis=0)  # A change of the picture shows both places.
            cell = np.clip(middle / (camera.width, camera.height) * CELLS, 0, np.array(CELLS) - 1).astype(int)
            rows[frame] = np.bincount(cell[:, 1] * CELLS[0] + cell[:, 0], speed, rows.shape[1])
    return rows


def follows(hands: np.ndarray, points: np.ndarray) -> Shift | None:
    """The shift of points of a body [T, K, 3], m, NaN: unknown, against hands [T, C, 3] that move it, by their mean speeds.

    A body may move later than hands; one that moves before them is of other moments. None where it does not.
    """

    def speed(places: np.ndarray) -> np.ndarray:
        steps = np.linalg.norm(np.diff(places, axis=0), axis=2)
        return np.append(np.nan, np.ma.masked_invalid(steps).mean(axis=1).filled(np.nan))[:, None]

    shift = measure(speed(hands), speed(points))
    return shift if shift and shift.frames < 0 else None


@dataclass(frozen=True, eq=False)
class Streams:
    """Two streams of one scene, and their shift."""

    one: str
    other: str
    shift: Shift | None
    """None where too little moves."""
    remedy: str = ""
    """The next step; {frames} stands for the whole frames by which the second is late."""


def out_of_step(pairs: Sequence[Streams]) -> Iterator[dict[str, Any]]:
    """Frames by which a second stream is clearly late."""
    for streams in pairs:
        if streams.shift is None or not streams.shift.wrong:
            continue
        frames = streams.shift.frames
        told = {"value": round(frames, 2), "detail": streams.shift.text(streams.one, streams.other)}
        if abs(frames) < MENDABLE:
            yield told | {"level": "warning", "next": "Whole frames do not fix it: synchronize the streams when they are recorded."}
        else:
            yield told | {"next": streams.remedy.format(frames=round(frames))}


def unlike(watched: Mapping[str, Watched]) -> Iterator[dict[str, Any]]:
    """Correlation of motion in the masks and in the images of each camera, as a part of the best one of all cameras.

    The best one counts as 2 AGREE at least. None where too little moves in images or masks.
    """
    for name, one in watched.items():
        # Cameras of one capture agree in time.
        fits = {
            other: shift.agreement
            for other, seen in watched.items()
            if (shift := measure(seen.color, one.masks, None if other == name else 2))
        }
        best = max(fits, key=fits.__getitem__, default=name)
        if name in fits:
            told = {"where": f"camera {name}", "value": fits[name] / max(2 * AGREE, fits[best])}
            clear = {"level": "error", "detail": f"masks fit camera {best}: {fits[best]:.2f}, and {name}: {fits[name]:.2f}"}
            yield told | (clear if fits[best] >= 2 * AGREE else {})


def repeats(capture: Capture, camera: str, watched: Watched | None = None) -> Iterator[dict[str, Any]]:
    """Images of each stream of a camera that equal the one before: to the bit or, of color, but for its encoding."""
    for kind, equal in capture.repeats[camera].items():
        frames = equal
        if watched is not None and kind == "color":
            moved = np.append(np.nan_to_num(watched.color.mean(axis=1)), 0.0)
            around = np.minimum(moved[:-2], moved[2:])
            stalls = moved[1:-1] < STALL * around
            if (stalls & (around > moved.mean())).sum() >= FEWEST_STALLS:
                frames = sorted({*equal, *(np.flatnonzero(stalls) + 1).tolist()})
        if frames:
            yield {"value": len(frames), "detail": f"{kind}, frames {spans(frames)}", "frames": frames}
