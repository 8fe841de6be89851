"""The tracks mode: clicks on points -> followed places in images -> tracks in the world, what is doubtful about them, tracks.json.

Depth lifts a followed pixel, and cameras that see the same point are averaged.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from threading import Condition, Thread
from typing import Any

import numpy as np
from scipy.ndimage import binary_closing

from neuspring.core.errors import InputError
from neuspring.core.records import digest_file
from neuspring.data.capture import TRACKS, Capture, write_tracks
from neuspring.perception.annotate.annotations import ANNOTATIONS, Annotations, Click, Point
from neuspring.perception.annotate.follow import GrayImages, OneWay, Trail, follow, follow_from
from neuspring.perception.annotate.shared import Busy, Document
from neuspring.perception.lift import local_depth

WINDOW, LEAST = 5, 4
"""Side of the window, pixels, whose median depth a point gets, and how many of its pixels must be measured."""
CAMERAS_APART = 0.02
"""m. Cameras whose points lie farther apart disagree."""
DIRECTIONS_APART = 3.0
"""Pixels. Where the ways from two clicks lie farther apart, another click is needed."""
UNALIKE = 0.3
"""Correlation with the nearer click's patch below which a place is doubtful."""
GAP = 4
"""Fewer good frames than this between doubtful ones are part of one note."""
JUMP = 0.06
"""m. A point that moves farther from one frame to the next has left its surface."""
KEPT_RUNS, KEPT_LIFTS = 20_000, 500_000
"""Results of following from one click to the next, and lifted places, that are kept."""


@dataclass(frozen=True, eq=False)
class PointTrack:
    """A point in the world."""

    places: np.ndarray
    """[T, 3], m, NaN where no camera has it."""
    apart: np.ndarray
    """Largest distance between cameras [T], m; NaN where fewer than two have it."""


