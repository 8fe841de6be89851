"""Segmentation without a network: what differs from the table in height or colour, refined by GrabCut; hands by their colour.

1. Colour histograms (Lab) of the table, from the border of the images, and of what rises above it, in any frame. A cloth that lies
   flat in frame 0 has its colours from later frames, in which it is lifted.
2. Per frame the log ratio of both and the height make seeds, and GrabCut draws the border.
3. Foreground is divided into hands and object by the same kind of ratio. The hands' histogram starts from skin tones and is learnt
   anew from the hands found so. Only pieces of some size are hands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from neuspring.config.perception import OpenCvSegmentation
from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT, Camera, Capture

BINS = (12, 64, 64)
"""Of L, a, b."""
SAMPLED_FRAMES = 24
"""From which histograms are made."""
BORDER = 0.08
"""Part of the image at each side that shows the table."""
SMOOTHING = 1.0
"""Width, in bins, by which histograms are blurred: a colour seen once stands for its neighbours."""
FLOOR = 1e-5
"""Probability of a colour never seen."""
SHADES = (1.0, 0.85, 0.7, 0.55, 0.45)
"""By which the table's colours are darkened, for shadows that fall beside the object and not on the border."""
HIGH = 2.5
"""From this many times the least height on, height alone decides."""
CERTAIN = 1.5
"""Log ratio from which a colour alone decides."""
MARGIN = 10
"""Pixels around the seeds in which GrabCut may move the border."""


@dataclass(frozen=True)
class Palette:
    """Log probabilities of colours."""

    table: np.ndarray
    risen: np.ndarray
    hands: np.ndarray
    object: np.ndarray

    def rise(self, lab: np.ndarray) -> np.ndarray:
        """Log ratio [H, W] of what rises to the table."""
        return np.asarray(_look_up(self.risen, lab) - _look_up(self.table, lab))

    def hand(self, lab: np.ndarray) -> np.ndarray:
        """Log ratio [H, W] of hands to object."""
        return np.asarray(_look_up(self.hands, lab) - _look_up(self.object, lab))


def segment(capture: Capture, camera: str, settings: OpenCvSegmentation) -> np.ndarray:
    """Labels [T, H, W]. Raises InputError where nothing rises above the table."""
    palette = learn(capture, camera, settings)
    of = capture.cameras[camera]
    labels = np.zeros((capture.frame_count, of.height, of.width), dtype=np.uint8)
    for frame in range(capture.frame_count):
        if capture.has(camera, frame):
            labels[frame] = _frame(capture, camera, frame, palette, settings)
    return labels


def learn(capture: Capture, camera: str, settings: OpenCvSegmentation) -> Palette:
    """Histograms of table, risen things, hands and object over frames of the whole video.

    Raises InputError where nothing rises above the table. Without the colour of hands all that rises is the object.
    """
    frames = [f for f in range(capture.frame_count) if capture.has(camera, f)]
    counts = {name: np.zeros(BINS) for name in ("table", "risen", "hands", "object")}
    views = []
    for frame in np.unique(np.linspace(0, len(frames) - 1, SAMPLED_FRAMES).astype(int)):
        colour = capture.colour(camera, frames[frame])
        lab, height = _lab(colour), heights(capture, camera, frames[frame])
        risen = height > settings.height
        views.append((lab, risen))
        counts["risen"] += _count(lab[risen])
        edge = _border(risen.shape) & ~risen & ~(height > settings.height / 2)
        for shade in SHADES:
            counts["table"] += _count(_lab((shade * colour).astype(np.uint8))[edge])
    where = f"{capture.folder}, camera {camera}"
    if not counts["risen"].sum():
        raise InputError(where, f"an object more than {1e3 * settings.height:g} mm above the table z = 0 is required", "nothing")
    _divide(counts, [(lab, risen, _skin(lab, settings)) for lab, risen in views], settings)
    if not counts["hands"].sum():
        wanted = f"hue in {list(settings.hand_hue)} degrees, chroma in {list(settings.hand_chroma)} (Lab)"
        print(f"{where}: nothing above the table has the colour of hands ({wanted}); all of it is the object", flush=True)
    first = _palette(counts)
    _divide(counts, [(lab, risen, first.hand(lab) > 0) for lab, risen in views], settings)
    return _palette(counts)


def _divide(
    counts: dict[str, np.ndarray], views: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], settings: OpenCvSegmentation
) -> None:
    """Count anew the colours of hands and object in views of (Lab image, risen, coloured like a hand)."""
    counts["hands"], counts["object"] = np.zeros(BINS), np.zeros(BINS)
    for lab, risen, alike in views:
        labels = _tidy(np.where(risen, np.where(alike, HANDS, OBJECT), 0).astype(np.uint8), settings)
        counts["hands"] += _count(lab[labels == HANDS])
        counts["object"] += _count(lab[labels == OBJECT])


def _palette(counts: Mapping[str, np.ndarray]) -> Palette:
    return Palette(**{name: np.log(_normal(total) + FLOOR) for name, total in counts.items()})


def heights(capture: Capture, camera: str, frame: int) -> np.ndarray:
    """Height above the table [H, W], m; NaN where depth is missing."""
    of, depth = capture.cameras[camera], capture.depth(camera, frame)
    sign = 1.0 if capture.description.up == "+z" else -1.0
    return np.where(depth > 0, sign * of.lift(pixel_grid(of), depth)[..., 2], np.nan)


def pixel_grid(camera: Camera) -> np.ndarray:
    """Whole pixel coordinates (x, y) [H, W, 2]."""
    return np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).astype(float)


