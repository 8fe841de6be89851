"""The tracks mode: clicks on points, what they become in between, and tracks.json."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict
from threading import Condition, Thread
from typing import Any

import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.records import digest_file
from neuspring.data.capture import TRACKS, Capture, write_tracks
from neuspring.perception.annotate.annotations import ANNOTATIONS, Annotations, Click, Point
from neuspring.perception.annotate.document import Document
from neuspring.perception.annotate.follow import GrayImages, Run, Trail, follow, follow_from
from neuspring.perception.annotate.job import Busy
from neuspring.perception.annotate.notes import Note, notes_of
from neuspring.perception.annotate.world import Lifted, depth_reader, join, lift_places, require_depth

KEPT_RUNS, KEPT_LIFTS = 20_000, 500_000
"""Results of following from one click to the next, and lifted places, that are kept."""


class Pointing:
    """State of the tracks mode, shared by all tabs: a thread follows the clicks, and only what changed is followed again."""

    def __init__(self, capture: Capture) -> None:
        self.capture, self._images = capture, GrayImages(capture)
        self.document: Document[Annotations] = Document(
            capture.folder / ANNOTATIONS, lambda: Annotations.load(capture), lambda value: value.save(capture.folder)
        )
        self._runs: dict[tuple[str, Click, int, Click | None], Run] = {}
        self._lifts: dict[tuple[str, int, float, float], np.ndarray] = {}
        self._changed = Condition()
        self._wanted, self._done, self._closed, self._failure = 1, 0, False, ""
        self._points: list[tuple[Point, dict[str, Trail], Lifted, list[Note]]] = []
        self._written = ""
        """Digest of tracks.json as it was saved here."""
        self._thread = Thread(target=self._work, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(10)

    def write(self, revision: Any, values: Any) -> str:
        """Replace the clicks; returns the new revision. Raises Stale, InputError."""
        new = self.document.write(revision, Annotations.read(values, self.capture, ANNOTATIONS))
        with self._changed:
            self._wanted += 1
            self._changed.notify_all()
        return new

    def plain(self) -> dict[str, Any]:
        """Clicks and their revision, as plain values."""
        revision, annotations = self.document.read()
        return {"revision": revision, "annotations": annotations.plain(), "tracks_exist": (self.capture.folder / TRACKS).exists()}

    def results(self, since: int) -> dict[str, Any]:
        """What was followed, as plain values; without the points if nothing is newer than `since`."""
        with self._changed:
            version, busy, failure, points = self._done, self._done < self._wanted, self._failure, self._points
        answer: dict[str, Any] = {"version": version, "busy": busy, "failure": failure}
        if version != since:
            answer["points"] = [
                {
                    "name": point.name,
                    "trails": {camera: _listed(trail.places, 2) for camera, trail in trails.items()},
                    "world": _listed(lifted.track, 4),
                    "notes": [asdict(note) for note in notes],
                }
                for point, trails, lifted, notes in points
            ]
        return answer

    def wait(self, seconds: float) -> bool:
        """Wait until all clicks are followed; whether they are."""
        with self._changed:
            return self._changed.wait_for(lambda: self._done == self._wanted or self._closed, seconds)

    def save(self, *, replace: bool) -> int:
        """Write tracks.json; returns the number of points. Raises InputError without points or depth, Busy, and Foreign."""
        require_depth(self.capture)
        with self._changed:
            busy, points, failure = self._done < self._wanted, self._points, self._failure
        if busy or failure:
            raise Busy(failure or "Points are still being followed. Save again in a moment.")
        if not points:
            raise InputError(TRACKS, "a point or more must be clicked", 0)
        path = self.capture.folder / TRACKS
        if path.exists() and not replace and digest_file(path) != self._written:
            count = self.capture.tracks().shape[1]
            raise Foreign(f"The capture already has {TRACKS}, with {count} tracks. Saving replaces them.")
        write_tracks(self.capture.folder, np.stack([lifted.track for _, _, lifted, _ in points], axis=1))
        self._written = digest_file(path)
        return len(points)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._done < self._wanted)
                if self._closed:
                    return
                wanted = self._wanted
            try:
                failure, points = "", self._follow(lambda wanted=wanted: self._closed or self._wanted != wanted)  # type: ignore[misc]
            except InputError as error:
                failure, points = str(error), []
            except Exception as error:  # the thread goes on: the page must hear of it, and the terminal gets the trace
                logging.getLogger(__name__).exception("following failed")
                failure, points = f"{type(error).__name__}: {error}. The terminal shows where.", []
            with self._changed:
                if points is not None:
                    self._points, self._failure, self._done = points, failure, wanted
                    self._changed.notify_all()

    def _follow(self, outdated: Callable[[], bool]) -> list[tuple[Point, dict[str, Trail], Lifted, list[Note]]] | None:
        """All points, followed and lifted; None if the clicks changed meanwhile."""
        points = []
        for point in self.document.read()[1].points:
            trails = {}
            for camera, clicks in point.clicks.items():
                if outdated():
                    return None
                trails[camera] = follow(self._images, camera, clicks, run=self._run)
            lifted = join([self._lift(camera, trail.places) for camera, trail in trails.items()], self.capture)
            points.append((point, trails, lifted, notes_of(point, trails, lifted, self.capture)))
        return points

    def _run(self, images: GrayImages, camera: str, click: Click, stop: int, aim: Click | None) -> Run:
        key = (camera, click, stop, aim)
        if key not in self._runs:
            while len(self._runs) >= KEPT_RUNS:
                del self._runs[next(iter(self._runs))]
            self._runs[key] = follow_from(images, camera, click, stop, aim)
        return self._runs[key]

    def _lift(self, camera: str, places: np.ndarray) -> np.ndarray:
        """World points [T, 3] of places [T, 2]; depth is read for places that are new."""
        if len(self._lifts) > KEPT_LIFTS:
            self._lifts.clear()
        keys = [(camera, frame, float(x), float(y)) for frame, (x, y) in enumerate(places)]
        new = np.array([[np.nan, np.nan] if key in self._lifts else place for key, place in zip(keys, places, strict=True)])
        fresh = lift_places(self.capture.cameras[camera], depth_reader(self.capture, camera), new)
        for key, point, place in zip(keys, fresh, new, strict=True):
            if np.isfinite(place).all():
                self._lifts[key] = point
        return np.array([self._lifts.get(key, np.full(3, np.nan)) for key in keys])


class Foreign(Exception):
    """tracks.json was there before, and nobody said that it may be replaced."""


def _listed(rows: np.ndarray, digits: int) -> list[list[float] | None]:
    """Rows as JSON values; null where unknown."""
    return [[round(float(v), digits) for v in row] if np.isfinite(row).all() else None for row in rows]
