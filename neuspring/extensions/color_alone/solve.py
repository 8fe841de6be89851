"""The mask of one frame: from its marks, or from the frame beside it.

In a marked frame colors and labels are found from each other, in turns, in a field of labels in which neighbors of the same color
like to be the same (mean field of a Potts model). Another frame gets what the flow brings from the one beside it, and weighs it
against colors, background and depth in the same field.
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
"""Cost of a border between two neighboring pixels of the same color, as a log ratio of probabilities."""
SOLVER_ROUNDS = 10
GRID_NEIGHBORS = ((0, 1, 1.0), (1, 0, 1.0), (1, 1, 0.7071), (1, -1, 0.7071))
"""Steps down and right, and weights: the inverse of the distance. The other four neighbors are opposite."""
BORDER_REACH = 6
"""Pixels from a border of labels within which a pixel may change."""
DECIDED = 10.0
"""Log odds from which no neighbors change a pixel."""
TURNS = 5
NEVER = -40.0
"""Log odds of what marks exclude."""
UNMARKED_PERSON = -2.0
"""Log odds of a person in a frame in which none is marked."""
BACKGROUND_SHADES = (0.88, 0.76)
"""Factors that darken the colors of the background near the object: its shadow."""
SHADED = 0.1
"""Weight of each shade."""
LOCAL_BACKGROUND = 0.8
"""Probability that the background looks like the background around it."""
AROUND_SHARE = 0.03
"""Reach around a pixel, as part of the image."""
RISEN_HEIGHT, RISEN_LOGS = 0.012, 2.0
"""Height above the table, m, from which a pixel is probably object or hand, where marks let it be, and by which log odds."""
COARSE = 6
"""Factor by which images are made smaller to be blurred."""
LOCAL_NOISE = 2.0
"""Least spread of L, a, b."""
FEW_VARIANCE = 0.5
"""Added variance where little of the background is seen."""
CERTAIN_WEIGHT = 1.0
"""Weight of the colors beneath clicks, scribbles and polygons, against those of the whole mask so far."""
COLOR_AT_START, COLOR = 0.6, 0.5
"""Weights of the log densities of colors, in a marked frame and in one beside it: neighboring pixels are not independent."""
MOST_COLOR = 6.0
"""Largest log ratio that a pixel's color counts."""
ANYWHERE = (0.01, 0.004, 0.015, 0.015)
"""Probability that a pixel becomes nothing, object, hand or person where the flow carries none: things uncover the table or come
out of hiding, hands and persons come in. Without it for nothing, the shadow of an object that left stays its part for good."""
CHANGED = 12.0
"""Difference of L, a, b, from which the flow is doubted."""
MOST_HOLE, FILLED = 0.2, 2.0
"""Largest hole that is filled, as part of what is nothing, and the mean log ratio of color from which it is. From 0 on, the table
between a toy and hands was filled too."""
CONFIDENT = 0.95
"""Probability from which a pixel teaches colors."""
LEARN, LEARN_EVERY = 0.2, 4
"""Weight of a frame in the running colors, which are learned from each fourth frame."""
TRUST_START = 0.75
"""Weight of the marked frames' colors, against the running ones."""
MARKED_WEIGHT = 0.5
"""Weight of the colors beneath the marks of a frame on the way, against those of the frames before."""
CORRECTION, CORRECTED = 6.0, 5.0
"""Log odds beside a mark that contradicts what was carried, and how far it reaches, as a multiple of `reach`."""
MOVES_AT_MOST = 12.0
"""Largest motion of things in a frame, as a multiple of `reach`: the margin of the part of the image that is worked on."""
LEAST_SIDE = 64
"""Smallest side of images between which flow is sought, pixels; smaller ones are continued."""
BROUGHT_FROM = 0.2
"""Probability by place from which a piece counts as brought by the flow."""
LEAST_ENTERING = 0.0005
"""Smallest part of the image that a hand covers when it comes in."""