def lift_places(capture: Capture, camera: str, places: np.ndarray) -> np.ndarray:
    """World points [T, 3], m, of places (x, y) [T, 2]: each at the median depth of a small window; NaN without place or depth."""
    points, view, reach = np.full((len(places), 3), np.nan), capture.cameras[camera], WINDOW // 2
    for frame in np.flatnonzero(np.isfinite(places).all(axis=1)).tolist():
        if not capture.has_depth or not capture.has(camera, frame) or not capture.path("depth", camera, frame).exists():
            continue
        depth = capture.depth(camera, frame)
        x, y = np.clip(np.round(places[frame]).astype(int), 0, (view.width - 1, view.height - 1))
        window = depth[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
        if (window > 0).sum() >= LEAST:
            here = local_depth(depth, depth > 0, np.array([x]), np.array([y]), WINDOW)[0]
            points[frame] = view.lift(places[frame], here)
    return points


def join(points: Sequence[np.ndarray], frames: int) -> PointTrack:
    """The mean of points [T, 3] of several cameras, and how far they lie apart; T is `frames`."""
    if not points:
        return PointTrack(np.full((frames, 3), np.nan), np.full(frames, np.nan))
    stacked = np.stack(points)
    known = np.isfinite(stacked).all(axis=2)
    total = np.where(known[..., None], stacked, 0.0).sum(axis=0)
    places = np.where(known.any(axis=0)[:, None], total / np.maximum(known.sum(axis=0), 1)[:, None], np.nan)
    pairs = [np.linalg.norm(one - other, axis=1) for one, other in combinations(stacked, 2)]
    return PointTrack(places, np.fmax.reduce(pairs) if pairs else np.full(len(places), np.nan))


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


def notes_of(point: Point, trails: Mapping[str, Trail], track: PointTrack, capture: Capture) -> list[Note]:
    """What is doubtful about a point, a note for each run of frames."""
    notes: list[Note] = []

    def add(camera: str | None, badness: np.ndarray, text: Callable[[int], str]) -> None:
        """A note for each run of frames of positive badness [T]; short gaps do not end a run."""
        bad = binary_closing(np.pad(badness > 0, GAP + 1), np.ones(GAP + 1))[GAP:-GAP]
        for first, stop in np.flatnonzero(bad[1:] != bad[:-1]).reshape(-1, 2).tolist():
            worst = first + int(np.argmax(badness[first:stop]))
            notes.append(Note(point.name, camera, first, stop - 1, worst, text(worst)))

    for camera, trail in trails.items():
        expected = expected_frames(point.clicks[camera], capture, camera)
        seen = np.isfinite(trail.places).all(axis=1)
        add(camera, (expected & ~seen).astype(float), lambda _: "lost: click it again, or mark it hidden")
        apart = np.nan_to_num(trail.apart)
        add(
            camera,
            np.where(apart > DIRECTIONS_APART, apart, 0),
            lambda frame, apart=apart: f"the ways from the two clicks are {apart[frame]:.0f} px apart: click it here",  # type: ignore[misc]
        )
        unlike = np.where(seen, np.nan_to_num(UNALIKE - trail.alike), 0)
        add(camera, np.where(apart > DIRECTIONS_APART, 0, unlike), lambda _: "looks unlike the click: check it here")
    gap = np.nan_to_num(track.apart)
    add(None, np.where(gap > CAMERAS_APART, gap, 0), lambda frame: f"cameras disagree by {1000 * gap[frame]:.0f} mm")
    step = np.concatenate([[0.0], np.nan_to_num(np.linalg.norm(np.diff(track.places, axis=0), axis=1))])
    add(
        None,
        np.where(step > JUMP, step, 0),
        lambda frame: f"jumps by {1000 * step[frame]:.0f} mm in one frame: is the point hidden here?",
    )
    flat = np.any([np.isfinite(trail.places).all(axis=1) for trail in trails.values()] or [np.zeros(len(gap), bool)], axis=0)
    deep = np.isfinite(track.places).all(axis=1)
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
        trails = {camera: follow(images, camera, clicks) for camera, clicks in point.clicks.items()}
        track = join([lift_places(capture, camera, trail.places) for camera, trail in trails.items()], capture.frame_count)
        tracks.append(track.places)
        notes += notes_of(point, trails, track, capture)
    return np.stack(tracks, axis=1), notes


class Foreign(Exception):
    """tracks.json was there before, and nobody said that it may be replaced."""


@dataclass(frozen=True, eq=False)
class FollowedPoint:
    """A point as the page shows it."""

    point: Point
    trails: dict[str, Trail]
    track: PointTrack
    notes: list[Note]


class Pointing:
    """State of the tracks mode, shared by all tabs: a thread follows the clicks, and only what changed is followed again."""

    def __init__(self, capture: Capture) -> None:
        self.capture, self._images = capture, GrayImages(capture)
        self.document: Document[Annotations] = Document(
            capture.folder / ANNOTATIONS, lambda: Annotations.load(capture), lambda value: value.save(capture.folder)
        )
        self._runs: dict[tuple[str, Click, int, Click | None], OneWay] = {}
        self._lifts: dict[tuple[str, int, float, float], np.ndarray] = {}
        self._changed = Condition()
        self._wanted, self._done, self._closed, self._failure = 1, 0, False, ""
        self._points: list[FollowedPoint] = []
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
                    "name": one.point.name,
                    "trails": {camera: _listed(trail.places, 2) for camera, trail in one.trails.items()},
                    "world": _listed(one.track.places, 4),
                    "notes": [asdict(note) for note in one.notes],
                }
                for one in points
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
        write_tracks(self.capture.folder, np.stack([one.track.places for one in points], axis=1))
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

    def _follow(self, outdated: Callable[[], bool]) -> list[FollowedPoint] | None:
        """All points, followed and lifted; None if the clicks changed meanwhile."""
        points = []
        for point in self.document.read()[1].points:
            trails = {}
            for camera, clicks in point.clicks.items():
                if outdated():
                    return None
                trails[camera] = follow(self._images, camera, clicks, run=self._run)
            track = join([self._lift(camera, trail.places) for camera, trail in trails.items()], self.capture.frame_count)
            points.append(FollowedPoint(point, trails, track, notes_of(point, trails, track, self.capture)))
        return points

    def _run(self, images: GrayImages, camera: str, click: Click, stop: int, aim: Click | None) -> OneWay:
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
        fresh = lift_places(self.capture, camera, new)
        for key, point, place in zip(keys, fresh, new, strict=True):
            if np.isfinite(place).all():
                self._lifts[key] = point
        return np.array([self._lifts.get(key, np.full(3, np.nan)) for key in keys])


def _listed(rows: np.ndarray, digits: int) -> list[list[float] | None]:
    """Rows as JSON values; null where unknown."""
    return [[round(float(v), digits) for v in row] if np.isfinite(row).all() else None for row in rows]
