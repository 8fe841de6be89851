"""PhysTwin's raw layout (`data/different_types/<case>/`, before processing or beside it) -> a capture folder.

Images are linked where the file system allows it, else copied; masks are put together from one image per detection.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from neuspring.config import ScenarioRow
from neuspring.core.errors import InputError
from neuspring.core.records import digest_file
from neuspring.data import phystwin
from neuspring.data.calibration import metadata_departures, poses_departures
from neuspring.data.capture import HANDS, OBJECT, Camera, Capture, Description, Writer, make_way, read_image
from neuspring.data.departure import Departure, broken, refuse
from neuspring.data.json_file import load_json
from neuspring.data.unpickle import load_pickle

CALIBRATION = "calibrate.pkl"
FILES = (phystwin.METADATA, CALIBRATION, phystwin.SPLIT, phystwin.TRACKS)
"""The files beside images that the importer looks for in a case's folder."""
HAND_PHRASE = "hand"
"""The detected phrase of hands. The one detection of a camera with another phrase is the object."""


def has_images(case: Path) -> bool:
    """Whether a case's folder holds what a capture with masks needs: images, masks and calibration."""
    files = all((Path(case) / name).is_file() for name in (phystwin.METADATA, CALIBRATION))
    return files and all((Path(case) / kind).is_dir() for kind in ("color", "depth", "mask"))


def convert(row: ScenarioRow, case: Path, folder: Path) -> Capture:
    """Write `case` as a capture folder. Raises InputError naming file and key."""
    case = Path(case)
    metadata, poses = load_json(case / phystwin.METADATA), load_pickle(case / CALIBRATION)
    refuse(raw_departures(case, metadata, poses))
    frames = int(metadata["frame_num"])
    has_masks = (case / "mask").is_dir()
    description = Description(
        format=1,
        name=row.scenario,
        category=row.category,
        frame_count=frames,
        frame_rate=float(metadata.get("fps", phystwin.RELEASED_FRAME_RATE)),
        cameras=tuple(camera.entry() for camera in cameras_of(metadata, poses)),
        depth_unit=0.001,
        depth_format="npy",
        up="-z",
        train_end=train_end_of(case, frames),
        masks=has_masks,
        provenance={name: f"sha256:{digest_file(case / name)}" for name in (phystwin.METADATA, CALIBRATION)},
    )
    writer = Writer(folder, description)
    capture = writer.capture
    for name, camera in capture.cameras.items():
        ids = detections(case, name) if has_masks else {}
        for frame in range(frames):
            _link(case / "color" / name / f"{frame}.png", capture.path("color", name, frame))
            _link(case / "depth" / name / f"{frame}.npy", capture.path("depth", name, frame))
            if has_masks:
                writer.mask(name, frame, labels_of(case, camera, frame, ids))
    return writer.finish(annotated(case, frames))


def camera_count(case: Path) -> int:
    """How many cameras metadata.json declares. Raises InputError."""
    path = Path(case) / phystwin.METADATA
    metadata = load_json(path)
    intrinsics = metadata.get("intrinsics") if isinstance(metadata, dict) else None
    if not isinstance(intrinsics, list) or not intrinsics:
        raise InputError(path, "intrinsics: a list of 3 x 3 matrices is required", type(intrinsics).__name__)
    return len(intrinsics)


def raw_departures(case: Path, metadata: Any, poses: Any) -> list[Departure]:
    """Frame rate, frame count and calibration in metadata.json and calibrate.pkl."""
    path = case / phystwin.METADATA
    departures = phystwin.frame_rate_departures(path, metadata)
    if not isinstance(metadata, dict):
        return departures
    count, intrinsics = metadata.get("frame_num"), metadata.get("intrinsics")
    if type(count) is not int or count < 5:
        departures.append(broken(path, "frame_num", "at least 5 frames are required", count))
    departures += metadata_departures(path, metadata)
    return departures + poses_departures(case / CALIBRATION, poses, len(intrinsics) if isinstance(intrinsics, list) else None)


def cameras_of(metadata: dict[str, Any], poses: list[np.ndarray]) -> list[Camera]:
    """The cameras in metadata.json and calibrate.pkl, named by their numbers. `raw_departures` must have no errors."""
    width, height = metadata["WH"]
    intrinsics = np.asarray(metadata["intrinsics"], dtype=np.float64)
    return [
        Camera(str(index), width, height, matrix, np.asarray(pose, dtype=np.float64))
        for index, (matrix, pose) in enumerate(zip(intrinsics, poses, strict=True))
    ]


def detections(case: Path, camera: str) -> dict[int, list[str]]:
    """Label -> ids of its detections. Exactly one detection is not a hand."""
    path = case / "mask" / f"mask_info_{camera}.json"
    info = load_json(path)
    if not isinstance(info, dict) or not all(isinstance(v, str) for v in info.values()):
        raise InputError(path, "an object of detection ids and phrases is required", type(info).__name__)
    objects = [key for key, phrase in info.items() if phrase != HAND_PHRASE]
    if len(objects) != 1:
        rule = f"exactly one detection must not be {HAND_PHRASE!r}: the object"
        raise InputError(path, rule, info, "Remove the others from this file, or give them the phrase 'hand'.")
    return {OBJECT: objects, HANDS: [key for key in info if key not in objects]}


def labels_of(case: Path, camera: Camera, frame: int, ids: dict[int, list[str]]) -> np.ndarray:
    """Mask [H, W] uint8 of one frame, put together from the images of its detections. Raises InputError."""
    labels = np.zeros((camera.height, camera.width), dtype=np.uint8)
    for label, names in sorted(ids.items()):
        for name in names:
            mask = read_image(case / "mask" / camera.name / name / f"{frame}.png", camera, cv2.IMREAD_GRAYSCALE)
            labels[mask > 0] = label
    return labels


def annotated(case: Path, frames: int) -> np.ndarray | None:
    """Annotated tracks [T, K, 3], m, if there are any. Raises InputError."""
    path = case / phystwin.TRACKS
    if not path.exists():
        return None
    tracks = load_pickle(path)
    refuse(phystwin.tracks_departures(path, tracks, frames))
    return np.asarray(tracks, dtype=float)


def train_end_of(case: Path, frames: int) -> int | None:
    """Training frames are [0, this), if split.json says so. Raises InputError."""
    path = case / phystwin.SPLIT
    if not path.exists():
        return None
    split = load_json(path)
    refuse(phystwin.split_departures(path, split, frames))
    return int(split["train"][1])


def _link(source: Path, target: Path) -> None:
    if not source.is_file():
        raise InputError(source, "this image must exist", "no such file")
    make_way(target)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
