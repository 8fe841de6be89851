"""The tracks mode: clicks on points -> followed places in images -> tracks in the world, what is doubtful about them, tracks.json.

Depth lifts a followed pixel, and cameras that see the same point are averaged.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from itertools import combinations
from threading import Lock
from typing import Any

import numpy as np
from scipy.ndimage import binary_closing

from neuspring.core.errors import InputError
from neuspring.core.records import digest_file
from neuspring.data.capture import TRACKS, Capture, write_tracks
from neuspring.extensions.annotate.clicks import (
    ANNOTATIONS,
    Annotations,
    Click,
    ClickedPoint,
    GrayImages,
    OneWay,
    Trail,
    follow,
    follow_from,
)
from neuspring.extensions.annotate.shared import Busy, Document
from neuspring.perception.lift import local_depth

MEDIAN_WINDOW, LEAST_MEASURED = 5, 4
"""Side of the window, pixels, whose median depth a point gets, and how many of its pixels must be measured."""
CAMERAS_APART = 0.02
"""m. Cameras whose points lie farther apart disagree."""
DIRECTIONS_APART = 3.0
"""Pixels. Where the ways from two clicks lie farther apart, another click is needed."""
UNALIKE = 0.3
"""Correlation with the nearer click's patch below which a place is doubtful."""
NOTE_GAP = 4
"""Fewer good frames than this between doubtful ones are part of one note."""
TRACK_JUMP = 0.06
"""m. A point that moves farther from one frame to the next has left its surface."""
KEPT_RUNS, KEPT_LIFTS = 20_000, 500_000
"""Results of following from one click to the next, and lifted places, that are kept."""


def lift_place(capture: Capture, camera: str, frame: int, x: float, y: float) -> np.ndarray:
    """World point [3], m, of a place in a frame, at the median depth of a small window; NaN where there is no depth."""
    if not capture.has_depth or not capture.has(camera, frame) or not capture.path("depth", camera, frame).exists():
        return np.full(3, np.nan)
    view, depth, reach = capture.cameras[camera], capture.depth(camera, frame), MEDIAN_WINDOW // 2
    column, row = np.clip(np.round([x, y]).astype(int), 0, (view.width - 1, view.height - 1))
    if (depth[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1] > 0).sum() < LEAST_MEASURED:
        return np.full(3, np.nan)
    here = local_depth(depth, depth > 0, np.array([column]), np.array([row]), MEDIAN_WINDOW)[0]
    return np.asarray(view.lift(np.array([x, y]), here))


def join(points: Sequence[np.ndarray], frames: int) -> tuple[np.ndarray, np.ndarray]:
    """The mean [T, 3] of points [T, 3] of several cameras, NaN where none has it; T is `frames`.

    And the largest distance between cameras [T], m; NaN where fewer than two have it.
    """
    if not points:
        return np.full((frames, 3), np.nan), np.full(frames, np.nan)
    stacked = np.stack(points)
    known = np.isfinite(stacked).all(axis=2)
    total = np.where(known[..., None], stacked, 0.0).sum(axis=0)
    places = np.where(known.any(axis=0)[:, None], total / np.maximum(known.sum(axis=0), 1)[:, None], np.nan)
    pairs = [np.linalg.norm(one - other, axis=1) for one, other in combinations(stacked, 2)]
    return places, np.fmax.reduce(pairs) if pairs else np.full(len(places), np.nan)


def require_depth(capture: Capture) -> None:
    """Raise InputError for a capture of color alone, whose clicks have no place in the world."""
    if not capture.has_depth:
        rule = "tracks in the world need depth: color alone cannot lift clicks to 3D"
        raise InputError(f"{capture.folder}, depth", rule, "none", "Clicks stay in annotations.json. Masks need no depth.")


@dataclass(frozen=True)
class Note:
    """Something to look at: a point in the frames first to last."""

    point: str
    camera: str | None
    """null: it is about several cameras."""
    first: int
    last: int
    frame: int
    """The worst of them."""
    text: str


