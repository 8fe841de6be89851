"""What is recorded of a live twin: its controls and its motion, up to a number of frames."""

from __future__ import annotations

import threading

import numpy as np

from neuspring.core.errors import InputError
from neuspring.play.controls import MOST_FRAMES, Controls, digest_motion
from neuspring.play.simulator import Start

Row = tuple[np.ndarray, int, np.ndarray, np.ndarray]
"""Hands [C, 3], the grabbed node or -1, its target [3], and which hands hold [C]."""


class Tape:
    """Controls and nodes of each frame since the begin. Safe for threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._rows: list[Row] | None = []
        self._seen: list[np.ndarray] = []

    def begin(self, x: np.ndarray) -> None:
        """Forget what was recorded; the nodes are at x [N, 3], m."""
        with self._lock:
            self._rows, self._seen = [], [x.copy()]

    def add(self, row: Row, x: np.ndarray) -> bool:
        """A frame; returns whether the tape has just ended, which takes all of it: a part could not be played without its begin."""
        with self._lock:
            if self._rows is None:
                return False
            self._rows.append(row)
            self._seen.append(x.copy())
            if len(self._rows) <= MOST_FRAMES:
                return False
            self._rows, self._seen = None, []
            return True

    def motion(self) -> str:
        """The digest of the motion so far."""
        with self._lock:
            return digest_motion(np.stack(self._seen))

    def controls(self, start: Start, frame: int, **names: str) -> Controls:
        """What was recorded. Raises InputError where that is nothing, or was too long."""
        with self._lock:
            rows, seen = list(self._rows or ()), list(self._seen)
        if not rows:
            raise InputError("recording", "at least one frame is required", 0, "Reset, and pull again.")
        hands, grabbed, target, holds = (np.stack([np.asarray(row[column]) for row in rows]) for column in range(4))
        return Controls.of(
            start,
            hands=hands,
            grabbed=grabbed.astype(np.int32),
            target=target,
            holds=np.zeros((0, 0), bool) if holds.all() else holds,
            start_frame=frame,
            motion_digest=digest_motion(np.stack(seen)),
            **names,
        )
