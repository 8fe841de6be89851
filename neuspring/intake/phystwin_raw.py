"""Cases in PhysTwin's raw layout: images of all cameras, calibration, and masks with one image per detection.

The importer links images if the file system allows it, and otherwise copies them. A frame without color or depth of a camera is
`missing` for this camera.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from neuspring.config import Config, ScenarioRow
from neuspring.core.errors import InputError
from neuspring.core.files import load_json
from neuspring.core.findings import refuse
from neuspring.core.records import digest_file
from neuspring.data.camera import Camera
from neuspring.data.capture import (
    FEWEST_FRAMES,
    HANDS,
    OBJECT,
    Capture,
    Description,
    Writer,
    description_findings,
    intrinsics_findings,
    pose_findings,
)
from neuspring.data.images import read_array, read_image
from neuspring.data.unpickle import load_pickle
from neuspring.intake.phystwin import CALIBRATION, METADATA, SPLIT, annotated, metadata_of, rate_of, stated, train_end_of

BINARY_TOLERANCE = 1e-5
"""Allowed deviation from R^T R = 1 in a pickle of float64 products of OpenCV rotations."""
STREAMS: dict[Literal["color", "depth"], str] = {"color": ".png", "depth": ".npy"}
UNIT_KEY = "depth_scale_m_per_unit"
"""Key of metadata.json, m per count; the released cases do not have it and use 0.001."""


def write_capture(row: ScenarioRow, path: Path, config: Config, folder: Path) -> None:
    """See `neuspring.scenes.sources`."""
    convert(row.scenario, row.category, path, folder)


def read(name: str, category: str, case: Path) -> tuple[Description, list[Camera], dict[str, dict[int, list[str]]]]:
    """Read a case's description, its cameras, and each camera's detections by label; without masks there are no detections.

    Raises InputError.
    """
    metadata, cameras = read_calibration(case)
    frames, has_masks = int(metadata["frame_num"]), (case / "mask").is_dir()

    def complete(camera: str, frame: int) -> bool:
        return all((case / kind / camera / f"{frame}{ending}").is_file() for kind, ending in STREAMS.items())

    missing = {one.name: tuple(frame for frame in range(frames) if not complete(one.name, frame)) for one in cameras}
    unit = stated(case / METADATA, metadata, [UNIT_KEY], "a positive number of m per count", 0.001)
    description = Description(
        format=1,
        name=name,
        category=category,
        frame_count=frames,
        frame_rate=rate_of(case / METADATA, metadata),
        cameras=tuple(camera.entry(missing[camera.name]) for camera in cameras),
        depth_unit=unit,
        depth_format="npy",
        up="-z",
        train_end=train_end_of(case, frames) if (case / SPLIT).exists() else None,
        masks=has_masks,
        provenance={name: f"sha256:{digest_file(case / name)}" for name in (METADATA, CALIBRATION)},
    )
    refuse(description_findings(case / "color", description))
    for camera in cameras:
        frame = next((frame for frame in range(frames) if frame not in missing[camera.name]), 0)
        first = case / "depth" / camera.name / f"{frame}.npy"
        if (dtype := read_array(first, camera).dtype) != np.uint16:
            remedy = f"Write uint16. If the unit is not 0.001 m per count, state it as {UNIT_KEY} of {METADATA}."
            raise InputError(first, "depth must be 16-bit counts", dtype, remedy)
    return description, cameras, {camera.name: detections(case, camera.name) for camera in cameras if has_masks}


def convert(name: str, category: str, case: Path, folder: Path) -> Capture:
    """Write `case` as a capture folder. Raises InputError with file and key."""
    description, cameras, ids = read(name, category, case)
    writer, frames = Writer(folder, description), description.frame_count
    for camera in cameras:
        for frame in (frame for frame in range(frames) if writer.capture.has(camera.name, frame)):
            for kind, ending in STREAMS.items():
                writer.link(kind, camera.name, frame, case / kind / camera.name / f"{frame}{ending}")
            if ids:
                writer.mask(camera.name, frame, labels_of(case, camera, frame, ids[camera.name]))
    return writer.finish(annotated(case, frames))


def read_calibration(case: Path) -> tuple[dict[str, Any], list[Camera]]:
    """Read metadata.json, and the cameras in it and in calibrate.pkl, named by their numbers. Raises InputError."""
    path, metadata, poses = case / METADATA, metadata_of(case), load_pickle(case / CALIBRATION)
    size, count = metadata.get("WH"), metadata.get("frame_num")
    if not (isinstance(size, list) and len(size) == 2 and all(type(value) is int and value > 0 for value in size)):
        raise InputError(path, "WH: two positive whole numbers [width, height] are required", size)
    if type(count) is not int or count < FEWEST_FRAMES:
        raise InputError(path, f"frame_num: at least {FEWEST_FRAMES} frames are required", count)
    try:
        intrinsics = np.asarray(metadata.get("intrinsics"), dtype=np.float64)
    except (TypeError, ValueError):
        intrinsics = np.zeros(0)
    if intrinsics.ndim != 3 or intrinsics.shape[1:] != (3, 3) or not len(intrinsics) or not np.isfinite(intrinsics).all():
        raise InputError(path, "intrinsics: finite 3 x 3 matrices are required", f"shape {intrinsics.shape}")
    if not isinstance(poses, (list, tuple)) or [np.shape(pose) for pose in poses] != [(4, 4)] * len(intrinsics):
        rule = f"a list of {len(intrinsics)} camera-to-world matrices [4, 4] is required"
        raise InputError(case / CALIBRATION, rule, type(poses).__name__)
    cameras = []
    for index, (matrix, pose) in enumerate(zip(intrinsics, poses, strict=True)):
        refuse(intrinsics_findings(path, f"intrinsics, camera {index}", matrix, (size[0], size[1])))
        refuse(pose_findings(case / CALIBRATION, f"camera {index}", np.asarray(pose, float), BINARY_TOLERANCE))
        cameras.append(Camera(str(index), size[0], size[1], matrix, np.asarray(pose, dtype=np.float64)))
    return metadata, cameras


def detections(case: Path, camera: str) -> dict[int, list[str]]:
    """Label -> ids of its detections. Raises InputError unless exactly one detection is not a hand."""
    path = case / "mask" / f"mask_info_{camera}.json"
    info = load_json(path)
    if not isinstance(info, dict) or not all(isinstance(v, str) for v in info.values()):
        folders = sorted(folder.name for folder in (case / "mask" / camera).glob("*/"))
        rule = f'a phrase for each folder of mask/{camera} is required, like {{"0": "plush", "1": "hand"}}'
        raise InputError(path, rule, info, f"Name these folders: {', '.join(folders)}.")
    objects = [key for key, phrase in info.items() if phrase != "hand"]
    if len(objects) != 1:
        rule = "exactly one detection, the object, must have a phrase other than 'hand'"
        raise InputError(path, rule, info, "Remove other detections from this file, or give them the phrase 'hand'.")
    return {OBJECT: objects, HANDS: [key for key in info if key not in objects]}


def labels_of(case: Path, camera: Camera, frame: int, ids: dict[int, list[str]]) -> np.ndarray:
    """Mask [H, W] uint8 of one frame, combined from the images of its detections. Raises InputError."""
    labels = np.zeros((camera.height, camera.width), dtype=np.uint8)
    for label, names in sorted(ids.items()):
        for name in names:
            mask = read_image(case / "mask" / camera.name / name / f"{frame}.png", camera, cv2.IMREAD_GRAYSCALE)
            labels[mask > 0] = label
    return labels
