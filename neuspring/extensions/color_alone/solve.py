"""Labels of one frame, from its annotations or from the neighboring frame.

In an annotated frame, labels and their colors are estimated alternately. Labels follow from a Potts model in which neighbors of
similar color prefer the same label, solved by mean-field iteration. In other frames, optical flow carries the labels of the
neighboring frame, and the same model combines them with colors, background and depth.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from neuspring.data.capture import HANDS, NOTHING, OBJECT, PERSON
from neuspring.extensions.color_alone.colors import (
    Background,
    apart,
    bins_of,
    count,
    log_density,
    mixed,
    shaded_density,
)
from neuspring.extensions.color_alone.pixels import away_from, core_of, disc
from neuspring.extensions.color_alone.seeds import ODDS_FALL, UNMARKED_PIXEL, Seeds
from neuspring.perception.film import at_border

SMOOTHNESS = 1.5
"""Cost of a border between neighboring pixels of the same color, as a log ratio of probabilities."""
SOLVER_ROUNDS = 10
GRID_NEIGHBORS = ((0, 1, 1.0), (1, 0, 1.0), (1, 1, 0.7071), (1, -1, 0.7071))
"""Steps down and right, and weight (inverse distance) of four neighbors; the other four are opposite."""
BORDER_REACH = 6
"""Largest distance from a border of labels at which a pixel may change, pixels."""
DECIDED = 10.0
"""Log odds above which neighbors cannot change a pixel."""
TURNS = 5
NEVER = -40.0
"""Log odds of labels that annotations exclude."""
UNMARKED_PERSON = -2.0
"""Log odds of a person in a frame without an annotated person."""
BACKGROUND_SHADES = (0.88, 0.76)
"""Factors that darken the background's colors near the object, for its shadow."""
SHADED = 0.1
"""Weight of each shade."""
LOCAL_BACKGROUND = 0.8
"""Probability that a background pixel matches the background around it."""
AROUND_SHARE = 0.03
"""Radius of the local background, as a fraction of the image."""
RISEN_HEIGHT, RISEN_LOGS = 0.012, 2.0
"""Height above the table, m, above which a pixel is probably not background, and the log odds of that."""
COARSE = 6
"""Downscaling factor for blurs."""
LOCAL_NOISE = 2.0
"""Smallest standard deviation of L, a and b in the local background."""
FEW_VARIANCE = 0.5
"""Variance added where little background is visible."""
CERTAIN_WEIGHT = 1.0
"""Weight of the colors beneath clicks, scribbles and polygons, relative to those of the present mask."""
COLOR_AT_START, COLOR = 0.6, 0.5
"""Weights of log densities of colors in annotated and in other frames; below 1 because neighboring pixels are dependent."""
MOST_COLOR = 6.0
"""Largest log ratio from the color of a pixel."""
ANYWHERE = (0.01, 0.004, 0.015, 0.015)
"""Probabilities that a pixel becomes nothing, object, hand or person without carried evidence, by uncovering or by entering the
image. With 0 for nothing, the shadow of an object that moved away stays object."""
CHANGED = 12.0
"""Difference of L, a, b at which the flow counts as wrong."""
MOST_HOLE, FILLED = 0.2, 2.0
"""Largest filled hole, as a fraction of all background pixels, and smallest mean log ratio of its colors. A log ratio of 0 also
fills the table between a toy and hands."""
CONFIDENT = 0.95
"""Probability above which colors are learned from a pixel."""
LEARN, LEARN_EVERY = 0.2, 4
"""Weight of a frame in the running colors, and interval of these updates, frames."""
TRUST_START = 0.75
"""Weight of the annotated frames' colors, relative to the running ones."""
MARKED_WEIGHT = 0.5
"""Weight of the colors beneath the annotations of a later frame, relative to earlier annotated frames."""
CORRECTION, CORRECTED = 6.0, 5.0
"""Log odds at an annotation that contradicts carried labels, and its range as a multiple of `reach`."""
MOVES_AT_MOST = 12.0
"""Largest motion between frames, as a multiple of `reach`: the margin of the solved window."""
LEAST_SIDE = 64
"""Smallest side of images for optical flow, pixels; smaller ones are padded."""
BROUGHT_FROM = 0.2
"""Carried probability above which a pixel supports its component."""
LEAST_ENTERING = 0.0005
"""Smallest area of a hand that enters the image, as a fraction of the image."""


