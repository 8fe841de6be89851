"""Clicks to tracks, for scripts: what the browser does in its tracks mode."""

from __future__ import annotations

import numpy as np

from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.perception.annotate.annotations import ANNOTATIONS, Annotations
from neuspring.perception.annotate.follow import GrayImages, follow
from neuspring.perception.annotate.notes import Note, notes_of
from neuspring.perception.annotate.world import lift_track, require_depth


def tracks_of(capture: Capture, annotations: Annotations) -> tuple[np.ndarray, list[Note]]:
    """Tracks [T, K, 3], m, NaN where unknown, of all annotated points, and what is doubtful. Raises InputError without points or
    depth."""
    require_depth(capture)
    if not annotations.points:
        raise InputError(capture.folder / ANNOTATIONS, "a point or more must be clicked", 0)
    images, tracks, notes = GrayImages(capture), [], []
    for point in annotations.points:
        trails = {camera: follow(images, camera, clicks) for camera, clicks in point.clicks.items()}
        lifted = lift_track(capture, {camera: trail.places for camera, trail in trails.items()})
        tracks.append(lifted.track)
        notes += notes_of(point, trails, lifted, capture)
    return np.stack(tracks, axis=1), notes
