"""One frame from the frame beside it."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from neuspring.data.capture import HANDS, NOTHING, OBJECT
from neuspring.perception.marks.colors import Background, Colors, apart, bins_of, count, mixed
from neuspring.perception.marks.marks import FAR, Seeds
from neuspring.perception.marks.start import LABELS, NEVER, solve

COLOR = 0.5
"""Weight of the log densities of colors: neighboring pixels are not independent."""
MOST_COLOR = 6.0
"""Largest log ratio that a pixel's color counts."""
ANYWHERE = (0.01, 0.004, 0.015)
"""Probability that a pixel becomes nothing, object or hand where the flow carries none: things uncover the table or come out of
hiding, hands come in. Without it for nothing, the shadow of an object that left stays its part for good."""
CHANGED = 12.0
"""Difference of L, a, b, from which the flow is doubted."""
CONFIDENT = 0.95
"""Probability from which a pixel teaches colors."""
LEARN, EVERY = 0.2, 4
"""Weight of a frame in the running colors, which are learned from each fourth frame."""
TRUST_START = 0.75
"""Weight of the marked frames' colors, against the running ones."""
SHOWN = 0.5
"""Weight of the colors beneath the marks of a frame on the way, against those of the frames before."""
CORRECTION, CORRECTED = 6.0, 5.0
"""Log odds beside a mark that contradicts what was carried, and how far it reaches, as a multiple of `reach`."""
MOVES = 12.0
"""How far things move in a frame at most, as a multiple of `reach`: the margin of the part of the image that is worked on."""
LEAST_SIDE = 64
"""Smallest side of images between which flow is sought, pixels; smaller ones are continued."""
BROUGHT = 0.2
"""Probability by place from which a piece counts as brought by the flow."""
LEAST_ENTERING = 0.0005
"""Smallest part of the image that a hand covers when it comes in."""


@dataclass(frozen=True, eq=False)
class CarriedFrame:
    """A frame that is solved."""

    probability: np.ndarray
    """[3, H, W]."""
    flow_doubt: np.ndarray
    """[H, W], 0 to 1."""
    misfit: np.ndarray
    """[H, W]: by how much, as a log ratio, another label explains the pixel's color better; 0 or more."""


