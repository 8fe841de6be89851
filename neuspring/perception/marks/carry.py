"""From marks on a few frames to labels of every frame of one camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from neuspring.config.perception import MarksSegmentation
from neuspring.perception.marks.marks import Mark


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


def frame_mask(images: Images, frame: int, marks: Sequence[Mark], settings: MarksSegmentation) -> np.ndarray:
    """Labels [H, W] uint8 of one frame from the marks on it alone. Raises InputError where it has no marks of an object or hand."""
    raise NotImplementedError


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
    raise NotImplementedError
