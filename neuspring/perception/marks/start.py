"""The mask of one marked frame: colors and labels are found from each other, in turns, in a field of labels in which neighbors of
the same color like to be the same (mean field of a Potts model).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from neuspring.data.capture import HANDS, NOTHING, OBJECT
from neuspring.perception.marks.colors import Background, Colors, bins_of, count, mixed, shaded_density
from neuspring.perception.marks.marks import UNKNOWN, Seeds

SMOOTHNESS = 1.5
"""Cost of a border between two neighboring pixels of the same color, as a log ratio of probabilities."""
ROUNDS = 10
NEIGHBORS = ((0, 1, 1.0), (1, 0, 1.0), (1, 1, 0.7071), (1, -1, 0.7071))
"""Steps down and right, and weights: the inverse of the distance. The other four neighbors are opposite."""
CLOSE = 6
"""Pixels from a border of labels within which a pixel may change."""
DECIDED = 10.0
"""Log odds from which no neighbors change a pixel."""
TURNS = 5
NEVER = -40.0
"""Log odds of what marks exclude."""
LABELS = (NOTHING, OBJECT, HANDS)
SHADES = (0.88, 0.76)
"""Factors that darken the colors of the background near the object: its shadow."""
SHADED = 0.1
"""Weight of each shade."""
COLOR = 0.6
"""Weight of the log densities of colors: neighboring pixels are not independent."""
LOCAL = 0.8
"""Probability that the background looks like the background around it."""
AROUND = 0.03
"""How far around, as part of the image."""
RISEN, RISEN_LOGS = 0.012, 2.0
"""Height above the table, m, from which a pixel is probably object or hand, where marks let it be, and by which log odds."""
COARSE = 6
"""Factor by which images are made smaller to be blurred."""
LOCAL_NOISE = 2.0
"""Least spread of L, a, b."""
FEW = 0.5
"""Added variance where little of the background is seen."""
CERTAIN_WEIGHT = 1.0
"""Weight of the colors beneath clicks, scribbles and polygons, against those of the whole mask so far."""


def solve(logs: np.ndarray, lab: np.ndarray, smoothness: float = SMOOTHNESS) -> np.ndarray:
    """Probabilities [K, H, W] of labels from log likelihoods [K, H, W] and an image [H, W, 3].

    q_l(p) ~ exp(u_l(p) + sum_n w_pn q_l(n)),   w_pn = s exp(-|c_p - c_n|^2 / (2 m)) / |p - n|

    over the eight neighbors n, m the mean of |c_p - c_n|^2, s = `smoothness`. Only pixels near a border of labels are solved.
    """
    kinds, height, width = logs.shape
    q = _softmax(logs).reshape(kinds, -1)
    pixels = np.flatnonzero(_open(logs))
    if not len(pixels):
        return q.reshape(logs.shape)
    flat, color = logs.reshape(kinds, -1)[:, pixels], lab.reshape(-1, 3).astype(np.float32)
    rows, columns = np.divmod(pixels, width)
    beside, squares, weights = [], [], []
    for down, right, weight in NEIGHBORS:
        for sign in (1, -1):
            row, column = rows + sign * down, columns + sign * right
            there = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            place = np.where(there, row * width + column, pixels)
            beside.append(place)
            squares.append(((color[pixels] - color[place]) ** 2).sum(axis=-1))
            weights.append(np.where(there, np.float32(smoothness * weight), np.float32(0)))
    mean = max(float(np.mean(squares)), 1.0)
    links = [weight * np.exp(-square / (2 * mean)) for weight, square in zip(weights, squares, strict=True)]
    part = q[:, pixels]
    for _ in range(ROUNDS):
        message = flat.copy()
        for place, link in zip(beside, links, strict=True):
            message += link * q[:, place]
        # Half a step: without it, two pixels can exchange their labels forever.
        part = 0.5 * (part + _softmax(message))
        q[:, pixels] = part
    return q.reshape(logs.shape)


def _open(logs: np.ndarray) -> np.ndarray:
    """Which pixels [H, W] are near a border of labels and not decided."""
    best = logs.argmax(axis=0).astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    border = (cv2.dilate(best, kernel) != cv2.erode(best, kernel)).astype(np.uint8)
    near = cv2.dilate(border, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * CLOSE + 1,) * 2)).astype(bool)
    first = logs.max(axis=0)
    others = np.stack([np.where(best == label, -np.inf, part) for label, part in enumerate(logs)]).max(axis=0)
    return np.asarray(near & (first - others < DECIDED))


def _softmax(logs: np.ndarray) -> np.ndarray:
    powers = np.exp(logs - logs.max(axis=0))
    return np.asarray(powers / powers.sum(axis=0), dtype=np.float32)


@dataclass(frozen=True, eq=False)
class MarkedFrame:
    """A marked frame that is solved."""

    probability: np.ndarray
    """[3, H, W] float32."""
    counts: tuple[np.ndarray, ...]
    """Counts of the colors of nothing, object and hands, [bins] each."""

    @classmethod
    def of(cls, lab: np.ndarray, probability: np.ndarray, seeds: Seeds) -> MarkedFrame:
        """From probabilities that are known: counts the colors."""
        labels = probability.argmax(axis=0).astype(np.uint8)
        return cls(probability, tuple(counts_of(lab, bins_of(lab), labels, seeds.certain)))

    @property
    def labels(self) -> np.ndarray:
        """[H, W] uint8."""
        return np.asarray(self.probability.argmax(axis=0), dtype=np.uint8)


def start(
    lab: np.ndarray,
    seeds: Seeds,
    height: np.ndarray | None = None,
    background: Background | None = None,
) -> MarkedFrame:
    """Labels and colors of a frame, Lab [H, W, 3], from its marks; with heights above the table [H, W], m, and the background."""
    bins, labels = bins_of(lab), _first(lab, seeds)
    place = np.where(seeds.possible, seeds.prior, NEVER).astype(np.float32)
    if height is not None:
        place[NOTHING] -= np.where(np.nan_to_num(height) > RISEN, RISEN_LOGS, 0.0)
    for _ in range(TURNS):
        counts = counts_of(lab, bins, labels, seeds.certain)
        logs = np.stack([Colors.of(own).logs[bins] if own.sum() else np.full(bins.shape, NEVER) for own in counts])
        near = np.log(LOCAL) + _local_density(lab, labels == NOTHING)
        logs[NOTHING] = np.logaddexp(near, np.log(1 - LOCAL) + logs[NOTHING])
        if background is not None:
            logs[NOTHING] = background.explain(logs[NOTHING], lab, np.zeros(3, np.float32))
        logs = place + COLOR * logs
        probability = solve(logs.astype(np.float32), lab)
        labels = tidy(probability.argmax(axis=0).astype(np.uint8), seeds)
    probability[:, labels != probability.argmax(axis=0)] = np.array([1.0, 0.0, 0.0])[:, None]
    return MarkedFrame.of(lab, probability, seeds)


def counts_of(lab: np.ndarray, bins: np.ndarray, labels: np.ndarray, certain: np.ndarray) -> list[np.ndarray]:
    """Colors [bins] of nothing, object and hands: of a mask [H, W], of what is certain, and of shadows on the background."""
    counts = []
    for label in LABELS:
        own = labels == label
        core = cv2.erode(own.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        # A thin rope has no core.
        parts = [(1.0, count(bins, core if core.sum() > 0.5 * own.sum() else own))]
        if label == NOTHING:
            near = own & (cv2.distanceTransform(own.astype(np.uint8), cv2.DIST_L2, 5) < 0.1 * max(own.shape))
            parts.append((1.0, count(bins, near)))
            for shade in SHADES:
                darker = lab.copy()
                darker[..., 0] = (shade * lab[..., 0]).astype(np.uint8)
                parts.append((SHADED, count(bins_of(darker), near)))
        else:
            parts.append((CERTAIN_WEIGHT, count(bins, certain == label)))
        counts.append(mixed(parts))
    return counts


def _local_density(lab: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Log density [H, W] of a pixel's color, if it is like the background around it: normal, with the mean and spread there.

    A table is lit unevenly: as a whole it has the colors of a white toy, and beside the toy it has not.
    """
    width, image = AROUND * max(rest.shape), lab.astype(np.float32)
    weight = rest.astype(np.float32)[..., None]

    def blurred(values: np.ndarray) -> np.ndarray:
        small = cv2.resize(values, None, fx=1 / COARSE, fy=1 / COARSE, interpolation=cv2.INTER_AREA)
        smooth = cv2.GaussianBlur(small, (0, 0), width / COARSE)
        return np.asarray(cv2.resize(smooth, rest.shape[::-1]).reshape(*rest.shape, -1))

    share = np.maximum(blurred(weight), 1e-4)
    mean = blurred(weight * image) / share
    variance = np.maximum(blurred(weight * image**2) / share - mean**2, 0.0) + LOCAL_NOISE**2 + FEW / share
    return shaded_density(image - mean, np.sqrt(variance))


