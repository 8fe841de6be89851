"""Segmentation without a network: foreground by height and color against the table, refined by GrabCut; hands by color.

1. Lab histograms are computed for the table, from the image borders, and for everything above it. A cloth that is flat
   in frame 0 gets its colors from later frames.
2. In each frame, height and the log ratio of both histograms give seeds, and GrabCut finds the border.
3. The same kind of ratio divides the foreground into hands and object. The histogram of hands starts from skin tones, and is
   computed again from the hands that these find. Small components are not hands.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.frames import frames_of, spread
from neuspring.perception.film import at_border, heights

HISTOGRAM_BINS = (12, 64, 64)
"""Bins of L, a and b."""
SAMPLED_FRAMES = 24
"""Number of frames for the histograms."""
BORDER = 0.08
"""Width of the border that counts as table, as a fraction of the image on each side."""
HISTOGRAM_BLUR = 1.0
"""Width of the blur of histograms, bins: a color also supports its neighbors."""
UNSEEN_COLOR = 1e-5
"""Probability of an unseen color."""
TABLE_SHADES = (1.0, 0.85, 0.7, 0.55, 0.45)
"""Factors that darken the table's colors, for shadows next to the object."""
RISEN = 0.012
"""m above the table: higher pixels are foreground; for lower pixels the color decides."""
HAND_HUE, HAND_CHROMA = (35.0, 70.0), (9.0, 36.0)
"""Ranges of skin in Lab: hue atan2(b, a), degrees, and chroma."""
CERTAIN_HEIGHT = 2.5
"""Multiple of RISEN above which height alone fixes a pixel as foreground in GrabCut."""
CERTAIN = 1.5
"""Log ratio above which color alone decides."""
GRABCUT_MARGIN = 10
"""Width of the region around the seeds in which GrabCut may move the border, pixels."""
HAND_PIECE = 0.15
"""Hand-colored components smaller than this fraction of the largest belong to the object, which may have skin tones."""
LARGEST_HOLE = 0.0015
"""Holes in the foreground up to this fraction of the image are filled, such as prints in the table's color."""
DECISION = 1.5
"""Width over which the decision between hand and object is averaged, pixels."""
SMALLEST_PIECE = 0.0004
"""Smallest area of a component, as a fraction of the image; smaller ones get the label around them."""
SPECK = np.ones((3, 3), np.uint8)


def lab_of(image: np.ndarray) -> np.ndarray:
    """Convert an RGB image to Lab [H, W, 3] uint8."""
    return cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2LAB)


