"""What is doubtful about followed points, so that a person corrects there first."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_closing

from neuspring.data.capture import Capture
from neuspring.perception.annotate.annotations import Click, Point
from neuspring.perception.annotate.follow import Trail
from neuspring.perception.annotate.world import Lifted

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


def notes_of(point: Point, trails: Mapping[str, Trail], lifted: Lifted, capture: Capture) -> list[Note]:
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
    gap = np.nan_to_num(lifted.apart)
    add(None, np.where(gap > CAMERAS_APART, gap, 0), lambda frame: f"cameras disagree by {1000 * gap[frame]:.0f} mm")
    step = np.concatenate([[0.0], np.nan_to_num(np.linalg.norm(np.diff(lifted.track, axis=0), axis=1))])
    add(
        None,
        np.where(step > JUMP, step, 0),
        lambda frame: f"jumps by {1000 * step[frame]:.0f} mm in one frame: is the point hidden here?",
    )
    flat = np.any([np.isfinite(trail.places).all(axis=1) for trail in trails.values()] or [np.zeros(len(gap), bool)], axis=0)
    deep = np.isfinite(lifted.track).all(axis=1)
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
