"""Results that the steps of perception pass on: one file each, with its backend and its quality measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from neuspring.core.artifacts import Artifact, array
from neuspring.core.errors import InputError
from neuspring.core.records import StageRecord
from neuspring.data.capture import Capture


@dataclass(frozen=True, kw_only=True)
class _Result(Artifact):
    backend: str
    facts: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Masks(_Result):
    """The pixels of one camera that show the object and the hands."""

    kind: ClassVar[str] = "masks"
    labels: np.ndarray = array("T,H,W", np.uint8, "1", "0 nothing, 1 object, 2 hands, 3 person; 0 in missing frames")


@dataclass(frozen=True, kw_only=True)
class PixelTracks(_Result):
    """Points tracked through one camera's video; all tracks start in frame 0."""

    kind: ClassVar[str] = "pixel_tracks"
    pixels: np.ndarray = array("T,Q,2", np.float32, "px", "x, y; the last position while a point is not visible")
    visible: np.ndarray = array("T,Q", np.bool_, "1", "whether the tracker sees the point")


@dataclass(frozen=True, kw_only=True)
class LiftedTracks(_Result):
    """Filtered tracks of all cameras in the world; object tracks are visible in frame 0, controllers in every frame."""

    kind: ClassVar[str] = "lifted_tracks"
    object_points: np.ndarray = array("T,No,3", np.float32, "m", "zeros where invisible")
    object_visibility: np.ndarray = array("T,No", np.bool_, "1", "seen by its camera, inside the cleaned mask")
    object_motion_valid: np.ndarray = array("T,No", np.bool_, "1", "row t: the motion from t to t + 1 agrees with its neighbors")
    object_colors: np.ndarray = array("No,3", np.float32, "1", "RGB in frame 0")
    controller_points: np.ndarray = array("T,C,3", np.float32, "m", "chosen points of the hands")
    controller_valid: np.ndarray = array(
        "T,C", np.bool_, "1", "whether each controller holds in each frame; empty: all always hold", omitted=True
    )
    cloud: np.ndarray = array("P,3", np.float32, "m", "all object points of frame 0")
    cloud_colors: np.ndarray = array("P,3", np.float32, "1", "RGB of the cloud")


@dataclass(frozen=True, kw_only=True)
class ShapePrior(_Result):
    """A closed surface of the object in frame 0; empty without a prior."""

    kind: ClassVar[str] = "shape_prior"
    vertices: np.ndarray = array("V,3", np.float32, "m", "world")
    faces: np.ndarray = array("F,3", np.int32, "1", "outward")
    seen: np.ndarray = array(
        "W", np.bool_, "1", "vertices that a camera saw; all others are inferred; empty: unknown", optional=True
    )


def masks_of_cameras(capture: Capture, records: Sequence[Path]) -> dict[str, Masks]:
    """Masks by camera, from records in the capture's order. Raises InputError for a missing record or another size."""
    by_camera = {}
    for name, path in _record_of(capture, records, "--masks").items():
        masks, camera = Masks.load(StageRecord.load(path).file("masks", path)), capture.cameras[name]
        shape = (capture.frame_count, camera.height, camera.width)
        if masks.labels.shape != shape:
            remedy = f"Delete {path} and run again."
            raise InputError(path, f"masks must have the frames and size of camera {name}: {shape}", masks.labels.shape, remedy)
        by_camera[name] = masks
    return by_camera


def tracks_of_cameras(capture: Capture, records: Sequence[Path]) -> dict[str, PixelTracks]:
    """Tracks by camera, from records in the capture's order. Raises InputError for a missing record."""
    by_camera = _record_of(capture, records, "--tracks")
    return {name: PixelTracks.load(StageRecord.load(path).file("tracks", path)) for name, path in by_camera.items()}


def _record_of(capture: Capture, records: Sequence[Path], option: str) -> dict[str, Path]:
    if len(records) != len(capture.cameras):
        raise InputError(option, f"one record per camera is required: {list(capture.cameras)}", len(records))
    return dict(zip(capture.cameras, records, strict=True))
