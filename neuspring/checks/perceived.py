"""Checks that the perception stages apply to their own results: masks, tracks, lifted points, shape and observations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from neuspring.checks import examine
from neuspring.checks.masks import Shown
from neuspring.checks.objects import Sample, place_of, sampled
from neuspring.checks.observed import Observed
from neuspring.core.artifacts import Observations
from neuspring.core.findings import Finding
from neuspring.data.capture import OBJECT, Capture
from neuspring.data.results import LiftedTracks, ShapePrior


def look_at_masks(capture: Capture, camera: str, labels: np.ndarray, facts: Mapping[str, float]) -> list[Finding]:
    """Findings about labels [T, H, W] of one camera; `facts` are their `mask_facts`."""
    where, streams = f"camera {camera}", capture.streams
    frames = [frame for frame in sorted(sampled(capture.frame_count)) if capture.has(camera, frame)]
    samples = {frame: Sample(capture.depth(camera, frame), labels[frame]) for frame in frames}
    found = examine("masks", where, Shown.of(capture, camera, labels), streams=streams)
    found += examine("object and hands", where, capture.cameras[camera], samples, streams=streams)
    found += examine("repeats", where, capture, camera)
    return found + examine("segmentation", where, facts, streams=streams)


def look_at_tracks(capture: Capture, camera: str, labels: np.ndarray, pixels: np.ndarray, visible: np.ndarray) -> list[Finding]:
    """Findings about the object's tracks, selected by the labels of frame 0.

    labels [T, H, W]; pixels [T, Q, 2], x and y; visible [T, Q] bool.
    """
    x, y = np.round(pixels[0]).astype(int).T
    return examine("visible points", f"camera {camera}", visible[:, labels[0][y, x] == OBJECT])


def look_at_observations(observations: Observations, moves: float = 0.0) -> list[Finding]:
    """Findings about the observations; `moves` as in `Observed`."""
    return examine("observations", "observations", Observed(observations, moves))


def look_at_lifted(lifted: LiftedTracks, prior: ShapePrior, up: float) -> list[Finding]:
    """Findings about lifted tracks and the shape prior; `up` is +1 or -1."""
    found = examine("object", "object of all cameras", place_of({0: lifted.cloud}, up))
    found += examine("visible points", "lifted tracks", lifted.object_visibility)
    return found + examine("lifted tracks", "lifted tracks", lifted)


def followed(visible: np.ndarray) -> dict[str, Any] | None:
    """The smallest fraction of points, visible [T, n], that are visible in a frame."""
    if not visible.shape[1]:
        return None
    alive = visible.mean(axis=1)
    return {"value": float(alive.min()), "detail": f"frame {alive.argmin()}", "frames": (int(alive.argmin()),)}


def trusted(lifted: LiftedTracks) -> float | None:
    """Fraction of motions of object points, visible in both frames, that agree with their neighbors."""
    both = lifted.object_visibility[:-1] & lifted.object_visibility[1:]
    return float(lifted.object_motion_valid[:-1].sum() / max(int(both.sum()), 1)) if both.any() else None


def grip_elsewhere(lifted: LiftedTracks) -> dict[str, Any] | None:
    """The frame in which a hand returns and grasps another part of the object."""
    frame = lifted.facts.get("grip_elsewhere")
    return None if frame is None else {"where": "controllers", "value": int(frame), "frames": (int(frame),)}
