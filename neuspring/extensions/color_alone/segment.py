"""From marks on a few frames to labels of every frame of one camera, and how far each frame is doubted.

Every marked frame is solved from its marks (`start`). From there labels go to the next frame and to the one before: dense flow
carries their probabilities, and each pixel weighs four things as log likelihoods: where the labels were, the colors of nothing,
object and hands, the usual color of this pixel of the background, and depth where there is some. A field of labels, in which
neighbors of one color like to be the same, settles it. Between two marked frames both directions are blended by their distance in
time. A second pass knows the whole film's background.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT, PERSON, Capture
from neuspring.data.frames import overlap, spread
from neuspring.extensions.color_alone.colors import (
    Background,
    apart,
    bins_of,
    count,
    mixed,
)
from neuspring.extensions.color_alone.pixels import core_of
from neuspring.extensions.color_alone.seeds import Seeds
from neuspring.extensions.color_alone.solve import MarkedFrame, Pass, start
from neuspring.perception.film import CameraFilm, Carried, Film, Progress, doubt_of, over_capture
from neuspring.perception.marks import MARKS, Mark, Marks, require_marks
from neuspring.perception.segment_opencv import lab_of

DISAGREEMENT, UNSURE_BORDER = 0.35, 0.5
"""Values of each that make a doubt of 63 %."""
CARRY_WIDTH = 848
"""Width of images, pixels, for which BORDER_MOVES is given."""
BORDER_MOVES = 4.0
"""Distance of the border from where the flow carries it, pixels, at most."""
BACKGROUND_FRAMES = 60
"""Number of frames that the background of the whole film is learned from."""
LEARNED_APART = 4
"""Pixels around object and hands that teach no background."""


def cues_of(probability: np.ndarray, other: np.ndarray) -> float:
    """Doubt about a frame's probabilities [K, h, w], squared: how far its labels are from those it was given otherwise [h, w] (1 -
    IoU, of object or hands the larger one), and how unsure its borders are, the mean of 2 (1 - p) there."""
    labels = probability.argmax(axis=0)
    apart = max(1 - np.nan_to_num(overlap(labels == label, other == label), nan=1.0) for label in (OBJECT, HANDS))
    shown = np.isin(labels, (OBJECT, HANDS))
    rim = shown & ~core_of(shown)
    unsure = float(2 * (1 - probability.max(axis=0)[rim]).mean()) if rim.any() else 0.0
    return float((apart / DISAGREEMENT) ** 2 + (unsure / UNSURE_BORDER) ** 2)


def require(capture: Capture) -> None:
    """Raise InputError if marks.json is missing or wrong, or contains no marks of a camera."""
    for camera in capture.cameras:
        _marks_of(capture, camera)


def segment(capture: Capture, camera: str) -> np.ndarray:
    """Labels [T, H, W]. Raises InputError without marks.json, or where it contains no marks of this camera."""
    carried = carry(capture, camera, _marks_of(capture, camera))
    doubtful = np.argsort(-carried.doubt, kind="stable")[:3]
    print(f"camera {camera}: most doubtful frames: " + ", ".join(f"{f} ({carried.doubt[f]:.2f})" for f in doubtful), flush=True)
    return carried.labels


def _marks_of(capture: Capture, camera: str) -> tuple[Mark, ...]:
    path = capture.folder / MARKS
    marks = Marks.load(path)
    marks.require(capture, path)
    if not marks.of(camera):
        raise InputError(f"{path}, cameras", f"camera {camera} needs marks", sorted(marks.cameras))
    return marks.of(camera)


def outline(capture: Capture, camera: str, frame: int, marks: Sequence[Mark]) -> np.ndarray:
    """Labels [H, W] uint8 of one frame from the marks on it alone. Raises InputError where no object or hand is marked on it."""
    film = CameraFilm(capture, camera)
    index = film.frames.index(frame)
    return frame_mask(film, index, [replace(mark, frame=index) for mark in marks if mark.frame == frame])


def carry(capture: Capture, camera: str, marks: Sequence[Mark], progress: Progress | None = None) -> Carried:
    """Labels [T, H, W] and doubt [T] of all frames of a camera, 0 where it has none, from marks on a few.

    Raises InputError where marks do not fit the capture.
    """
    return over_capture(capture, camera, marks, lambda film, own: carry_film(film, own, progress=progress))


def carry_film(film: Film, marks: Sequence[Mark], *, scale: float = 1.0, progress: Progress | None = None) -> Carried:
    """As `carry`, worked out on images of `scale` times the film's size.

    Raises InputError where no object is marked, or marks lie outside the images.
    """
    work = _Work(film, marks, scale, progress)
    if not marks:
        raise InputError("marks", "an object must be marked in one frame or more", 0, 'Add a mark with "label": "object".')
    return work.second_pass(work.first_pass())


def frame_mask(film: Film, frame: int, marks: Sequence[Mark]) -> np.ndarray:
    """As `outline`, of a frame of a film."""
    own = [mark for mark in marks if mark.frame == frame]
    if not any(mark.value in (OBJECT, HANDS) for mark in own):
        raise InputError(f"frame {frame}", "an object or a hand must be marked on it", sorted({mark.label for mark in own}))
    work = _Work(film, own, 1.0, whole=False)
    return work.full_labels(work.start(frame).probability)


class _Work:
    """A film at the size that is worked on, its marks, and what two passes through it have learned."""

    def __init__(
        self,
        film: Film,
        marks: Sequence[Mark],
        scale: float,
        progress: Progress | None = None,
        *,
        whole: bool = True,
    ) -> None:
        self.film, self.scale = film, scale
        self.progress = progress or (lambda done, total: None)
        self.full: tuple[int, int] = film.color(0).shape[:2]
        require_marks(tuple(marks), film.count, self.full, whole=whole)
        self.size = round(self.full[0] * self.scale), round(self.full[1] * self.scale)
        self.marks: dict[int, list[Mark]] = {}
        for mark in marks:
            self.marks.setdefault(mark.frame, []).append(mark)
        self.kinds = PERSON + any(mark.label == "person" for mark in marks)
        """Number of labels: a person is one where it is marked in any frame."""
        self.person = self._person() if self.kinds > PERSON else None
        self.starts: dict[int, MarkedFrame] = {}
        self.background = Background.empty(self.size)
        self.done = 0

    def lab(self, frame: int) -> np.ndarray:
        """Lab [h, w, 3]."""
        image = self.film.color(frame)
        if self.scale != 1.0:
            how = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_CUBIC
            image = cv2.resize(np.ascontiguousarray(image), self.size[::-1], interpolation=how)
        return lab_of(image)

    def seeds(self, frame: int, *, carried: bool = False) -> Seeds:
        """The marks on a frame, drawn."""
        return Seeds.of(self.marks[frame], self.size, self.scale, carried=carried, kinds=self.kinds)

    def resized(self, values: np.ndarray | None) -> np.ndarray | None:
        """Depth or heights [h, w], which are not averaged over borders."""
        if values is None or self.scale == 1.0:
            return values
        return cv2.resize(values, self.size[::-1], interpolation=cv2.INTER_NEAREST)

    def full_labels(self, probability: np.ndarray) -> np.ndarray:
        """Labels [H, W] at the camera's size."""
        if self.scale != 1.0:
            how = cv2.INTER_LINEAR if self.scale < 1 else cv2.INTER_AREA
            probability = np.stack([cv2.resize(part, self.full[::-1], interpolation=how) for part in probability])
        return np.asarray(probability.argmax(axis=0), dtype=np.uint8)

    def start(self, frame: int) -> MarkedFrame:
        """A frame, solved from its marks."""
        return start(self.lab(frame), self.seeds(frame), self.resized(self.film.height(frame)), self.background, self.person)

    def step(self, walk: Pass, frame: int, seeds: Seeds | None = None) -> np.ndarray:
        """Probabilities [K, h, w] of a frame, solved from the one beside it."""
        return walk.step(self.lab(frame), self.resized(self.film.depth(frame)), seeds)

    def first_pass(self) -> np.ndarray:
        """Labels [T, h, w], from the first frame with an object marked on; marked frames on the way correct them."""
        begin, count = self.begin, self.film.count
        labels = np.zeros((count, *self.size), np.uint8)
        self.starts[begin] = self.start(begin)
        labels[begin] = self.starts[begin].labels
        for frames in (range(begin + 1, count), range(begin - 1, -1, -1)):
            walk = self.walk_from(begin, learns=True)
            for frame in frames:
                seeds = self.seeds(frame, carried=True) if frame in self.marks else None
                probability = self.step(walk, frame, seeds)
                if seeds is not None:
                    self.starts[frame] = MarkedFrame.of(walk.lab, probability, seeds)
                    walk.first = self.colors()
                labels[frame] = probability.argmax(axis=0)
                self.tick()
        return labels

    def second_pass(self, first: np.ndarray) -> Carried:
        """Labels and doubt, now that the whole film's background and the colors of all marked frames are known."""
        count = self.film.count
        # The background of the whole film, from frames where their labels say nothing.
        self.background = Background.empty(self.size)
        for frame in spread(range(count), BACKGROUND_FRAMES):
            self.background.learn(self.lab(frame), apart(first[frame], LEARNED_APART), self.resized(self.film.depth(frame)))
        # What was uncovered later shows where the object ended at first.
        self.starts[self.begin] = self.start(self.begin)
        labels, doubt = np.zeros((count, *self.full), np.uint8), np.zeros(count)
        keys = sorted(self.starts)
        for key in keys:
            labels[key] = self.full_labels(self.starts[key].probability)
        for key, frames in ((keys[-1], range(keys[-1] + 1, count)), (keys[0], range(keys[0] - 1, -1, -1))):
            walk = self.walk_from(key, learns=False)
            for frame in frames:
                probability = self.step(walk, frame)
                labels[frame] = self.full_labels(probability)
                doubt[frame] = cues_of(probability, first[frame])
                self.tick()
        # Between two marked frames: both directions, weighed by the distance in time.
        for left, right in pairwise(keys):
            forward, walk = {}, self.walk_from(left, learns=False)
            for frame in range(left + 1, right):
                # A byte is enough, and a long film fits into memory.
                forward[frame] = np.round(255 * self.step(walk, frame)).astype(np.uint8)
            walk = self.walk_from(right, learns=False)
            for frame in range(right - 1, left, -1):
                probability = self.step(walk, frame)
                there, weight = forward.pop(frame) / np.float32(255), (frame - left) / (right - left)
                doubt[frame] = cues_of(probability, there.argmax(axis=0))
                labels[frame] = self.full_labels((1 - weight) * there + weight * probability)
                self.tick()
        return Carried(labels, doubt_of(labels, doubt))

    def _person(self) -> np.ndarray:
        """Colors [bins] of the person in all frames in which one is marked."""
        frames = [frame for frame, marks in self.marks.items() if any(mark.label == "person" for mark in marks)]
        return mixed([(1.0, count(bins_of(self.lab(frame)), self.seeds(frame).certain == PERSON)) for frame in frames])

    @property
    def begin(self) -> int:
        """The first frame with an object marked on."""
        return min(frame for frame, own in self.marks.items() if any(mark.label == "object" for mark in own))

    def walk_from(self, key: int, *, learns: bool) -> Pass:
        """A pass that begins at a marked frame."""
        return Pass(
            lab=self.lab(key),
            probability=self.starts[key].probability,
            first=self.colors(),
            background=self.background,
            learns=learns,
            reach=BORDER_MOVES * max(self.size) / CARRY_WIDTH,
        )

    def colors(self) -> tuple[np.ndarray, ...]:
        """Colors of each label in all marked frames so far, and of the person in all of them."""
        counts = [mixed([(1.0, own.counts[label]) for own in self.starts.values()]) for label in range(self.kinds)]
        if self.person is not None:
            counts[PERSON] = mixed([(1.0, counts[PERSON]), (1.0, self.person)])
        return tuple(counts)

    def tick(self) -> None:
        """Tell the progress: the first pass solves all frames but its start, the second one all that are not marked."""
        self.done += 1
        self.progress(self.done, 2 * self.film.count - 1 - len(self.marks))
