"""Annotations of a few frames -> labels and doubt of all frames of one camera.

1. Each annotated frame is solved from its annotations (`solve.start`).
2. From there, dense optical flow carries label probabilities forward and backward. In each frame, every pixel combines four log
   likelihoods: the carried labels; the colors of nothing, object and hands; its usual background color; and depth, if available.
   A Potts model, in which neighbors of similar color prefer the same label, gives the result.
3. A second pass repeats this with the background of the full video. Between two annotated frames, both directions are blended by
   their distance in time.
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
"""Values of each cue that alone give a doubt of 63 %."""
CARRY_WIDTH = 848
"""Image width to which BORDER_MOVES refers, pixels."""
BORDER_MOVES = 4.0
"""Largest distance of a border from its carried position, pixels."""
BACKGROUND_FRAMES = 60
"""Number of frames from which the background of the full video is learned."""
LEARNED_APART = 4
"""Margin around object and hands that is not learned as background, pixels."""


def cues_of(probability: np.ndarray, other: np.ndarray) -> float:
    """Sum of the squared doubt cues of a frame's probabilities [K, h, w], each over its constant.

    - Disagreement with `other` labels [h, w]: 1 - IoU, the larger one of object and hands.
    - Uncertainty at borders: the mean of 2 (1 - p).
    """
    labels = probability.argmax(axis=0)
    disagreement = max(1 - np.nan_to_num(overlap(labels == label, other == label), nan=1.0) for label in (OBJECT, HANDS))
    shown = np.isin(labels, (OBJECT, HANDS))
    rim = shown & ~core_of(shown)
    unsure = float(2 * (1 - probability.max(axis=0)[rim]).mean()) if rim.any() else 0.0
    return float((disagreement / DISAGREEMENT) ** 2 + (unsure / UNSURE_BORDER) ** 2)


def require(capture: Capture) -> None:
    """Raise InputError if marks.json is missing or wrong, or contains no annotations of a camera."""
    for camera in capture.cameras:
        _marks_of(capture, camera)


def segment(capture: Capture, camera: str) -> np.ndarray:
    """Labels [T, H, W]. Raises InputError without marks.json, or if it contains no annotations of this camera."""
    carried = carry(capture, camera, _marks_of(capture, camera))
    doubtful = np.argsort(-carried.doubt, kind="stable")[:3]
    print(f"camera {camera}: most doubtful frames: " + ", ".join(f"{f} ({carried.doubt[f]:.2f})" for f in doubtful), flush=True)
    return carried.labels


def _marks_of(capture: Capture, camera: str) -> tuple[Mark, ...]:
    path = capture.folder / MARKS
    marks = Marks.load(path)
    marks.require(capture, path)
    if not marks.of(camera):
        raise InputError(f"{path}, cameras", f"must contain annotations of camera {camera}", sorted(marks.cameras))
    return marks.of(camera)


def outline(capture: Capture, camera: str, frame: int, marks: Sequence[Mark]) -> np.ndarray:
    """Labels [H, W] uint8 of one frame from its own annotations. Raises InputError without an object or a hand among them."""
    film = CameraFilm(capture, camera)
    index = film.frames.index(frame)
    return frame_mask(film, index, [replace(mark, frame=index) for mark in marks if mark.frame == frame])


def carry(capture: Capture, camera: str, marks: Sequence[Mark], progress: Progress | None = None) -> Carried:
    """Labels [T, H, W] and doubt [T] of all frames of a camera, from annotations of a few; 0 in missing frames.

    Raises InputError if annotations do not fit the capture.
    """
    return over_capture(capture, camera, marks, lambda film, own: carry_film(film, own, progress=progress))


def carry_film(film: Film, marks: Sequence[Mark], *, scale: float = 1.0, progress: Progress | None = None) -> Carried:
    """Like `carry`, computed on images of `scale` times the video's size.

    Raises InputError if no object is annotated, or if annotations are outside the images.
    """
    work = _Work(film, marks, scale, progress)
    if not marks:
        raise InputError("annotations", "an object must be annotated in at least one frame", 0, 'Add one with "label": "object".')
    return work.second_pass(work.first_pass())


def frame_mask(film: Film, frame: int, marks: Sequence[Mark]) -> np.ndarray:
    """Like `outline`, for a frame of a video."""
    own = [mark for mark in marks if mark.frame == frame]
    if not any(mark.value in (OBJECT, HANDS) for mark in own):
        raise InputError(f"frame {frame}", "an object or a hand must be annotated in it", sorted({mark.label for mark in own}))
    work = _Work(film, own, 1.0, whole=False)
    return work.full_labels(work.start(frame).probability)


class _Work:
    """A video at working size, its annotations, and the colors and background learned in two passes."""

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
        """Number of labels K: 4 if a person is annotated in any frame, else 3."""
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
        """Evidence of the annotations of a frame."""
        return Seeds.of(self.marks[frame], self.size, self.scale, carried=carried, kinds=self.kinds)

    def resized(self, values: np.ndarray | None) -> np.ndarray | None:
        """Resize depth or heights to [h, w], without averaging over borders."""
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
        """Solve a frame from its annotations."""
        return start(self.lab(frame), self.seeds(frame), self.resized(self.film.height(frame)), self.background, self.person)

    def step(self, walk: Pass, frame: int, seeds: Seeds | None = None) -> np.ndarray:
        """Probabilities [K, h, w] of a frame, solved from the neighboring frame."""
        return walk.step(self.lab(frame), self.resized(self.film.depth(frame)), seeds)

    def first_pass(self) -> np.ndarray:
        """Labels [T, h, w], carried from the first frame with an annotated object; later annotated frames correct them."""
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
        """Labels and doubt, from the background of the full video and the colors of all annotated frames."""
        count = self.film.count
        # Learns the background of the full video away from labels.
        self.background = Background.empty(self.size)
        for frame in spread(range(count), BACKGROUND_FRAMES):
            self.background.learn(self.lab(frame), apart(first[frame], LEARNED_APART), self.resized(self.film.depth(frame)))
        # The background that is uncovered later shows the object's border in the first frame.
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
        # Between two annotated frames, blends both directions by their distance in time.
        for left, right in pairwise(keys):
            forward, walk = {}, self.walk_from(left, learns=False)
            for frame in range(left + 1, right):
                # Bytes, so that a long video fits into memory.
                forward[frame] = np.round(255 * self.step(walk, frame)).astype(np.uint8)
            walk = self.walk_from(right, learns=False)
            for frame in range(right - 1, left, -1):
                probability = self.step(walk, frame)
                earlier, weight = forward.pop(frame) / np.float32(255), (frame - left) / (right - left)
                doubt[frame] = cues_of(probability, earlier.argmax(axis=0))
                labels[frame] = self.full_labels((1 - weight) * earlier + weight * probability)
                self.tick()
        return Carried(labels, doubt_of(labels, doubt))

    def _person(self) -> np.ndarray:
        """Histogram [bins] of the person over all frames in which one is annotated."""
        frames = [frame for frame, marks in self.marks.items() if any(mark.label == "person" for mark in marks)]
        return mixed([(1.0, count(bins_of(self.lab(frame)), self.seeds(frame).certain == PERSON)) for frame in frames])

    @property
    def begin(self) -> int:
        """The first frame with an annotated object."""
        return min(frame for frame, own in self.marks.items() if any(mark.label == "object" for mark in own))

    def walk_from(self, key: int, *, learns: bool) -> Pass:
        """A pass that begins at an annotated frame."""
        return Pass(
            lab=self.lab(key),
            probability=self.starts[key].probability,
            first=self.colors(),
            background=self.background,
            learns=learns,
            reach=BORDER_MOVES * max(self.size) / CARRY_WIDTH,
        )

    def colors(self) -> tuple[np.ndarray, ...]:
        """Histogram of each label over the annotated frames solved so far; of the person over all annotated frames."""
        counts = [mixed([(1.0, own.counts[label]) for own in self.starts.values()]) for label in range(self.kinds)]
        if self.person is not None:
            counts[PERSON] = mixed([(1.0, counts[PERSON]), (1.0, self.person)])
        return tuple(counts)

    def tick(self) -> None:
        """Report progress. The first pass solves all frames except its start, the second one all frames without annotations."""
        self.done += 1
        self.progress(self.done, 2 * self.film.count - 1 - len(self.marks))