@dataclass(eq=False, kw_only=True)
class Pass:
    """What is known while labels are carried in one direction."""

    lab: np.ndarray
    """The last frame, Lab [H, W, 3]."""
    probability: np.ndarray
    """Of the last frame [3, H, W]."""
    first: tuple[np.ndarray, ...]
    """Colors of the marked frames: counts [bins] of nothing, object, hands."""
    background: Background | None
    learns: bool
    """Whether the background is learned on the way."""
    reach: float
    running: list[np.ndarray] = field(init=False)
    colors: list[Colors] = field(init=False)
    explained: np.ndarray = field(init=False)
    """[H, W] bool: where the background explains the last frame's colors best."""
    steps: int = 0

    def __post_init__(self) -> None:
        self.explained = np.zeros(self.lab.shape[:2], bool)
        self.running = [np.zeros_like(own) for own in self.first]
        self._learn(None)

    def step(self, lab: np.ndarray, depth: np.ndarray | None = None, seeds: Seeds | None = None) -> CarriedFrame:
        """The next frame, Lab [H, W, 3], which becomes the last one; with its depth, m, and its marks, if there are any."""
        window = self.window(lab, seeds)
        near, before = lab[window], self.probability[(slice(None), *window)]
        place, doubted = self.place(near, self.lab[window], before)
        part = None if seeds is None else seeds.part(window)
        if part is not None:
            self._show(near, part)
            place = self._appear(place, part)
        color = self.color_logs(near, before, window, None if depth is None else depth[window])
        logs = np.log(place) + color
        if part is not None:
            logs += corrections(place, part, self.reach)
        solved = self.tidy(solve(logs.astype(np.float32), near), place, window, part)
        self.probability = np.zeros_like(self.probability)
        self.probability[NOTHING] = 1.0
        self.probability[(slice(None), *window)] = solved
        self.lab, self.steps = lab, self.steps + 1
        self._learn(depth)
        chosen = np.take_along_axis(color, solved.argmax(axis=0)[None], axis=0)[0]
        flow_doubt, misfit = np.zeros(lab.shape[:2], np.float32), np.zeros(lab.shape[:2], np.float32)
        flow_doubt[window], misfit[window] = doubted, color.max(axis=0) - chosen
        return CarriedFrame(self.probability, flow_doubt, misfit)

    def window(self, lab: np.ndarray, seeds: Seeds | None) -> tuple[slice, slice]:
        """The part of the image that is worked on: around what was there, what comes in from the border, and marks."""
        busy = self.probability[NOTHING] < 0.9
        if seeds is not None:
            busy |= seeds.marked
            if self._new(seeds):
                return slice(None), slice(None)
        if self.background is not None:
            busy |= _entering(self.background.changed(lab))
        margin = round(MOVES * self.reach)
        places = []
        for axis in (1, 0):
            found = np.flatnonzero(busy.any(axis=axis))
            places.append(slice(max(found[0] - margin, 0), found[-1] + margin + 1) if len(found) else slice(None))
        return places[0], places[1]

    def place(self, lab: np.ndarray, last: np.ndarray, probability: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities [3, h, w] by what the flow brings, and how far the flow [h, w] is doubted, 0 to 1."""
        flow = flow_between(lab[..., 0], last[..., 0])
        height, width = lab.shape[:2]
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
        came_x, came_y = (np.ascontiguousarray((grid + flow)[..., axis]) for axis in (0, 1))

        def brought(values: np.ndarray) -> np.ndarray:
            image = np.ascontiguousarray(values)
            return np.asarray(cv2.remap(image, came_x, came_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

        change = cv2.absdiff(np.ascontiguousarray(lab), brought(last)).max(axis=-1).astype(np.float32)
        doubt = np.clip(cv2.GaussianBlur(change, (0, 0), 1.5) / CHANGED, 0.05, 1.0)
        moved = np.stack([brought(part) for part in probability], axis=-1)
        narrow, wide = (cv2.GaussianBlur(moved, (0, 0), width * self.reach) for width in (0.35, 2.0))
        place = ((1 - doubt)[..., None] * narrow + doubt[..., None] * wide).transpose(2, 0, 1)
        for label in LABELS:
            if self.first[label].sum():
                place[label] += ANYWHERE[label]
        place = place + np.float32(1e-6)
        return place / place.sum(axis=0), doubt

    def _new(self, seeds: Seeds) -> list[int]:
        """Labels that are marked on a frame and were on none before."""
        return [label for label in (OBJECT, HANDS) if not self.first[label].any() and (seeds.certain == label).any()]

    def _show(self, lab: np.ndarray, seeds: Seeds) -> None:
        """Take the colors beneath the marks of a frame at once: they say what was not known before."""
        bins = bins_of(lab)
        for label in LABELS:
            shown = count(bins, seeds.certain == label)
            if shown.any():
                self.colors[label] = Colors.of(mixed([(1.0, self.first[label]), (SHOWN, shown)]))

    def _appear(self, place: np.ndarray, seeds: Seeds) -> np.ndarray:
        """Probabilities by place [3, h, w], with new labels around their marks."""
        for label in self._new(seeds):
            away = cv2.distanceTransform((seeds.certain != label).astype(np.uint8), cv2.DIST_L2, 5)
            place[label] += np.exp(-away / (FAR * max(self.lab.shape)))
        return np.asarray(place / place.sum(axis=0))

    def color_logs(
        self, lab: np.ndarray, probability: np.ndarray, window: tuple[slice, slice], depth: np.ndarray | None
    ) -> np.ndarray:
        """Weighted log densities [3, h, w] of a frame's colors, and of its depth against the background's."""
        bins = bins_of(lab)
        logs = np.stack([own.logs[bins] for own in self.colors])
        nearer = np.zeros(lab.shape[:2], np.float32)
        if self.background is not None:
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
        """Pieces that nothing brought are nothing, unless they are marked; hands may come in from the image's border."""
        labels = probability.argmax(axis=0)
        rows, columns = self.lab.shape[:2]
        for label in (OBJECT, HANDS):
            number, pieces, boxes, _ = cv2.connectedComponentsWithStats((labels == label).astype(np.uint8))
            support = np.bincount(pieces.ravel(), place[label].ravel() > BROUGHT, minlength=number)
            left, top, width, height, areas = boxes.T
            drop = (support < 0.05 * areas) | (areas < 4)
            if label == HANDS:
                left, top = left + (window[1].start or 0), top + (window[0].start or 0)
                entering = (left == 0) | (top == 0) | (left + width == columns) | (top + height == rows)
                drop &= ~(entering & (areas > LEAST_ENTERING * rows * columns))
            if seeds is not None:
                drop[np.unique(pieces[seeds.certain == label])] = False
            drop[0] = False
            probability[:, drop[pieces]] = np.array([0.98, 0.01, 0.01], np.float32)[:, None]
        return probability

    def _learn(self, depth: np.ndarray | None) -> None:
        """Colors, from each fourth frame, and the background."""
        if self.background is not None and self.learns:
            labels = self.probability.argmax(axis=0)
            self.background.learn(self.lab, apart(labels, 3) & (self.probability[NOTHING] > CONFIDENT), depth)
        if self.steps % EVERY:
            return
        bins = bins_of(self.lab)
        for label in LABELS:
            sure = self.probability[label] > CONFIDENT
            if label != NOTHING:
                core = cv2.erode(sure.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
                # A thin rope has no core.
                sure = (core if core.sum() > 0.4 * sure.sum() else sure) & ~self.explained
            seen = count(bins, sure)
            if seen.sum():
                self.running[label] = (1 - LEARN) * self.running[label] + LEARN * seen / seen.sum()
        parts = [mixed([(TRUST_START, a), (1 - TRUST_START, b)]) for a, b in zip(self.first, self.running, strict=True)]
        self.colors = [Colors.of(part) for part in parts]


def corrections(place: np.ndarray, seeds: Seeds, reach: float) -> np.ndarray:
    """Log odds [3, h, w] of marks on a frame to which labels were carried: what contradicts them there fades with the distance."""
    logs = np.where(seeds.possible, seeds.prior, NEVER)
    carried = place.argmax(axis=0)
    for label in LABELS:
        wrong = (seeds.certain == label) & (carried != label)
        if wrong.any():
            away = cv2.distanceTransform((~wrong).astype(np.uint8), cv2.DIST_L2, 5)
            logs[label] += CORRECTION * np.exp(-away / (CORRECTED * reach))
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
    left, top, width, height, area = boxes.T
    rows, columns = changed.shape
    keep = (left == 0) | (top == 0) | (left + width == columns) | (top + height == rows)
    keep &= area > LEAST_ENTERING * changed.size
    keep[0] = False
    return np.asarray(keep[pieces])