def bins_of(lab: np.ndarray, bins: tuple[int, int, int]) -> np.ndarray:
    """Histogram bin of each Lab pixel [H, W], for numbers of bins of L, a and b."""
    first, second, third = (lab[..., axis].astype(np.int32) * count // 256 for axis, count in enumerate(bins))
    return np.asarray((first * bins[1] + second) * bins[2] + third)


def segment(capture: Capture, camera: str) -> np.ndarray:
    """Labels [T, H, W] uint8. Raises InputError if nothing is above the table."""
    rise, hand = learn(capture, camera)
    view = capture.cameras[camera]
    labels = np.zeros((capture.frame_count, view.height, view.width), dtype=np.uint8)
    for frame in frames_of(capture, camera):
        labels[frame] = _frame(capture, camera, frame, rise, hand)
    return labels


def learn(capture: Capture, camera: str) -> tuple[np.ndarray, np.ndarray]:
    """Log ratios of color probabilities [bins] over the video: foreground to table, and hands to object.

    Without hand-colored pixels, all foreground is object. Raises InputError if nothing is above the table.
    """
    table, above = np.zeros(np.prod(HISTOGRAM_BINS)), np.zeros(np.prod(HISTOGRAM_BINS))
    views = []
    for frame in spread(frames_of(capture, camera), SAMPLED_FRAMES):
        image, height = capture.color(camera, frame), heights(capture, camera, capture.depth(camera, frame))
        risen = height > RISEN
        views.append((image, risen))
        above += _counts(_bins(image), risen)
        edge = ~(height > RISEN / 2)
        rows, columns = (max(int(BORDER * size), 2) for size in edge.shape)
        edge[rows:-rows, columns:-columns] = False
        for shade in TABLE_SHADES:
            table += _counts(_bins((shade * image).astype(np.uint8)), edge)
    where = f"{capture.folder}, camera {camera}"
    if not above.sum():
        raise InputError(where, f"an object more than {1e3 * RISEN:g} mm above the table z = 0 is required", "nothing")
    hands, body = _divide([(image, risen, _skin(image)) for image, risen in views])
    if not hands.sum():
        skin = f"hue in {list(HAND_HUE)} degrees, chroma in {list(HAND_CHROMA)} (Lab)"
        print(f"{where}: nothing above the table has the color of hands ({skin}); all foreground is object", flush=True)
    first = _log_probability(hands) - _log_probability(body)
    hands, body = _divide([(image, risen, first[_bins(image)] > 0) for image, risen in views])
    return _log_probability(above) - _log_probability(table), _log_probability(hands) - _log_probability(body)


def _divide(views: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Histograms of hands and of object from images with their masks of foreground and of hand color."""
    hands, body = np.zeros(np.prod(HISTOGRAM_BINS)), np.zeros(np.prod(HISTOGRAM_BINS))
    for image, risen, like_hand in views:
        labels = _tidy(np.where(risen, np.where(like_hand, HANDS, OBJECT), 0).astype(np.uint8))
        hands += _counts(_bins(image), labels == HANDS)
        body += _counts(_bins(image), labels == OBJECT)
    return hands, body


def _frame(capture: Capture, camera: str, frame: int, rise: np.ndarray, hand: np.ndarray) -> np.ndarray:
    """Labels [H, W] of one frame, from the log ratios of `learn`."""
    image = capture.color(camera, frame)
    bins, height = _bins(image), heights(capture, camera, capture.depth(camera, frame))
    ratio = cv2.GaussianBlur(rise[bins], (0, 0), 1.0)
    flat = np.nan_to_num(height, nan=0.0) < RISEN
    # High pixels are foreground; low pixels need a color that occurs above the table in some frame.
    seeds = (height > RISEN) | (flat & (ratio > CERTAIN))
    seeds = cv2.morphologyEx(seeds.astype(np.uint8), cv2.MORPH_OPEN, SPECK).astype(bool)
    foreground = _grab(image, seeds, ratio, height > CERTAIN_HEIGHT * RISEN) if seeds.any() else seeds
    foreground |= _holes(foreground)
    in_hand = cv2.GaussianBlur(hand[bins], (0, 0), DECISION) > 0
    return _tidy(np.where(foreground, np.where(in_hand, HANDS, OBJECT), 0).astype(np.uint8))


def _grab(image: np.ndarray, seeds: np.ndarray, ratio: np.ndarray, high: np.ndarray) -> np.ndarray:
    """GrabCut around the seeds: their core is foreground; GrabCut decides on rims, and on gaps in the table's color."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * GRABCUT_MARGIN + 1,) * 2)
    near = cv2.dilate(seeds.astype(np.uint8), kernel).astype(bool)
    core = cv2.erode(seeds.astype(np.uint8), SPECK).astype(bool)
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    trimap = np.full(seeds.shape, cv2.GC_BGD, dtype=np.uint8)
    trimap[near & (ratio > -CERTAIN)] = cv2.GC_PR_BGD
    trimap[seeds] = cv2.GC_PR_FGD
    trimap[core & ((ratio > 0) | high)] = cv2.GC_FGD
    cut = trimap[window].copy()
    foreground = np.isin(cut, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if foreground.all() or not foreground.any():
        return seeds
    bgr = np.ascontiguousarray(image[window][..., ::-1])
    cv2.grabCut(bgr, cut, (0, 0, 0, 0), np.zeros((1, 65)), np.zeros((1, 65)), 2, cv2.GC_INIT_WITH_MASK)
    mask = np.zeros_like(seeds)
    mask[window] = np.isin(cut, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return mask


def _holes(foreground: np.ndarray) -> np.ndarray:
    """Small enclosed holes of background [H, W] bool."""
    _, pieces, boxes, _ = cv2.connectedComponentsWithStats((~foreground).astype(np.uint8), connectivity=4)
    small = ~at_border(boxes, foreground.shape) & (boxes[:, cv2.CC_STAT_AREA] <= LARGEST_HOLE * foreground.size)
    small[0] = False
    return np.asarray(small[pieces])


def _tidy(labels: np.ndarray) -> np.ndarray:
    """Give small components, and hand components much smaller than the hand, the label around them."""
    tidy = labels.copy()
    for label, share in ((HANDS, HAND_PIECE), (OBJECT, 0.0)):
        _, pieces, boxes, _ = cv2.connectedComponentsWithStats((tidy == label).astype(np.uint8), connectivity=4)
        areas = boxes[1:, cv2.CC_STAT_AREA]
        least = max(SMALLEST_PIECE * labels.size, share * areas.max(initial=0))
        for piece in 1 + np.flatnonzero(areas < least):
            small = pieces == piece
            around = cv2.dilate(small.astype(np.uint8), SPECK).astype(bool) & ~small
            votes = np.bincount(tidy[around], minlength=3)
            # The tip of a limb borders mostly on the table, but belongs to the object.
            tidy[small] = OBJECT if label == HANDS and votes[OBJECT] else votes.argmax()
    return tidy


def _skin(image: np.ndarray) -> np.ndarray:
    """True for pixels [H, W] with the hue and chroma of skin."""
    a, b = lab_of(image)[..., 1:].astype(float).transpose(2, 0, 1) - 128.0
    hue, chroma = np.degrees(np.arctan2(b, a)), np.hypot(a, b)
    (least_hue, most_hue), (least_chroma, most_chroma) = HAND_HUE, HAND_CHROMA
    return np.asarray((least_hue < hue) & (hue < most_hue) & (least_chroma < chroma) & (chroma < most_chroma))


def _counts(bins: np.ndarray, where: np.ndarray) -> np.ndarray:
    return np.bincount(bins[where], minlength=int(np.prod(HISTOGRAM_BINS))).astype(float)


def _bins(image: np.ndarray) -> np.ndarray:
    return bins_of(lab_of(image), HISTOGRAM_BINS)


def _log_probability(counts: np.ndarray) -> np.ndarray:
    blurred = gaussian_filter(counts.reshape(HISTOGRAM_BINS), HISTOGRAM_BLUR).ravel()
    return np.asarray(np.log(blurred / max(blurred.sum(), 1.0) + UNSEEN_COLOR))
