"""Time shift between two streams of one scene, measured from their motion.

A stream is an array a [T, n] of motion: row t is the change from frame t - 1 to t in n cells that both streams share. Cells are
parts of the image for color, depth and masks of one camera, and parts of space for two cameras. With the mean m of each cell over
the common steps, the agreement after a shift by s frames is the correlation

    c(s) = sum (a_t - m) (b_{t+s} - m) / sqrt(sum (a_t - m)^2 sum (b_{t+s} - m)^2)

The shift is the maximum of c, refined by a parabola through three values. It is reliable if it stays the same without any quarter
of the time. File names, frame numbers and time stamps are not used.
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
"""Width, px, of compared images, and cells across and down."""
COLOR_STILL, COLOR_MOST = 6.0, 30.0
"""Color value change that counts as noise, and value at which the excess is clipped."""
DEPTH_STILL = 4.0
"""Depth change that counts as noise, in standard deviations of a sensor; the excess is clipped at 5 times this value."""
FEWEST = 8
"""Smallest number of common steps."""
AGREE = 0.25
"""Correlation above which two streams show the same motion. Real and rendered recordings reach 0.5 to 0.85, two cameras 0.4."""
STALL, FEWEST_STALLS = 0.1, 3
"""An encoded image repeats its predecessor if its motion is below STALL of both neighboring steps. A recording repeats images if
this happens FEWEST_STALLS times during fast motion; none of 67 real videos does."""
HALF, MENDABLE = 0.5, 0.75
"""Shifts in frames: HALF is the smallest reported shift and the limit of the spread; MENDABLE is the smallest that whole frames
can fix."""
QUARTERS = 4
SPACE_CELLS, CELL = 9, (0.02, 0.25)
"""Cells across the moving volume, and limits of a cell's side, m."""


@dataclass(frozen=True)
class Shift:
    """Time shift of one stream against another."""

    frames: float
    """Frames by which the second stream lags the first."""
    agreement: float
    """Correlation c at the shift."""
    spread: float
    """Largest change of the shift, in frames, if a quarter of the time is left out."""

    @property
    def known(self) -> bool:
        """True if both streams show the same motion, so that the shift is reliable."""
        return self.agreement >= AGREE and self.spread < HALF

    @property
    def wrong(self) -> bool:
        """True if the shift is reliable and at least half a frame."""
        return self.known and abs(self.frames) >= max(HALF, 2 * self.spread)

    def text(self, one: str, other: str) -> str:
        """The shift as text."""
        side = "later" if self.frames > 0 else "earlier"
        return f"{other} is {abs(self.frames):.1f} frames {side} than {one}"


def measure(one: np.ndarray, other: np.ndarray, most: int | None = None) -> Shift | None:
    """Measure the shift of `other` [T2, n] against `one` [T1, n], at most `most` frames; NaN rows are unknown.

    None if there is too little motion.
    """
    a, b = (np.sqrt(rows.reshape(len(rows), -1)) for rows in (one, other))
    reach = min(most or max(len(a), len(b)), max(len(a), len(b)) - FEWEST)
    known = [np.isfinite(rows).all(axis=1) for rows in (a, b)]
    if reach < 1 or min(np.nansum(a), np.nansum(b)) <= 0 or min(map(np.sum, known)) < FEWEST:
        return None
    shifts = np.arange(-reach, reach + 1)
    if (peak := _peak(a, b, shifts, np.ones(len(a), bool))) is None:
        return None
    parts = []
    for part in np.array_split(np.flatnonzero(known[0] & (np.nansum(a, axis=1) > 0)), QUARTERS):
        kept = np.ones(len(a), bool)
        kept[part] = False
        parts.append(_peak(a, b, shifts[np.abs(shifts - round(peak[0])) <= 3], kept))
    spread = max(np.inf if part is None else abs(part[0] - peak[0]) for part in parts)
    return Shift(*peak, float(spread))