def notes_of(
    point: ClickedPoint, trails: Mapping[str, Trail], places: np.ndarray, apart: np.ndarray, capture: Capture
) -> list[Note]:
    """A note for each run of frames in which a point is doubtful: it has world places [T, 3], its cameras lie `apart` [T], m."""
    notes: list[Note] = []

    def add(camera: str | None, badness: np.ndarray, text: Callable[[int], str]) -> None:
        """A note for each run of frames of positive badness [T]; short gaps do not end a run."""
        bad = binary_closing(np.pad(badness > 0, NOTE_GAP + 1), np.ones(NOTE_GAP + 1))[NOTE_GAP:-NOTE_GAP]
        for first, stop in np.flatnonzero(bad[1:] != bad[:-1]).reshape(-1, 2).tolist():
            worst = first + int(np.argmax(badness[first:stop]))
            notes.append(Note(point.name, camera, first, stop - 1, worst, text(worst)))

    for camera, trail in trails.items():
        expected = expected_frames(point.clicks[camera], capture, camera)
        seen = np.isfinite(trail.places).all(axis=1)
        add(camera, (expected & ~seen).astype(float), lambda _: "lost: click it again, or mark it hidden")
        ways = np.nan_to_num(trail.apart)
        add(
            camera,
            np.where(ways > DIRECTIONS_APART, ways, 0),
            lambda frame, ways=ways: f"the ways from the two clicks are {ways[frame]:.0f} px apart: click it here",  # type: ignore[misc]
        )
        unlike = np.where(seen, np.nan_to_num(UNALIKE - trail.alike), 0)
        add(camera, np.where(ways > DIRECTIONS_APART, 0, unlike), lambda _: "looks unlike the click: check it here")
    gap = np.nan_to_num(apart)
    add(None, np.where(gap > CAMERAS_APART, gap, 0), lambda frame: f"cameras disagree by {1000 * gap[frame]:.0f} mm")
    step = np.concatenate([[0.0], np.nan_to_num(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    add(
        None,
        np.where(step > TRACK_JUMP, step, 0),
        lambda frame: f"jumps by {1000 * step[frame]:.0f} mm in one frame: is the point hidden here?",
    )
    flat = np.any([np.isfinite(trail.places).all(axis=1) for trail in trails.values()] or [np.zeros(len(gap), bool)], axis=0)
    deep = np.isfinite(places).all(axis=1)
    none = "no depth here: null in tracks.json" if capture.has_depth else "color alone: followed in the image, not lifted to 3D"
    add(None, (flat & ~deep).astype(float), lambda _: none)
    return sorted(notes, key=lambda note: (note.first, note.camera or ""))


def expected_frames(clicks: Sequence[Click], capture: Capture, camera: str) -> np.ndarray:
    """Frames [T] bool in which a clicked point should have a place: it has clicks, is not hidden, and there is an image."""
    frames = np.array([capture.has(camera, frame) for frame in range(capture.frame_count)])
    if not any(click.place for click in clicks):
        return np.zeros_like(frames)
    for number, click in enumerate(clicks):
        if click.hidden:
            stop = clicks[number + 1].frame if number + 1 < len(clicks) else capture.frame_count
            frames[click.frame : stop] = False
    return frames


def tracks_of(capture: Capture, annotations: Annotations) -> tuple[np.ndarray, list[Note]]:
    """Tracks [T, K, 3], m, NaN where unknown, of all annotated points, and what is doubtful: for scripts, as the browser does it.

    Raises InputError without points or depth.
    """
    require_depth(capture)
    if not annotations.points:
        raise InputError(capture.folder / ANNOTATIONS, "a point or more must be clicked", 0)
    images, tracks, notes = GrayImages(capture), [], []
    for point in annotations.points:
        _, places, own = follow_point(point, images, follow_from, partial(lift_place, capture))
        tracks.append(places)
        notes += own
    return np.stack(tracks, axis=1), notes


def follow_point(
    point: ClickedPoint, images: GrayImages, run: Callable[..., OneWay], lift: Callable[..., np.ndarray]
) -> tuple[dict[str, Trail], np.ndarray, list[Note]]:
    """Trails by camera, places in the world [T, 3], m, and what is doubtful, of a point.

    `run` and `lift` are `follow_from` and `lift_place` of the capture, perhaps with results that they kept from before.
    """
    capture = images.capture
    trails = {camera: follow(images, camera, clicks, run) for camera, clicks in point.clicks.items()}
    lifted = []
    for camera, trail in trails.items():
        lifted.append(np.full((capture.frame_count, 3), np.nan))
        for frame in np.flatnonzero(np.isfinite(trail.places).all(axis=1)).tolist():
            lifted[-1][frame] = lift(camera, frame, *trail.places[frame].tolist())
    places, apart = join(lifted, capture.frame_count)
    return trails, places, notes_of(point, trails, places, apart, capture)


class Foreign(Exception):
    """tracks.json was there before, and nobody said that it may be replaced."""


class Outdated(Exception):
    """The clicks have changed while their points were followed."""


class TracksMode:
    """State of the tracks mode, shared by all tabs: a thread follows the clicks, and only what changed is followed again."""

    def __init__(self, capture: Capture) -> None:
        self.capture, self._images = capture, GrayImages(capture)
        self.document: Document[Annotations] = Document(
            capture.folder / ANNOTATIONS, lambda: Annotations.load(capture), lambda value: value.save(capture.folder)
        )
        self._run, self._lift = lru_cache(KEPT_RUNS)(follow_from), lru_cache(KEPT_LIFTS)(partial(lift_place, capture))
        self._lock, self._worker = Lock(), ThreadPoolExecutor(1)
        self._wanted, self._done, self._failure = 0, 0, ""
        self._points: list[tuple[np.ndarray, dict[str, Any]]] = []
        """Places in the world [T, 3], and what the page shows."""
        self._written = ""
        """Digest of tracks.json as it was saved here."""
        self._begin()

    def _begin(self) -> None:
        with self._lock:
            self._wanted += 1
            self._worker.submit(self._work, self._wanted)

    def close(self) -> None:
        """End the thread."""
        self._wanted += 1
        self._worker.shutdown()

    def write(self, revision: Any, values: Any) -> str:
        """Replace the clicks; returns the new revision. Raises Stale, InputError."""
        new = self.document.write(revision, Annotations.read(values, self.capture, ANNOTATIONS))
        self._begin()
        return new

    def plain(self) -> dict[str, Any]:
        """Clicks and their revision, as plain values."""
        revision, annotations = self.document.read()
        return {"revision": revision, "annotations": annotations.plain(), "tracks_exist": (self.capture.folder / TRACKS).exists()}

    def results(self, since: int) -> dict[str, Any]:
        """Followed points as plain values; without the points where nothing is newer than `since`."""
        with self._lock:
            answer: dict[str, Any] = {"version": self._done, "busy": self._done < self._wanted, "failure": self._failure}
            if self._done != since:
                answer["points"] = [shown for _, shown in self._points]
        return answer

    def save(self, *, replace: bool) -> int:
        """Write tracks.json; returns the number of points. Raises InputError without points or depth, Busy, and Foreign."""
        require_depth(self.capture)
        with self._lock:
            busy, tracks, failure = self._done < self._wanted, [places for places, _ in self._points], self._failure
        if busy or failure:
            raise Busy(failure or "Points are still being followed. Save again in a moment.")
        if not tracks:
            raise InputError(TRACKS, "a point or more must be clicked", 0)
        path = self.capture.folder / TRACKS
        if path.exists() and not replace and digest_file(path) != self._written:
            count = self.capture.tracks().shape[1]
            raise Foreign(f"The capture already has {TRACKS}, with {count} tracks. Saving replaces them.")
        write_tracks(self.capture.folder, np.stack(tracks, axis=1))
        self._written = digest_file(path)
        return len(tracks)

    def _work(self, wanted: int) -> None:
        """Follow all points, unless the clicks change meanwhile."""
        failure, points = "", []

        def run(*click: Any) -> OneWay:
            if self._wanted != wanted:
                raise Outdated
            return self._run(*click)

        try:
            for point in self.document.read()[1].points:
                trails, places, notes = follow_point(point, self._images, run, self._lift)
                shown = {
                    "name": point.name,
                    "trails": {camera: _listed(trail.places, 2) for camera, trail in trails.items()},
                    "world": _listed(places, 4),
                    "notes": [asdict(note) for note in notes],
                }
                points.append((places, shown))
        except Outdated:
            return
        except InputError as error:
            failure, points = str(error), []
        except Exception as error:  # the thread goes on: the page must hear of it, and the terminal gets the trace
            logging.getLogger(__name__).exception("following failed")
            failure, points = f"{type(error).__name__}: {error}. The terminal shows where.", []
        with self._lock:
            self._points, self._failure, self._done = points, failure, wanted


def _listed(rows: np.ndarray, digits: int) -> list[list[float] | None]:
    """Rows as JSON values; null where unknown."""
    return [[round(float(v), digits) for v in row] if np.isfinite(row).all() else None for row in rows]