def _frame(capture: Capture, camera: str, frame: int, palette: Palette, settings: OpenCvSegmentation) -> np.ndarray:
    colour = capture.colour(camera, frame)
    lab, height = _lab(colour), heights(capture, camera, frame)
    ratio = cv2.GaussianBlur(palette.rise(lab), (0, 0), 1.0)
    flat = np.nan_to_num(height, nan=0.0) < settings.height
    # High things are foreground whatever their colour; low ones need the colour of something that rises in some frame.
    seeds = (height > settings.height) | (flat & (ratio > CERTAIN))
    seeds = cv2.morphologyEx(seeds.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    foreground = _grab(colour, seeds.astype(bool), ratio, height > HIGH * settings.height) if seeds.any() else seeds.astype(bool)
    foreground |= _holes(foreground, settings.largest_hole)
    hand = cv2.GaussianBlur(palette.hand(lab), (0, 0), settings.smoothing) > 0
    labels = np.where(foreground, np.where(hand, HANDS, OBJECT), 0).astype(np.uint8)
    return _tidy(labels, settings)


def _grab(colour: np.ndarray, seeds: np.ndarray, ratio: np.ndarray, high: np.ndarray) -> np.ndarray:
    """GrabCut in the surroundings of the seeds: their core is foreground, table-coloured rims and gaps are decided."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * MARGIN + 1,) * 2)
    near = cv2.dilate(seeds.astype(np.uint8), kernel).astype(bool)
    core = cv2.erode(seeds.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    trimap = np.full(seeds.shape, cv2.GC_BGD, dtype=np.uint8)
    trimap[near & (ratio > -CERTAIN)] = cv2.GC_PR_BGD
    trimap[seeds] = cv2.GC_PR_FGD
    trimap[core & ((ratio > 0) | high)] = cv2.GC_FGD
    cut = trimap[window].copy()
    if not ((cut == cv2.GC_BGD) | (cut == cv2.GC_PR_BGD)).any() or not ((cut == cv2.GC_FGD) | (cut == cv2.GC_PR_FGD)).any():
        return seeds
    cv2.grabCut(
        np.ascontiguousarray(colour[window][..., ::-1]),
        cut,
        (0, 0, 0, 0),
        np.zeros((1, 65)),
        np.zeros((1, 65)),
        2,
        cv2.GC_INIT_WITH_MASK,
    )
    found = np.zeros_like(seeds)
    found[window] = (cut == cv2.GC_FGD) | (cut == cv2.GC_PR_FGD)
    return found


def _holes(foreground: np.ndarray, largest: float) -> np.ndarray:
    """Enclosed background pieces of at most `largest` parts of the image [H, W] bool."""
    _, pieces, facts, _ = cv2.connectedComponentsWithStats((~foreground).astype(np.uint8), connectivity=4)
    left, top, width, height, area = facts.T
    rows, columns = foreground.shape
    touches = (left == 0) | (top == 0) | (left + width == columns) | (top + height == rows)
    small = ~touches & (area <= largest * foreground.size)
    small[0] = False
    return np.asarray(small[pieces])


def _tidy(labels: np.ndarray, settings: OpenCvSegmentation) -> np.ndarray:
    """Specks, and pieces of hand colour much smaller than the hand, become what surrounds them: nothing, or the other label."""
    tidy = labels.copy()
    for label, share in ((HANDS, settings.hand_piece), (OBJECT, 0.0)):
        count, pieces, facts, _ = cv2.connectedComponentsWithStats((tidy == label).astype(np.uint8), connectivity=4)
        areas = facts[1:, cv2.CC_STAT_AREA]
        least = max(settings.smallest * labels.size, share * areas.max()) if count > 1 else 0.0
        for piece in 1 + np.flatnonzero(areas < least):
            own = pieces == piece
            around = cv2.dilate(own.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & ~own
            votes = np.bincount(tidy[around], minlength=3)
            # A limb's tip borders on more table than limb, but it is not table.
            tidy[own] = OBJECT if label == HANDS and votes[OBJECT] else votes.argmax()
    return tidy


def _skin(lab: np.ndarray, settings: OpenCvSegmentation) -> np.ndarray:
    a, b = lab[..., 1].astype(float) - 128.0, lab[..., 2].astype(float) - 128.0
    hue = np.degrees(np.arctan2(b, a))
    chroma = np.hypot(a, b)
    within = [(low < value) & (value < high) for value, (low, high) in ((hue, settings.hand_hue), (chroma, settings.hand_chroma))]
    return np.asarray(within[0] & within[1])


def _lab(colour: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(np.ascontiguousarray(colour), cv2.COLOR_RGB2LAB)


def _indices(lab: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(lab[..., k].astype(int) * BINS[k] // 256 for k in range(3))


def _count(lab: np.ndarray) -> np.ndarray:
    flat = np.ravel_multi_index(_indices(lab), BINS)
    return np.bincount(flat, minlength=int(np.prod(BINS))).reshape(BINS).astype(float)


def _normal(counts: np.ndarray) -> np.ndarray:
    from scipy.ndimage import gaussian_filter

    blurred = gaussian_filter(counts, SMOOTHING)
    return np.asarray(blurred / max(blurred.sum(), 1.0))


def _look_up(table: np.ndarray, lab: np.ndarray) -> np.ndarray:
    return np.asarray(table[_indices(lab)])


def _border(shape: tuple[int, ...]) -> np.ndarray:
    edge = np.ones(shape, dtype=bool)
    rows, columns = (max(int(BORDER * size), 2) for size in shape)
    edge[rows:-rows, columns:-columns] = False
    return edge