def solve(logs: np.ndarray, lab: np.ndarray, smoothness: float = SMOOTHNESS) -> np.ndarray:
    """Label probabilities [K, H, W] from log likelihoods u [K, H, W] and an image c [H, W, 3], by mean-field iteration:

        q_l(p) ~ exp(u_l(p) + sum_n w_pn q_l(n)),   w_pn = s exp(-|c_p - c_n|^2 / (2 m)) / |p - n|

    n are the eight neighbors of p, m is the mean of |c_p - c_n|^2, and s is `smoothness`. Only pixels near a border of labels
    change.
    """
    kinds, height, width = logs.shape
    q = _softmax(logs).reshape(kinds, -1)
    if not len(pixels := np.flatnonzero(_open(logs))):
        return q.reshape(logs.shape)
    flat, color = logs.reshape(kinds, -1)[:, pixels], lab.reshape(-1, 3).astype(np.float32)
    rows, columns = np.divmod(pixels, width)
    beside, squares, weights = [], [], []
    for down, right, weight in GRID_NEIGHBORS:
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
    for _ in range(SOLVER_ROUNDS):
        message = flat.copy()
        for place, link in zip(beside, links, strict=True):
            message += link * q[:, place]
        # The damping prevents two pixels from exchanging their labels forever.
        part = 0.5 * (part + _softmax(message))
        q[:, pixels] = part
    return q.reshape(logs.shape)


def _open(logs: np.ndarray) -> np.ndarray:
    """True for pixels [H, W] near a border of labels that are not decided."""
    best = logs.argmax(axis=0).astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    border = (cv2.dilate(best, kernel) != cv2.erode(best, kernel)).astype(np.uint8)
    near = cv2.dilate(border, disc(BORDER_REACH)).astype(bool)
    first = logs.max(axis=0)
    others = np.stack([np.where(best == label, -np.inf, part) for label, part in enumerate(logs)]).max(axis=0)
    return np.asarray(near & (first - others < DECIDED))


def _softmax(logs: np.ndarray) -> np.ndarray:
    powers = np.exp(logs - logs.max(axis=0))
    return np.asarray(powers / powers.sum(axis=0), dtype=np.float32)


@dataclass(frozen=True, eq=False)
class MarkedFrame:
    """Solution of an annotated frame."""

    probability: np.ndarray
    """[K, H, W] float32; K = 4 if a person is annotated in the video, else 3."""
    counts: tuple[np.ndarray, ...]
    """Histograms [bins] of nothing, object, hands and person."""

    @classmethod
    def of(cls, lab: np.ndarray, probability: np.ndarray, seeds: Seeds) -> MarkedFrame:
        """Make it from known probabilities."""
        labels = probability.argmax(axis=0).astype(np.uint8)
        return cls(probability, tuple(counts_of(lab, bins_of(lab), labels, seeds)))

    @property
    def labels(self) -> np.ndarray:
        """[H, W] uint8."""
        return np.asarray(self.probability.argmax(axis=0), dtype=np.uint8)