def solve(logs: np.ndarray, lab: np.ndarray, smoothness: float = SMOOTHNESS) -> np.ndarray:
    """Probabilities [K, H, W] of labels from log likelihoods [K, H, W] and an image [H, W, 3].

    q_l(p) ~ exp(u_l(p) + sum_n w_pn q_l(n)),   w_pn = s exp(-|c_p - c_n|^2 / (2 m)) / |p - n|

    over the eight neighbors n, m the mean of |c_p - c_n|^2, s = `smoothness`. Only pixels near a border of labels are solved.
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
        # Half a step: without it, two pixels can exchange their labels forever.
        part = 0.5 * (part + _softmax(message))
        q[:, pixels] = part
    return q.reshape(logs.shape)


def _open(logs: np.ndarray) -> np.ndarray:
    """Which pixels [H, W] are near a border of labels and not decided."""
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
    """A marked frame that is solved."""

    probability: np.ndarray
    """[K, H, W] float32; K = 4 where a person is marked in the film, else 3."""
    counts: tuple[np.ndarray, ...]
    """Counts of the colors of nothing, object, hands and person, [bins] each."""

    @classmethod
    def of(cls, lab: np.ndarray, probability: np.ndarray, seeds: Seeds) -> MarkedFrame:
        """From probabilities that are known: counts the colors."""
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
    """Labels and colors of a frame, Lab [H, W, 3], from its marks; with heights above the table [H, W], m, the background, and the
    colors [bins] of a person that is marked in any frame."""
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
    """Colors [bins] of each label: of a mask [H, W], of what is certain, and of shadows on the background."""
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
    """Log density [H, W] of a pixel's color, if it is like the background around it: normal, with the mean and spread there.

    A table is lit unevenly: as a whole it has the colors of a white toy, and beside the toy it has not.
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
    """Labels to begin with: what is certain or in polygons, and in boxes what has other colors than lie outside of them."""
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
    """Pieces that no mark touches and that are small against the largest are nothing."""
    result = labels.copy()
    for label in range(OBJECT, len(seeds.possible)):
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


