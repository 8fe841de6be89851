"""The video of one camera, read on demand, and masks of all its frames from annotations of a few."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, TypeAlias

import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.frames import frames_of, without_islands
from neuspring.perception.marks import Mark

PERCEPTION_SEED = 0
"""Seed of the tracked pixels and of the sampled points; independent of the seeds of methods."""
MEDIAN_AROUND = 4
"""Frames before and after: an area is compared with their median area."""
DOUBTED_JUMP = 0.5
"""Jump of an area that alone gives a doubt of 63 %."""
Progress: TypeAlias = Callable[[int, int], None]
"""Progress callback: (frames done, total frames)."""


def heights(capture: Capture, camera: str, depth: np.ndarray) -> np.ndarray:
    """Height above the table z = 0 [H, W], m, from depth [H, W], m; NaN without a measurement."""
    view = capture.cameras[camera]
    pixels = np.stack(np.meshgrid(np.arange(view.width), np.arange(view.height)), axis=-1).astype(float)
    return np.where(depth > 0, capture.description.up_sign * view.lift(pixels, depth)[..., 2], np.nan)


def at_border(boxes: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """True for components that touch the border of an image [H, W]; boxes [n, 5] from `cv2.connectedComponentsWithStats`."""
    left, top, width, height = boxes.T[:4]
    return np.asarray((left == 0) | (top == 0) | (left + width == shape[1]) | (top + height == shape[0]))


class Film(Protocol):
    """The video of one camera, read on demand."""

    @property
    def count(self) -> int:
        """Number of frames."""

    def color(self, frame: int, /) -> np.ndarray:
        """RGB [H, W, 3] uint8."""

    def depth(self, frame: int, /) -> np.ndarray | None:
        """Depth [H, W] float32, m, 0 without a measurement; None: no depth image."""

    def height(self, frame: int, /) -> np.ndarray | None:
        """Height above the table [H, W], m, NaN without a measurement; None: no depth image."""


@dataclass(frozen=True, eq=False)
class CameraFilm:
    """The recorded frames of one camera, in order; missing frames are skipped. Raises InputError for an unknown camera."""

    capture: Capture
    camera: str

    def __post_init__(self) -> None:
        self.capture.require_camera(self.camera)

    @cached_property
    def frames(self) -> list[int]:
        """Frame numbers in the capture."""
        return frames_of(self.capture, self.camera)

    @property
    def count(self) -> int:
        """Number of recorded frames."""
        return len(self.frames)

    def color(self, frame: int, /) -> np.ndarray:
        """RGB [H, W, 3] uint8."""
        return self.capture.color(self.camera, self.frames[frame])

    def depth(self, frame: int, /) -> np.ndarray | None:
        """Depth [H, W] float32, m, 0 without a measurement; None: no depth image."""
        if not self.capture.path("depth", self.camera, self.frames[frame]).exists():
            return None
        return self.capture.depth(self.camera, self.frames[frame]).astype(np.float32)

    def height(self, frame: int, /) -> np.ndarray | None:
        """Height above the table [H, W], m, NaN without a measurement; None: no depth image."""
        depth = self.depth(frame)
        return None if depth is None else heights(self.capture, self.camera, depth).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Carried:
    """Labels of all frames, carried from annotations of a few."""

    labels: np.ndarray
    """[T, H, W] uint8: 0 nothing, 1 object, 2 hands, 3 person."""
    doubt: np.ndarray
    """[T] float, 0 (sure) to 1."""


def over_capture(
    capture: Capture, camera: str, marks: Sequence[Mark], work: Callable[[CameraFilm, list[Mark]], Carried]
) -> Carried:
    """Apply `work` to the video and the annotations of a camera; return its result at the frames of the capture.

    Frames that the camera misses get label 0. Raises InputError if no object is annotated, or if an annotation is on a missing
    frame.
    """
    film = CameraFilm(capture, camera)
    index = {number: index for index, number in enumerate(film.frames)}
    if absent := [mark.frame for mark in marks if mark.frame not in index]:
        raise InputError(f"annotations of camera {camera}", "must be on recorded frames", absent[0])
    carried = work(film, [replace(mark, frame=index[mark.frame]) for mark in marks])
    view = capture.cameras[camera]
    labels, doubt = np.zeros((capture.frame_count, view.height, view.width), np.uint8), np.zeros(capture.frame_count)
    labels[film.frames], doubt[film.frames] = carried.labels, carried.doubt
    return Carried(without_islands(capture, camera, labels), doubt)


def doubt_of(labels: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Doubt of each frame [T], 0 to 1: 1 - exp(-sum of squared cues).

    The cues are jumps of the label areas in `labels` [T, H, W], over DOUBTED_JUMP, and `others` [T], already squared. A jump is
    |log(area / median area of the neighboring frames)|, with 1 % of the video's largest area added to both.
    """
    total = others.astype(float)
    for label in (OBJECT, HANDS):
        areas = (labels == label).sum(axis=(1, 2)).astype(float)
        logs = np.log(areas + 0.01 * max(float(areas.max(initial=0.0)), 100.0))
        usual = [np.median(logs[max(frame - MEDIAN_AROUND, 0) : frame + MEDIAN_AROUND + 1]) for frame in range(len(logs))]
        total = total + (np.abs(logs - usual) / DOUBTED_JUMP) ** 2
    return np.asarray(1 - np.exp(-total))