def start(
    lab: np.ndarray,
    seeds: Seeds,
    height: np.ndarray | None,
    background: Background,
    person: np.ndarray | None,
) -> MarkedFrame:
    """Solve an annotated frame, Lab [H, W, 3], from the evidence of its annotations.

    `height` [H, W], m: heights above the table. `person` [bins]: histogram of a person that is annotated in any frame.
    """
    bins, labels = bins_of(lab), _first(lab, seeds)
    place = np.where(seeds.possible, seeds.prior, NEVER).astype(np.float32)
    if person is not None and not (seeds.certain == PERSON).any():
        place[PERSON] += UNMARKED_PERSON
    if height is not None:
        place[NOTHING] -= np.where(np.nan_to_num(height) > RISEN_HEIGHT, RISEN_LOGS, 0.0)
    for _ in range(TURNS):
        counts = counts_of(lab, bins, labels, seeds)
        if person is not None:
            counts[PERSON] = mixed([(1.0, counts[PERSON]), (1.0, person)])
        logs = np.stack([log_density(own)[bins] if own.sum() else np.full(bins.shape, NEVER) for own in counts])
        near = np.log(LOCAL_BACKGROUND) + _local_density(lab, labels == NOTHING)
        logs[NOTHING] = np.logaddexp(near, np.log(1 - LOCAL_BACKGROUND) + logs[NOTHING])
        logs[NOTHING] = background.explain(logs[NOTHING], lab, np.zeros(3, np.float32))
        logs = place + COLOR_AT_START * logs
        probability = solve(logs.astype(np.float32), lab)
        labels = tidy(probability.argmax(axis=0).astype(np.uint8), seeds)
    probability[:, labels != probability.argmax(axis=0)] = np.eye(len(probability))[NOTHING][:, None]
    return MarkedFrame.of(lab, probability, seeds)


def counts_of(lab: np.ndarray, bins: np.ndarray, labels: np.ndarray, seeds: Seeds) -> list[np.ndarray]:
    """Histogram [bins] of each label, from labels [H, W], certain pixels, and shadows on the background."""
    counts = []
    for label in range(len(seeds.possible)):
        own = labels == label
        parts = [(1.0, count(bins, core_of(own, 0.5)))]
        if label == NOTHING:
            near = own & (away_from(~own) < 0.1 * max(own.shape))
            parts.append((1.0, count(bins, near)))
            for shade in BACKGROUND_SHADES:
                darker = lab.copy()
                darker[..., 0] = (shade * lab[..., 0]).astype(np.uint8)
                parts.append((SHADED, count(bins_of(darker), near)))
        else:
            parts.append((CERTAIN_WEIGHT, count(bins, seeds.certain == label)))
        counts.append(mixed(parts))
    return counts


