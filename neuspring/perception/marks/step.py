"""One frame from the frame beside it."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from neuspring.data.capture import HANDS, NOTHING, OBJECT
from neuspring.perception.marks.background import Background, apart
from neuspring.perception.marks.colors import Colors, bins_of, count, mixed
from neuspring.perception.marks.field import solve
from neuspring.perception.marks.seeds import Seeds
from neuspring.perception.marks.start import LABELS, NEVER

COLOR = 0.5
"""Weight of the log densities of colors: neighboring pixels are not independent."""
MOST_COLOR = 6.0
"""Largest log ratio that a pixel's color counts."""
ANYWHERE = (0.0, 0.004, 0.015)
"""Probability that a pixel becomes object or hand far from where the flow carries one: things come out of hiding, hands come in."""
CHANGED = 12.0
"""Difference of L, a, b, from which the flow is doubted."""
CONFIDENT = 0.95
"""Probability from which a pixel teaches colors."""
LEARN = 0.08
"""Weight of a frame in the running colors."""
TRUST_START = 0.6
"""Weight of the marked frame's colors, against the running ones."""
USUAL = 0.9
"""Probability that a background pixel has its usual color."""
SURE_AFTER = 3.0
"""Looks after which the usual color of a pixel is known."""

CORRECTION, CORRECTED = 6.0, 5.0
"""Log odds beside a mark that contradicts what was carried, and how far it reaches, as a multiple of `reach`."""


@dataclass(frozen=True, eq=False)
class Step:
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
    """[3, H, W]."""
    first: tuple[np.ndarray, ...]
    """Colors of the marked frames: counts [bins] of nothing, object, hands."""
    background: Background | None
    learns: bool
    """Whether the background is learned on the way."""
    smoothness: float
    reach: float
    running: list[np.ndarray] = field(default_factory=list)
    colors: list[Colors] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.running = [np.zeros_like(own) for own in self.first]
        self._learn(bins_of(self.lab))

    def step(self, lab: np.ndarray, seeds: Seeds | None = None) -> Step:
        """The next frame, Lab [H, W, 3], which becomes the last one; with its marks, if there are any."""
        place, flow_doubt = self.place(lab)
        color = self.color_logs(lab)
        logs = np.log(place) + color
        if seeds is not None:
            logs += corrections(place, seeds, self.reach)
        probability = solve(logs.astype(np.float32), lab, self.smoothness)
        self.probability = self.tidy(probability, place, seeds)
        self.lab = lab
        self._learn(bins_of(lab))
        chosen = np.take_along_axis(color, self.probability.argmax(axis=0)[None], axis=0)[0]
        return Step(self.probability, flow_doubt, color.max(axis=0) - chosen)

    def place(self, lab: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities [3, H, W] by what the flow brings, and how far the flow [H, W] is doubted, 0 to 1."""
        flow = flow_between(lab[..., 0], self.lab[..., 0])
        height, width = lab.shape[:2]
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
        came = grid + flow
        brought = [cv2.remap(q, came, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for q in self.probability]
        before = cv2.remap(self.lab, came, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        change = np.abs(lab.astype(np.float32) - before).max(axis=-1)
        doubt = np.clip(cv2.GaussianBlur(change, (0, 0), 1.5) / CHANGED, 0.05, 1.0)
        narrow = [cv2.GaussianBlur(q, (0, 0), 0.35 * self.reach) for q in brought]
        wide = [cv2.GaussianBlur(q, (0, 0), 2 * self.reach) for q in brought]
        place = np.stack([(1 - doubt) * near + doubt * far for near, far in zip(narrow, wide, strict=True)])
        for label in (OBJECT, HANDS):
            if self.first[label].sum():
                place[label] += ANYWHERE[label]
        place += 1e-6
        return place / place.sum(axis=0), doubt

    def color_logs(self, lab: np.ndarray) -> np.ndarray:
        """Weighted log densities [3, H, W] of a frame's colors."""
        bins = bins_of(lab)
        logs = np.stack([own.logs[bins] for own in self.colors])
        if self.background is not None:
            still = (self.probability[NOTHING] > CONFIDENT).astype(bool)
            usual = self.background.log_density(lab, self.background.gain(lab, still))
            known = np.clip(self.background.seen / SURE_AFTER, 0, 1) * USUAL
            mixture = np.logaddexp(np.log(known + 1e-9) + usual, np.log(1 - known) + logs[NOTHING])
            logs[NOTHING] = np.where(known > 0, mixture, logs[NOTHING])
        top = logs.max(axis=0)
        return COLOR * np.maximum(logs - top, -MOST_COLOR / COLOR)

    def tidy(self, probability: np.ndarray, place: np.ndarray, seeds: Seeds | None) -> np.ndarray:
        """Pieces of object that nothing brought are nothing; hands may come in from the image's border."""
        labels = probability.argmax(axis=0)
        for label in (OBJECT, HANDS):
            number, pieces, boxes, _ = cv2.connectedComponentsWithStats((labels == label).astype(np.uint8))
            if number == 1:
                continue
            support = np.bincount(pieces.ravel(), place[label].ravel() > 0.2, minlength=number)
            areas = boxes[:, cv2.CC_STAT_AREA]
            drop = support < 0.05 * areas
            if label == HANDS:
                left, top, width, height = (boxes[:, k] for k in range(4))
                rows, columns = labels.shape
                entering = (left == 0) | (top == 0) | (left + width == columns) | (top + height == rows)
                drop &= ~(entering & (areas > 0.0005 * labels.size))
            drop |= areas < 4
            if seeds is not None:
                drop[np.unique(pieces[seeds.certain == label])] = False
            drop[0] = False
            lost = drop[pieces]
            probability[:, lost] = np.array([0.98, 0.01, 0.01], np.float32)[:, None]
        return probability

    def _learn(self, bins: np.ndarray) -> None:
        for label, first in enumerate(self.first):
            sure = self.probability[label] > CONFIDENT
            if label != NOTHING:
                core = cv2.erode(sure.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
                sure = core if core.sum() > 0.4 * sure.sum() else sure
            seen = count(bins, sure)
            if seen.sum():
                self.running[label] = (1 - LEARN) * self.running[label] + LEARN * seen / seen.sum()
        parts = [mixed([(TRUST_START, a), (1 - TRUST_START, b)]) for a, b in zip(self.first, self.running, strict=True)]
        self.colors = [Colors.of(part if np.ndim(part) else np.zeros_like(self.first[0])) for part in parts]
        if self.background is not None and self.learns:
            labels = self.probability.argmax(axis=0)
            self.background.learn(self.lab, apart(labels, 3) & (self.probability[NOTHING] > CONFIDENT))


def corrections(place: np.ndarray, seeds: Seeds, reach: float) -> np.ndarray:
    """Log odds [3, H, W] of marks on a frame to which labels were carried: what contradicts them there fades with the distance."""
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
    return np.asarray(method.calc(np.ascontiguousarray(here), np.ascontiguousarray(there), None))