@dataclass(eq=False, kw_only=True)
class Pass:
    """State while labels are carried in one direction."""

    lab: np.ndarray
    """The last frame, Lab [H, W, 3]."""
    probability: np.ndarray
    """Probabilities of the last frame [K, H, W]."""
    first: tuple[np.ndarray, ...]
    """Colors of the marked frames: counts [bins] of nothing, object, hands, person."""
    background: Background
    learns: bool
    """True where the background is learned on the way."""
    reach: float
    running: list[np.ndarray] = field(init=False)
    colors: list[np.ndarray] = field(init=False)
    """Log densities [bins] of each label."""
    explained: np.ndarray = field(init=False)
    """[H, W] bool: where the background explains the last frame's colors best."""
    steps: int = 0

    def __post_init__(self) -> None:
        self.explained = np.zeros(self.lab.shape[:2], bool)
        self.running = [np.zeros_like(own) for own in self.first]
        self._learn(None)

    def step(self, lab: np.ndarray, depth: np.ndarray | None = None, seeds: Seeds | None = None) -> np.ndarray:
        """Probabilities [K, H, W] of the next frame, Lab [H, W, 3], which becomes the last one; with its depth, m, and marks."""
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
        """The part of the image that is worked on: around what was there, what comes in from the border, and marks."""
        busy = self.probability[NOTHING] < 0.9
        if seeds is not None:
            busy |= seeds.marked
            if self._new(seeds):
                return slice(None), slice(None)
        busy |= _entering(self.background.changed(lab))
        margin = round(MOVES_AT_MOST * self.reach)
        places = []
        for axis in (1, 0):
            found = np.flatnonzero(busy.any(axis=axis))
            places.append(slice(max(found[0] - margin, 0), found[-1] + margin + 1) if len(found) else slice(None))
        return places[0], places[1]

    def place(self, lab: np.ndarray, last: np.ndarray, probability: np.ndarray) -> np.ndarray:
        """Probabilities [K, h, w] by what the flow brings."""
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
        """Labels that are marked on a frame and were on none before."""
        return [label for label in range(OBJECT, len(self.first)) if not self.first[label].any() and (seeds.certain == label).any()]

    def _show(self, lab: np.ndarray, seeds: Seeds) -> None:
        """Take the colors beneath the marks of a frame at once: they say what was not known before."""
        bins = bins_of(lab)
        for label in range(len(self.first)):
            if (shown := count(bins, seeds.certain == label)).any():
                self.colors[label] = log_density(mixed([(1.0, self.first[label]), (MARKED_WEIGHT, shown)]))

    def color_logs(
        self, lab: np.ndarray, probability: np.ndarray, window: tuple[slice, slice], depth: np.ndarray | None
    ) -> np.ndarray:
        """Weighted log densities [K, h, w] of a frame's colors, and of its depth against the background's."""
        bins = bins_of(lab)
        logs = np.stack([own[bins] for own in self.colors])
        nearer = np.zeros(lab.shape[:2], np.float32)
        background = self.background.part(window)
        gain = background.gain(lab, probability[NOTHING] > CONFIDENT)
        logs[NOTHING] = background.explain(logs[NOTHING], lab, gain)
        if depth is not None:
            nearer = background.depth_log_ratio(depth)
        # What the background explains teaches no color of the object: its shadow would become a part of it.
        self.explained = np.zeros(self.lab.shape[:2], bool)
        self.explained[window] = logs[NOTHING] > logs[1:].max(axis=0)
        logs = COLOR * np.maximum(logs - logs.max(axis=0), -MOST_COLOR / COLOR)
        logs[NOTHING] += nearer
        return np.asarray(logs, dtype=np.float32)

    def tidy(self, probability: np.ndarray, place: np.ndarray, window: tuple[slice, slice], seeds: Seeds | None) -> np.ndarray:
        """Pieces that nothing brought are nothing, unless they are marked; hands and persons may come in from the
        image's border."""
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
        """Holes in object and hands are object where no background was ever seen, unless they look like the background around.

        What a hand uncovers of a cloth has colors that no mark knows, such as those of folds.
        """
        nothing, seen = probability.argmax(axis=0) == NOTHING, self.background.part(window).seen > 0
        number, pieces, boxes, _ = cv2.connectedComponentsWithStats(nothing.astype(np.uint8), connectivity=4)
        areas = boxes[:, cv2.CC_STAT_AREA]
        # The piece 0 is what is not nothing.
        holes = ~at_border(boxes, nothing.shape) & (np.arange(number) > 0) & (areas < MOST_HOLE * nothing.sum())
        if (unseen := holes[pieces] & ~seen).any():
            ratio = self.colors[OBJECT][bins_of(lab)] - _local_density(lab, nothing & seen)
            gain = np.bincount(pieces[unseen], np.clip(ratio[unseen], -MOST_COLOR, MOST_COLOR), minlength=number)
            count_unseen = np.bincount(pieces[unseen], minlength=number)
            holes &= (gain > FILLED * count_unseen) & (count_unseen > 0.5 * areas)
            probability[:, holes[pieces]] = self._nearly(OBJECT)

    def _nearly(self, label: int) -> np.ndarray:
        """Probabilities [K, 1] of a pixel that is surely of a label."""
        return np.where(np.arange(len(self.first)) == label, 0.98, 0.01).astype(np.float32)[:, None]

    def _learn(self, depth: np.ndarray | None) -> None:
        """Colors, from each fourth frame, and the background."""
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
    """Log odds [K, h, w] of marks on a frame to which labels were carried: what contradicts them there fades with the distance."""
    logs = np.where(seeds.possible, seeds.prior, NEVER)
    carried = place.argmax(axis=0)
    for label in range(len(logs)):
        if (wrong := (seeds.certain == label) & (carried != label)).any():
            logs[label] += CORRECTION * np.exp(-away_from(wrong) / (CORRECTED * reach))
    return logs


def flow_between(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Flow [H, W, 2], pixels: where in image `there` each pixel of `here` is (gray [H, W] uint8)."""
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    height, width = here.shape
    # Its pyramid is chosen by the longer side; a strip would vanish on the way up, which OpenCV does not survive.
    least = max(LEAST_SIDE, max(height, width) // 2)
    beside = (0, max(least - height, 0), 0, max(least - width, 0))
    wide = [np.asarray(cv2.copyMakeBorder(image, *beside, cv2.BORDER_REPLICATE)) for image in (here, there)]
    flow = method.calc(wide[0], wide[1], np.zeros((*wide[0].shape, 2), np.float32))
    return np.asarray(flow)[:height, :width]


def _entering(changed: np.ndarray) -> np.ndarray:
    """Pieces of what changed [H, W] bool that reach the border of the image and are not small."""
    opened = cv2.morphologyEx(changed.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, pieces, boxes, _ = cv2.connectedComponentsWithStats(opened)
    keep = at_border(boxes, changed.shape) & (boxes[:, cv2.CC_STAT_AREA] > LEAST_ENTERING * changed.size)
    keep[0] = False
    return np.asarray(keep[pieces])