def _peak(a: np.ndarray, b: np.ndarray, shifts: np.ndarray, kept: np.ndarray) -> tuple[float, float] | None:
    """The shift with the largest agreement, and the agreement, over the `kept` rows of `a`."""
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
    """c(shift) over the `kept` rows of `a`; NaN for too few common rows."""
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
    """Motion in the images of one camera per frame."""

    def __init__(self, frames: int) -> None:
        """Start empty, for a capture with `frames` frames."""
        self.color, self.depth, self.masks = (np.full((frames, CELLS[0] * CELLS[1]), np.nan) for _ in range(3))
        """Motion [T, n] by cell of the image; NaN if this or the previous frame is unknown."""
        self.moving: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        """Frame -> moving pixels (x, y) [m, 2] and their depth [m], m."""
        self._last: tuple[int, np.ndarray, np.ndarray | None, np.ndarray | None] | None = None

    def see(self, frame: int, color: np.ndarray, depth: np.ndarray | None = None, mask: np.ndarray | None = None) -> None:
        """Add the next frame: RGB [H, W, 3] uint8; depth [H, W], m, 0: no measurement; labels [H, W]."""
        image = small(color)
        size = image.shape[1::-1]
        near = None if depth is None else cv2.resize(depth.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
        labels = None if mask is None else cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
        last, self._last = self._last, (frame, image, near, labels)
        if last is None or last[0] != frame - 1:
            return
        change = np.clip(np.abs(image - last[1]).max(axis=-1) - COLOR_STILL, 0, COLOR_MOST).astype(np.float32)
        self.color[frame] = _cells(change)
        if near is not None and last[2] is not None:
            both, noise = (near > 0) & (last[2] > 0), DEPTH_STILL * depth_noise(np.maximum(near, 0.1))
            moved = np.where(both, np.clip(np.abs(near - last[2]) / noise - 1, 0, 5), 0).astype(np.float32)
            self.depth[frame] = _cells(cv2.medianBlur(moved, 3))
            # The smaller depth belongs to the moving surface; the larger one to the uncovered background.
            nearest = np.where(both, np.minimum(near, last[2]), 0.0)
            y, x = np.nonzero((change > 0) & both)
            y, x = y[::2], x[::2]
            self.moving[frame] = np.stack([x, y], axis=1) * color.shape[1] / size[0], nearest[y, x]
        # A label that appears or disappears is not motion.
        if labels is not None and last[3] is not None and {*np.unique(labels)} == {*np.unique(last[3])}:
            self.masks[frame] = _cells((labels != last[3]).astype(np.float32))


def small(image: np.ndarray) -> np.ndarray:
    """Reduce an image [H, W, 3] to at most WATCHED_WIDE px width and smooth it: [h, w, 3] float32."""
    scale = min(1.0, WATCHED_WIDE / image.shape[1])
    size = round(scale * image.shape[1]), round(scale * image.shape[0])
    resized = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(resized.astype(np.float32), (0, 0), 1.0)


def _cells(change: np.ndarray) -> np.ndarray:
    """Means [n] of an image [h, w] in CELLS."""
    return cv2.resize(change, CELLS, interpolation=cv2.INTER_AREA).ravel()


def in_space(watched: Mapping[str, Watched], cameras: Mapping[str, Camera]) -> dict[str, np.ndarray]:
    """Motion of each camera in common cells of space [T, n]; empty if nothing moves."""
    placed = {name: {frame: cameras[name].lift(*moved) for frame, moved in own.moving.items()} for name, own in watched.items()}
    points = [points for frames in placed.values() for points in frames.values() if len(points)]
    if not points:
        return {}
    low, high = np.quantile(np.concatenate(points), (0.02, 0.98), axis=0)
    side = float(np.clip((high - low).max() / SPACE_CELLS, *CELL))
    shape = np.floor((high - low) / side).astype(int) + 1
    maps = {}
    for name, frames in placed.items():
        rows = np.full((len(watched[name].color), int(np.prod(shape))), np.nan)
        for frame, moved in frames.items():
            cell = np.floor((moved - low) / side).astype(int)
            inside = ((cell >= 0) & (cell < shape)).all(axis=1)
            area = watched[name].moving[frame][1][inside] ** 2  # proportional to the area of a pixel on the surface
            rows[frame] = np.bincount(np.ravel_multi_index(tuple(cell[inside].T), tuple(shape)), area, len(rows[frame]))
        maps[name] = rows
    return maps


def on_images(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Motion of points [T, K, 3], m (NaN: unknown), in the cells of a camera's image [T, n]; NaN rows without known points."""
    pixels, depth = camera.project(points)
    rows = np.full((len(points), CELLS[0] * CELLS[1]), np.nan)
    for frame in range(1, len(points)):
        both = (depth[frame - 1 : frame + 1] > 0).all(axis=0) & np.isfinite(pixels[frame - 1 : frame + 1]).all(axis=(0, 2))
        both[both] &= camera.sees(pixels[frame, both])
        if both.any():
            speed = np.linalg.norm(pixels[frame, both] - pixels[frame - 1, both], axis=1)
            middle = pixels[frame - 1 : frame + 1, both].mean(axis=0)  # The image changes at both positions.
            cell = np.clip(middle / (camera.width, camera.height) * CELLS, 0, np.array(CELLS) - 1).astype(int)
            rows[frame] = np.bincount(cell[:, 1] * CELLS[0] + cell[:, 0], speed, rows.shape[1])
    return rows


def follows(hands: np.ndarray, points: np.ndarray) -> Shift | None:
    """The shift of object points [T, K, 3], m (NaN: unknown), against the hands [T, C, 3] that move it, by mean speeds.

    Returns None unless the object moves before the hands: it may lag behind them, but cannot precede them.
    """

    def speed(positions: np.ndarray) -> np.ndarray:
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=2)
        return np.append(np.nan, np.ma.masked_invalid(steps).mean(axis=1).filled(np.nan))[:, None]

    shift = measure(speed(hands), speed(points))
    return shift if shift and shift.frames < 0 else None


@dataclass(frozen=True, eq=False)
class Streams:
    """Two streams of one scene, and their shift."""

    one: str
    other: str
    shift: Shift | None
    """None if there is too little motion."""
    remedy: str = ""
    """The next step; {frames} is replaced by the whole frames by which the second stream lags."""


def out_of_step(pairs: Sequence[Streams]) -> Iterator[dict[str, Any]]:
    """Frames by which the second stream lags, for pairs with a reliable shift."""
    for streams in pairs:
        if streams.shift is None or not streams.shift.wrong:
            continue
        frames = streams.shift.frames
        words = {"value": round(frames, 2), "detail": streams.shift.text(streams.one, streams.other)}
        if abs(frames) < MENDABLE:
            yield words | {"level": "warning", "next": "Synchronize the streams during recording; whole frames cannot fix this."}
        else:
            yield words | {"next": streams.remedy.format(frames=round(frames))}


def unlike(watched: Mapping[str, Watched]) -> Iterator[dict[str, Any]]:
    """Correlation of mask and image motion of each camera, divided by the best correlation with any camera's images.

    The divisor is at least 2 AGREE. Cameras with too little motion are skipped.
    """
    for name, one in watched.items():
        # Cameras of one capture are synchronized, so other cameras need only small shifts.
        fits = {
            other: shift.agreement
            for other, seen in watched.items()
            if (shift := measure(seen.color, one.masks, None if other == name else 2))
        }
        best = max(fits, key=fits.__getitem__, default=name)
        if name in fits:
            words = {"where": f"camera {name}", "value": fits[name] / max(2 * AGREE, fits[best])}
            clear = {"level": "error", "detail": f"masks match camera {best}: {fits[best]:.2f}, and {name}: {fits[name]:.2f}"}
            yield words | (clear if fits[best] >= 2 * AGREE else {})


def repeats(capture: Capture, camera: str, watched: Watched | None = None) -> Iterator[dict[str, Any]]:
    """Images of each stream of a camera that equal their predecessor exactly or, for color, except for encoding noise."""
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