def _local_density(lab: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Log density [H, W] of each pixel's color under a normal density with mean and spread of the background `rest` around it.

    Globally, an unevenly lit table matches a white toy's colors; locally it does not.
    """
    width, image = AROUND_SHARE * max(rest.shape), lab.astype(np.float32)
    weight = rest.astype(np.float32)[..., None]

    def blurred(values: np.ndarray) -> np.ndarray:
        small = cv2.resize(values, None, fx=1 / COARSE, fy=1 / COARSE, interpolation=cv2.INTER_AREA)
        smooth = cv2.GaussianBlur(small, (0, 0), width / COARSE)
        return cv2.resize(smooth, rest.shape[::-1]).reshape(*rest.shape, -1)

    share = np.maximum(blurred(weight), 1e-4)
    mean = blurred(weight * image) / share
    variance = np.maximum(blurred(weight * image**2) / share - mean**2, 0.0) + LOCAL_NOISE**2 + FEW_VARIANCE / share
    return shaded_density(image - mean, np.sqrt(variance))


def _first(lab: np.ndarray, seeds: Seeds) -> np.ndarray:
    """Initial labels: certain pixels and polygons, and pixels in boxes whose colors do not occur outside the boxes."""
    bins, labels = bins_of(lab), np.zeros(lab.shape[:2], np.uint8)
    free = seeds.certain == UNMARKED_PIXEL
    outside = ~seeds.possible[OBJECT] & ~seeds.possible[HANDS]
    if not outside.any():
        outside = free
    rest = log_density(count(bins, outside))[bins]
    for label, other in ((OBJECT, HANDS), (HANDS, OBJECT)):
        known = (seeds.certain == label) | (seeds.prior[label] > 0)
        labels[known & free] = label
        inside = seeds.possible[label] & free
        if known.sum() > 20 and (inside.mean() > 0.5 or (seeds.prior[label] > 0).any()):
            continue
        alone = inside & ~seeds.possible[other]
        own = alone if alone.sum() > 0.2 * inside.sum() else inside
        if own.any():
            ratio = log_density(count(bins, own))[bins] - rest
            labels[inside & (ratio > 1.0) & (labels == 0)] = label
    return np.where(free, labels, seeds.certain).astype(np.uint8)


def tidy(labels: np.ndarray, seeds: Seeds) -> np.ndarray:
    """Remove components without annotations that are small relative to the largest one."""
    result = labels.copy()
    for label in range(OBJECT, len(seeds.possible)):
        number, pieces, boxes, _ = cv2.connectedComponentsWithStats((labels == label).astype(np.uint8))
        if number <= 2:
            continue
        areas = boxes[:, cv2.CC_STAT_AREA].copy()
        areas[0] = 0
        touched = np.zeros(number, bool)
        touched[np.unique(pieces[(seeds.certain == label) | (seeds.prior[label] > 0)])] = True
        # In a box, small components probably belong to the label.
        bounded = seeds.possible[label].mean() < 0.5
        drop = ~touched & (areas < (0.02 if bounded else 0.2) * areas.max())
        drop[0] = False
        result[drop[pieces]] = NOTHING
    return result


@dataclass(eq=False, kw_only=True)
class Pass:
    """State of carrying labels in one direction."""

    lab: np.ndarray
    """Previous frame, Lab [H, W, 3]."""
    probability: np.ndarray
    """Probabilities of the previous frame [K, H, W]."""
    first: tuple[np.ndarray, ...]
    """Histograms [bins] of nothing, object, hands and person in the annotated frames."""
    background: Background
    learns: bool
    """True if the pass also learns the background."""
    reach: float
    running: list[np.ndarray] = field(init=False)
    colors: list[np.ndarray] = field(init=False)
    """Log densities [bins] of each label."""
    explained: np.ndarray = field(init=False)
    """[H, W] bool: the background explains the previous frame's color best."""
    steps: int = 0

    def __post_init__(self) -> None:
        self.explained = np.zeros(self.lab.shape[:2], bool)
        self.running = [np.zeros_like(own) for own in self.first]
        self._learn(None)

    def step(self, lab: np.ndarray, depth: np.ndarray | None = None, seeds: Seeds | None = None) -> np.ndarray:
        """Probabilities [K, H, W] of the next frame, Lab [H, W, 3], with its depth, m, and annotations; advances the state."""
        window = self.window(lab, seeds)
        near, before = lab[window], self.probability[(slice(None), *window)]
        place = self.place(near, self.lab[window], before)
        part = None if seeds is None else seeds.part(window)
        if part is not None:
            self._show(near, part)
            for label in self._new(part):
                place[label] += np.exp(-away_from(part.certain == label) / (ODDS_FALL * max(self.lab.shape)))
            place = place / place.sum(axis=0)
        color = self.color_logs(near, before, window, None if depth is None else depth[window])
        logs = np.log(place) + color
        if part is not None:
            logs += corrections(place, part, self.reach)
        solved = self.tidy(solve(logs.astype(np.float32), near), place, window, part)
        self.fill(solved, near, window)
        self.probability = np.zeros_like(self.probability)
        self.probability[NOTHING] = 1.0
        self.probability[(slice(None), *window)] = solved
        self.lab, self.steps = lab, self.steps + 1
        self._learn(depth)
        return self.probability

    def window(self, lab: np.ndarray, seeds: Seeds | None) -> tuple[slice, slice]:
        """Window of the image to solve: previous labels, changes that enter at the border, and annotations, with a margin."""
        busy = self.probability[NOTHING] < 0.9
        if seeds is not None:
            busy |= seeds.marked
            if self._new(seeds):
                return slice(None), slice(None)
        busy |= _entering(self.background.changed(lab))
        margin = round(MOVES_AT_MOST * self.reach)
        sides = []
        for axis in (1, 0):
            used = np.flatnonzero(busy.any(axis=axis))
            sides.append(slice(max(used[0] - margin, 0), used[-1] + margin + 1) if len(used) else slice(None))
        return sides[0], sides[1]

    def place(self, lab: np.ndarray, last: np.ndarray, probability: np.ndarray) -> np.ndarray:
        """Probabilities [K, h, w] carried by the optical flow."""
        flow = flow_between(lab[..., 0], last[..., 0])
        height, width = lab.shape[:2]
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
        came_x, came_y = (np.ascontiguousarray((grid + flow)[..., axis]) for axis in (0, 1))

        def brought(values: np.ndarray) -> np.ndarray:
            image = np.ascontiguousarray(values)
            return cv2.remap(image, came_x, came_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

        change = cv2.absdiff(np.ascontiguousarray(lab), brought(last)).max(axis=-1).astype(np.float32)
        doubt = np.clip(cv2.GaussianBlur(change, (0, 0), 1.5) / CHANGED, 0.05, 1.0)
        moved = np.stack([brought(part) for part in probability], axis=-1)
        narrow, wide = (cv2.GaussianBlur(moved, (0, 0), width * self.reach) for width in (0.35, 2.0))
        place = ((1 - doubt)[..., None] * narrow + doubt[..., None] * wide).transpose(2, 0, 1)
        for label in range(len(place)):
            if self.first[label].sum():
                place[label] += ANYWHERE[label]
        place = place + np.float32(1e-6)
        return np.asarray(place / place.sum(axis=0))

    def _new(self, seeds: Seeds) -> list[int]:
        """Labels that are annotated for the first time."""
        return [label for label in range(OBJECT, len(self.first)) if not self.first[label].any() and (seeds.certain == label).any()]

    def _show(self, lab: np.ndarray, seeds: Seeds) -> None:
        """Learn the colors beneath the annotations of a frame before it is solved."""
        bins = bins_of(lab)
        for label in range(len(self.first)):
            if (shown := count(bins, seeds.certain == label)).any():
                self.colors[label] = log_density(mixed([(1.0, self.first[label]), (MARKED_WEIGHT, shown)]))

    def color_logs(
        self, lab: np.ndarray, probability: np.ndarray, window: tuple[slice, slice], depth: np.ndarray | None
    ) -> np.ndarray:
        """Weighted log densities [K, h, w] of a frame's colors, and of its depth relative to the background."""
        bins = bins_of(lab)
        logs = np.stack([own[bins] for own in self.colors])
        nearer = np.zeros(lab.shape[:2], np.float32)
        background = self.background.part(window)
        gain = background.gain(lab, probability[NOTHING] > CONFIDENT)
        logs[NOTHING] = background.explain(logs[NOTHING], lab, gain)
        if depth is not None:
            nearer = background.depth_log_ratio(depth)
        # Colors that the background explains are not learned for the object, or its shadow would become object.
        self.explained = np.zeros(self.lab.shape[:2], bool)
        self.explained[window] = logs[NOTHING] > logs[1:].max(axis=0)
        logs = COLOR * np.maximum(logs - logs.max(axis=0), -MOST_COLOR / COLOR)
        logs[NOTHING] += nearer
        return np.asarray(logs, dtype=np.float32)

    def tidy(self, probability: np.ndarray, place: np.ndarray, window: tuple[slice, slice], seeds: Seeds | None) -> np.ndarray:
        """Remove components without carried support or annotation, except hands and persons that enter at the image border."""
        labels = probability.argmax(axis=0)
        rows, columns = self.lab.shape[:2]
        for label in range(OBJECT, len(probability)):
            number, pieces, boxes, _ = cv2.connectedComponentsWithStats((labels == label).astype(np.uint8))
            support = np.bincount(pieces.ravel(), place[label].ravel() > BROUGHT_FROM, minlength=number)
            areas = boxes[:, cv2.CC_STAT_AREA]
            drop = (support < 0.05 * areas) | (areas < 4)
            if label != OBJECT:
                in_image = np.add(boxes, [window[1].start or 0, window[0].start or 0, 0, 0, 0])
                drop &= ~(at_border(in_image, (rows, columns)) & (areas > LEAST_ENTERING * rows * columns))
            if seeds is not None:
                drop[np.unique(pieces[seeds.certain == label])] = False
            drop[0] = False
            probability[:, drop[pieces]] = self._nearly(NOTHING)
        return probability

    def fill(self, probability: np.ndarray, lab: np.ndarray, window: tuple[slice, slice]) -> None:
        """Fill holes in object and hands where the background was never seen, unless they match the background around them.

        A hand can uncover parts of a cloth with unknown colors, such as folds.
        """
        nothing, seen = probability.argmax(axis=0) == NOTHING, self.background.part(window).seen > 0
        number, pieces, boxes, _ = cv2.connectedComponentsWithStats(nothing.astype(np.uint8), connectivity=4)
        areas = boxes[:, cv2.CC_STAT_AREA]
        # Component 0 contains all labeled pixels.
        holes = ~at_border(boxes, nothing.shape) & (np.arange(number) > 0) & (areas < MOST_HOLE * nothing.sum())
        if (unseen := holes[pieces] & ~seen).any():
            ratio = self.colors[OBJECT][bins_of(lab)] - _local_density(lab, nothing & seen)
            gain = np.bincount(pieces[unseen], np.clip(ratio[unseen], -MOST_COLOR, MOST_COLOR), minlength=number)
            count_unseen = np.bincount(pieces[unseen], minlength=number)
            holes &= (gain > FILLED * count_unseen) & (count_unseen > 0.5 * areas)
            probability[:, holes[pieces]] = self._nearly(OBJECT)

    def _nearly(self, label: int) -> np.ndarray:
        """Probabilities [K, 1] of a pixel with a certain label."""
        return np.where(np.arange(len(self.first)) == label, 0.98, 0.01).astype(np.float32)[:, None]

    def _learn(self, depth: np.ndarray | None) -> None:
        """Learn colors from every fourth frame, and the background."""
        if self.learns:
            labels = self.probability.argmax(axis=0)
            self.background.learn(self.lab, apart(labels, 3) & (self.probability[NOTHING] > CONFIDENT), depth)
        if self.steps % LEARN_EVERY:
            return
        bins = bins_of(self.lab)
        for label in range(len(self.first)):
            sure = self.probability[label] > CONFIDENT
            if label != NOTHING:
                sure = core_of(sure, 0.4) & ~self.explained
            seen = count(bins, sure)
            if seen.sum():
                self.running[label] = (1 - LEARN) * self.running[label] + LEARN * seen / seen.sum()
        parts = [mixed([(TRUST_START, a), (1 - TRUST_START, b)]) for a, b in zip(self.first, self.running, strict=True)]
        self.colors = [log_density(part) for part in parts]


def corrections(place: np.ndarray, seeds: Seeds, reach: float) -> np.ndarray:
    """Log odds [K, h, w] of annotations in a frame with carried labels; corrections fade with the distance."""
    logs = np.where(seeds.possible, seeds.prior, NEVER)
    carried = place.argmax(axis=0)
    for label in range(len(logs)):
        if (wrong := (seeds.certain == label) & (carried != label)).any():
            logs[label] += CORRECTION * np.exp(-away_from(wrong) / (CORRECTED * reach))
    return logs


def flow_between(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Optical flow [H, W, 2] from image `here` to image `there`, pixels; both are gray [H, W] uint8."""
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    height, width = here.shape
    # The longer side determines the pyramid. A narrow strip would shrink to nothing, which crashes OpenCV.
    least = max(LEAST_SIDE, max(height, width) // 2)
    margins = (0, max(least - height, 0), 0, max(least - width, 0))
    padded = [np.asarray(cv2.copyMakeBorder(image, *margins, cv2.BORDER_REPLICATE)) for image in (here, there)]
    flow = method.calc(padded[0], padded[1], np.zeros((*padded[0].shape, 2), np.float32))
    return np.asarray(flow)[:height, :width]


def _entering(changed: np.ndarray) -> np.ndarray:
    """Components of changed pixels [H, W] bool that touch the image border and are not small."""
    opened = cv2.morphologyEx(changed.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, pieces, boxes, _ = cv2.connectedComponentsWithStats(opened)
    keep = at_border(boxes, changed.shape) & (boxes[:, cv2.CC_STAT_AREA] > LEAST_ENTERING * changed.size)
    keep[0] = False
    return np.asarray(keep[pieces])
