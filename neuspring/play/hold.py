"""Who holds what: one grab at a time, of a node or a hand, by one browser. What browsers send is checked here."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

FASTEST = 3.0
"""m/s: a grab follows a faster mouse at this speed, as a jump would tear the twin."""


class Hold:
    """The grab of a twin with `nodes` nodes, and where its hands are wanted [C, 3], m. Safe for threads."""

    def __init__(self, nodes: int, hands: np.ndarray, groups: np.ndarray) -> None:
        self._lock, self._nodes, self._groups = threading.Lock(), nodes, groups
        self.following = False
        """Hands follow a recording, so that nobody can take them."""
        self.asked = 0.0
        """When a mouse was last moved, s (time.monotonic); 0 once that was drawn."""
        self.reset(hands)

    def reset(self, hands: np.ndarray) -> None:
        """Let go; hands are at [C, 3], m."""
        with self._lock:
            self._start = hands.copy()
            self.owner: int | None = None
            self.node, self._target, self._shift = -1, np.zeros(3, np.float32), np.zeros(3, np.float32)
            self._hand, self._from, self._base = -1, np.zeros(3), self._start
            self.wanted = self._start.copy()

    def take(self, client: int, kind: str, index: Any, place: Any, at: Any = None) -> bool:
        """A browser grabs a node, which is at `at` [3], m, or a hand, with the mouse at `place` [3], m; returns whether it may."""
        point = _point(place)
        with self._lock:
            most = self._nodes if kind == "node" else len(self._groups)
            if self.owner is not None or point is None or not isinstance(index, int) or not 0 <= index < most:
                return False
            if kind == "hand" and self.following:
                return False
            self.owner = client
            if kind == "node":
                self.node, self._shift = index, np.zeros(3, np.float32) if at is None else np.asarray(at, np.float32) - point
                self._target = point + self._shift
            else:
                self._hand, self._from, self._base = int(self._groups[index]), point, self.wanted.copy()
            return True

    def pull(self, client: int, place: Any) -> None:
        """Its mouse is at `place` [3], m."""
        point = _point(place)
        with self._lock:
            if self.owner != client or point is None:
                return
            self._target = point + self._shift
            self.asked = self.asked or time.monotonic()
            if self._hand >= 0:
                self.wanted = self._base.copy()
                self.wanted[self._groups == self._hand] += point - self._from

    def release(self, client: int) -> None:
        """It lets go, or its page is closed. A hand stays where it is."""
        with self._lock:
            if self.owner == client:
                self.owner, self.node, self._hand = None, -1, -1

    def next(
        self, seconds: float, hands: np.ndarray, at: np.ndarray, recorded: np.ndarray | None = None
    ) -> tuple[np.ndarray, int, np.ndarray]:
        """Hands [C, 3], node and target [3] at the end of a frame, from hands and target (`at`) at its begin.

        `recorded` hands [C, 3] are taken as they are.
        """
        with self._lock:
            if recorded is not None:
                self.wanted = recorded
            wanted, node, target = self.wanted, self.node, self._target
        reach = FASTEST * seconds
        moved = hands + _limited(wanted - hands, reach) if recorded is None else recorded
        return moved, node, at + _limited((target - at)[None], reach)[0] if node >= 0 else target

    def drawn(self) -> float | None:
        """Seconds since the mouse was moved whose pull has just been drawn; None: it was not moved."""
        with self._lock:
            asked, self.asked = self.asked, 0.0
        return time.monotonic() - asked if asked else None


def nearest_to_ray(points: np.ndarray, eye: Any, through: Any) -> int:
    """The point [N, 3] nearest to the line from the eye [3] through a place [3], m."""
    eye, way = np.asarray(eye, float), np.asarray(through, float) - np.asarray(eye, float)
    way /= max(float(np.linalg.norm(way)), 1e-12)
    offset = points - eye
    return int(np.argmin(np.linalg.norm(offset - (offset @ way)[:, None] * way, axis=1)))


def _limited(moves: np.ndarray, reach: float) -> np.ndarray:
    """Moves [..., 3], m, none longer than `reach`."""
    length = np.linalg.norm(moves, axis=-1, keepdims=True)
    return np.asarray(moves * np.minimum(1.0, reach / np.maximum(length, 1e-12)), np.float32)


def _point(place: Any) -> np.ndarray | None:
    """A place that a browser sent, if it is one in the scene."""
    try:
        point = np.asarray(place, np.float32)
    except (TypeError, ValueError):
        return None
    return point if point.shape == (3,) and np.isfinite(point).all() and np.abs(point).max() < 100 else None
