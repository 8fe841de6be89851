"""From marks on a few frames to labels of every frame of one camera, and how far each frame is doubted.

Every marked frame is solved from its marks (`start`). From there labels go to the next frame and to the one before: dense flow
carries their probabilities, and each pixel weighs four things as log likelihoods: where the labels were, the colors of nothing,
object and hands, the usual color of this pixel of the background, and depth where there is some. A field of labels, in which
neighbors of one color like to be the same, settles it. Between two marked frames both directions are blended by their distance in
time. A second pass knows the whole film's background.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Protocol

import cv2
import numpy as np

from neuspring.config.perception import MarksSegmentation
from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT
from neuspring.perception.marks.colors import Background, apart, lab_of, mixed
from neuspring.perception.marks.marks import Mark, Seeds, require_marks
from neuspring.perception.marks.start import LABELS, Start, start
from neuspring.perception.marks.step import Pass, Step

AROUND = 4
"""Frames before and after with whose median an area is compared."""
WHOLE = {"disagreement": 0.35, "flow": 0.8, "misfit": 0.5, "unsure": 0.5, "jump": 0.5}
"""Value of each cue that makes a doubt of 63 %."""
MISFIT = 2.0
"""Log ratio from which a color contradicts its label."""
WIDTH = 848
"""Width of images, pixels, for which REACH is given."""
REACH = 4.0
"""How far the border may be from where the flow carries it, pixels."""
BACKGROUND_FRAMES = 60
"""How many frames the background of the whole film is learned from."""
APART = 4
"""Pixels around object and hands that teach no background."""


@dataclass(frozen=True)
class Cues:
    """What speaks against one frame's labels, each 0 or more."""

    disagreement: float = 0.0
    """1 - IoU with the other direction or, outside of two marked frames, with the first pass; object or hands, the larger one."""
    flow: float = 0.0
    """Mean doubt of the flow on object and hands."""
    misfit: float = 0.0
    """Part of object and hands whose colors contradict their label."""
    unsure: float = 0.0
    """Mean of 2 (1 - p) over the pixels at the border of object and hands."""

    @classmethod
    def of(cls, step: Step, other: np.ndarray) -> Cues:
        """Of a frame, and of the labels [h, w] that it was given otherwise."""
        labels = step.probability.argmax(axis=0)
        shown = labels > 0
        apart = [1 - _overlap(labels == label, other == label) for label in (OBJECT, HANDS)]
        if not shown.any():
            return cls(disagreement=max(apart))
        inner = cv2.erode(shown.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        rim = shown & ~inner
        misfit = float((step.misfit[shown] > MISFIT).mean())
        unsure = float(2 * (1 - step.probability.max(axis=0)[rim]).mean()) if rim.any() else 0.0
        return cls(max(apart), float(step.flow_doubt[shown].mean()), misfit, unsure)


def doubt_of(labels: np.ndarray, cues: list[Cues]) -> np.ndarray:
    """Doubt [T], 0 to 1: 1 - exp(-sum of cues), each against its scale; the jump of areas is the last one."""
    names = ("disagreement", "flow", "misfit", "unsure")
    total = np.array([sum((getattr(cue, name) / WHOLE[name]) ** 2 for name in names) for cue in cues])
    for label in (OBJECT, HANDS):
        areas = (labels == label).sum(axis=(1, 2)).astype(float)
        total += (area_jumps(areas) / WHOLE["jump"]) ** 2
    return np.asarray(1 - np.exp(-total))


def area_jumps(areas: np.ndarray) -> np.ndarray:
    """|log(area / median of the frames around)| [T], with 1 % of the film's largest area added to both."""
    floor = 0.01 * max(float(areas.max(initial=0.0)), 100.0)
    logs = np.log(areas + floor)
    usual = [np.median(logs[max(frame - AROUND, 0) : frame + AROUND + 1]) for frame in range(len(logs))]
    return np.asarray(np.abs(logs - usual))


def _overlap(one: np.ndarray, other: np.ndarray) -> float:
    union = int((one | other).sum())
    return float((one & other).sum() / union) if union else 1.0


class Images(Protocol):
    """The frames of one camera, read on demand."""

    @property
    def count(self) -> int:
        """Number of frames."""

    def color(self, frame: int, /) -> np.ndarray:
        """RGB [H, W, 3] uint8."""

    def depth(self, frame: int, /) -> np.ndarray | None:
        """Depth [H, W] float32, m, 0 where nothing was measured; None: this camera has no depth."""

    def height(self, frame: int, /) -> np.ndarray | None:
        """Height above the table [H, W], m, NaN where nothing was measured; None: not known."""


@dataclass(frozen=True, eq=False)
class Carried:
    """Labels of every frame."""

    labels: np.ndarray
    """[T, H, W] uint8: 0 nothing, 1 object, 2 hands."""
    doubt: np.ndarray
    """[T] float, 0 (sure) to 1."""


@dataclass(eq=False)
class _Film:
    """Frames at the size that is worked on, and the marks of each."""

    images: Images
    marks: dict[int, list[Mark]]
    scale: float
    full: tuple[int, int]

    @classmethod
    def of(cls, images: Images, marks: Sequence[Mark], settings: MarksSegmentation, *, whole: bool = True) -> _Film:
        full = images.color(0).shape[:2]
        require_marks(tuple(marks), images.count, full, whole=whole)
        by_frame: dict[int, list[Mark]] = {}
        for mark in marks:
            by_frame.setdefault(mark.frame, []).append(mark)
        return cls(images, by_frame, settings.scale, full)

    @property
    def size(self) -> tuple[int, int]:
        return round(self.full[0] * self.scale), round(self.full[1] * self.scale)

    def lab(self, frame: int) -> np.ndarray:
        image = self.images.color(frame)
        if self.scale != 1.0:
            how = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_CUBIC
            image = cv2.resize(np.ascontiguousarray(image), self.size[::-1], interpolation=how)
        return lab_of(image)

    def seeds(self, frame: int, *, carried: bool = False) -> Seeds:
        return Seeds.of(self.marks[frame], self.size, self.scale, carried=carried)

    def depth(self, frame: int) -> np.ndarray | None:
        return self._resized(self.images.depth(frame))

    def height(self, frame: int) -> np.ndarray | None:
        return self._resized(self.images.height(frame))

    def _resized(self, values: np.ndarray | None) -> np.ndarray | None:
        """Depth and height are not averaged over borders."""
        if values is None or self.scale == 1.0:
            return values
        return cv2.resize(values, self.size[::-1], interpolation=cv2.INTER_NEAREST)

    def labels(self, probability: np.ndarray) -> np.ndarray:
        """Labels [H, W] at the camera's size."""
        if self.scale != 1.0:
            how = cv2.INTER_LINEAR if self.scale < 1 else cv2.INTER_AREA
            probability = np.stack([cv2.resize(part, self.full[::-1], interpolation=how) for part in probability])
        return np.asarray(probability.argmax(axis=0), dtype=np.uint8)


def frame_mask(images: Images, frame: int, marks: Sequence[Mark], settings: MarksSegmentation) -> np.ndarray:
    """Labels [H, W] uint8 of one frame from the marks on it alone. Raises InputError where it has no object or hand marked."""
    own = [mark for mark in marks if mark.frame == frame]
    if not any(mark.label != "ignore" for mark in own):
        raise InputError(f"frame {frame}", "an object or a hand must be marked on it", sorted({mark.label for mark in own}))
    film = _Film.of(images, own, settings, whole=False)
    return film.labels(start(film.lab(frame), film.seeds(frame), film.height(frame)).probability)


def carry(
    images: Images,
    marks: Sequence[Mark],
    settings: MarksSegmentation,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Carried:
    """Labels and doubt of every frame from the marks of one camera; `progress(done, all)` is called as work goes on.

    Raises InputError where no object is marked, or marks lie outside the images.
    """
    film = _Film.of(images, marks, settings)
    if not marks:
        raise InputError("marks", "an object must be marked in one frame or more", 0, 'Add a mark with "label": "object".')
    walker = _Walker(film, settings, progress or (lambda done, total: None))
    return walker.second_pass(walker.first_pass())


@dataclass(eq=False)
class _Walker:
    """Two passes through a film."""

    film: _Film
    settings: MarksSegmentation
    progress: Callable[[int, int], None]
    starts: dict[int, Start] = field(default_factory=dict)
    background: Background | None = None
    done: int = 0

    @property
    def _begin(self) -> int:
        """The first frame with an object marked on."""
        return min(frame for frame, own in self.film.marks.items() if any(mark.label == "object" for mark in own))

    def _start(self) -> Start:
        """That frame, solved from its marks."""
        lab, seeds, height = self.film.lab(self._begin), self.film.seeds(self._begin), self.film.height(self._begin)
        return start(lab, seeds, height, self.background)

    def first_pass(self) -> np.ndarray:
        """Labels [T, h, w], from the first frame with an object marked on; marked frames on the way correct them."""
        film, count = self.film, self.film.images.count
        begin = self._begin
        labels = np.zeros((count, *film.size), np.uint8)
        self.starts[begin] = self._start()
        labels[begin] = self.starts[begin].labels
        self.background = Background.empty(film.size) if self.settings.background else None
        for frames in (range(begin + 1, count), range(begin - 1, -1, -1)):
            walk = self._pass(begin, learns=True)
            for frame in frames:
                seeds = film.seeds(frame, carried=True) if frame in film.marks else None
                probability = walk.step(film.lab(frame), film.depth(frame), seeds).probability
                if seeds is not None:
                    self.starts[frame] = Start.of(walk.lab, probability, seeds)
                    walk.first = self._colors()
                labels[frame] = probability.argmax(axis=0)
                self._tick()
        return labels

    def second_pass(self, first: np.ndarray) -> Carried:
        """Labels and doubt, now that the whole film's background and the colors of all marked frames are known."""
        film, count = self.film, self.film.images.count
        if self.background is not None:
            self.background = self._whole_background(first)
            # What was uncovered later shows where the object ended at first.
            self.starts[self._begin] = self._start()
        labels, cues = np.zeros((count, *film.full), np.uint8), [Cues() for _ in range(count)]
        keys = sorted(self.starts)
        for key in keys:
            labels[key] = film.labels(self.starts[key].probability)
        for frames in (range(keys[-1] + 1, count), range(keys[0] - 1, -1, -1)):
            walk = self._pass(keys[-1] if frames.step > 0 else keys[0], learns=False)
            for frame in frames:
                step = walk.step(film.lab(frame), film.depth(frame))
                labels[frame] = film.labels(step.probability)
                cues[frame] = Cues.of(step, first[frame])
                self._tick()
        for left, right in pairwise(keys):
            self._between(left, right, labels, cues)
        return Carried(labels, doubt_of(labels, cues))

    def _between(self, left: int, right: int, labels: np.ndarray, cues: list[Cues]) -> None:
        """Labels between two marked frames: both directions, weighed by the distance in time."""
        forward, walk = {}, self._pass(left, learns=False)
        for frame in range(left + 1, right):
            # A byte is enough, and a long film fits into memory.
            forward[frame] = np.round(255 * walk.step(self.film.lab(frame), self.film.depth(frame)).probability).astype(np.uint8)
        walk = self._pass(right, learns=False)
        for frame in range(right - 1, left, -1):
            step = walk.step(self.film.lab(frame), self.film.depth(frame))
            there, weight = forward.pop(frame) / np.float32(255), (frame - left) / (right - left)
            cues[frame] = Cues.of(step, there.argmax(axis=0))
            labels[frame] = self.film.labels((1 - weight) * there + weight * step.probability)
            self._tick()

    def _pass(self, key: int, *, learns: bool) -> Pass:
        own = self.starts[key]
        reach = REACH * max(self.film.size) / WIDTH
        return Pass(
            lab=self.film.lab(key),
            probability=own.probability,
            first=self._colors(),
            background=self.background,
            learns=learns,
            reach=reach,
        )

    def _colors(self) -> tuple[np.ndarray, ...]:
        """Colors of nothing, object and hands in all marked frames so far."""
        starts = list(self.starts.values())
        return tuple(mixed([(1.0, own.counts[label]) for own in starts]) for label in LABELS)

    def _whole_background(self, labels: np.ndarray) -> Background:
        """The background from frames of the whole film, where their labels say nothing."""
        background = Background.empty(self.film.size)
        frames = np.unique(np.linspace(0, len(labels) - 1, BACKGROUND_FRAMES).astype(int)).tolist()
        for frame in frames:
            background.learn(self.film.lab(frame), apart(labels[frame], APART), self.film.depth(frame))
        return background

    def _tick(self) -> None:
        # The first pass solves all frames but its start, the second one all that are not marked.
        self.done += 1
        self.progress(self.done, 2 * self.film.images.count - 1 - len(self.film.marks))