def _first(lab: np.ndarray, seeds: Seeds) -> np.ndarray:
    """Labels to begin with: what is certain or in polygons, and in boxes what has other colors than lie outside of them."""
    bins, labels = bins_of(lab), np.zeros(lab.shape[:2], np.uint8)
    free = seeds.certain == UNKNOWN
    outside = ~seeds.possible[OBJECT] & ~seeds.possible[HANDS]
    if not outside.any():
        outside = free
    rest = Colors.of(count(bins, outside)).logs[bins]
    for label, other in ((OBJECT, HANDS), (HANDS, OBJECT)):
        known = (seeds.certain == label) | (seeds.prior[label] > 0)
        labels[known & free] = label
        inside = seeds.possible[label] & free
        if known.sum() > 20 and (inside.mean() > 0.5 or (seeds.prior[label] > 0).any()):
            continue
        alone = inside & ~seeds.possible[other]
        own = alone if alone.sum() > 0.2 * inside.sum() else inside
        if own.any():
            ratio = Colors.of(count(bins, own)).logs[bins] - rest
            labels[inside & (ratio > 1.0) & (labels == 0)] = label
    return np.where(free, labels, seeds.certain).astype(np.uint8)


def tidy(labels: np.ndarray, seeds: Seeds) -> np.ndarray:
    """Pieces that no mark touches and that are small against the largest are nothing."""
    result = labels.copy()
    for label in (OBJECT, HANDS):
        number, pieces, boxes, _ = cv2.connectedComponentsWithStats((labels == label).astype(np.uint8))
        if number <= 2:
            continue
        areas = boxes[:, cv2.CC_STAT_AREA].copy()
        areas[0] = 0
        touched = np.zeros(number, bool)
        touched[np.unique(pieces[(seeds.certain == label) | (seeds.prior[label] > 0)])] = True
        # A box says that its pieces belong together.
        bounded = seeds.possible[label].mean() < 0.5
        drop = ~touched & (areas < (0.02 if bounded else 0.2) * areas.max())
        drop[0] = False
        result[drop[pieces]] = NOTHING
    return result
