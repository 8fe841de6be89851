"""A case in PhysTwin's raw layout: images of all cameras, calibration, and masks, one image per detection.

Images of a scenario are linked where the file system allows it, else copied.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from neuspring.checks import examine
from neuspring.checks.case import RELEASED_FRAME_RATE
from neuspring.config import Config, ScenarioRow
from neuspring.core.errors import InputError
from neuspring.core.files import load_json
from neuspring.core.findings import refuse
from neuspring.core.records import digest_file
from neuspring.data.camera import Camera
from neuspring.data.capture import FEWEST_FRAMES, HANDS, OBJECT, Capture, Description, Writer
from neuspring.data.images import read_image
from neuspring.data.unpickle import load_pickle
from neuspring.intake.phystwin import CALIBRATION, METADATA, annotated, train_end_of


def write_capture(row: ScenarioRow, path: Path, config: Config, folder: Path) -> None:
    """See `neuspring.scenes.sources`."""
    convert(row, path, folder)


def convert(row: ScenarioRow, case: Path, folder: Path) -> Capture:
    """Write `case` as a capture folder. Raises InputError naming file and key."""
    case = Path(case)
    metadata, cameras = read_calibration(case)
    frames = int(metadata["frame_num"])
    has_masks = (case / "mask").is_dir()
    description = Description(
        format=1,
        name=row.scenario,
        category=row.category,
        frame_count=frames,
        frame_rate=float(metadata.get("fps", RELEASED_FRAME_RATE)),
        cameras=tuple(camera.entry() for camera in cameras),
        depth_format="npy",
        up="-z",
        train_end=train_end_of(case, frames),
        masks=has_masks,
        provenance={name: f"sha256:{digest_file(case / name)}" for name in (METADATA, CALIBRATION)},
    )
    writer = Writer(folder, description)
    kinds: tuple[Literal["color", "depth"], ...] = ("color", "depth")
    for name, camera in writer.capture.cameras.items():
        ids = detections(case, name) if has_masks else {}
        for frame in range(frames):
            for kind in kinds:
                source = case / kind / name / f"{frame}{writer.capture.path(kind, name, frame).suffix}"
                if not source.is_file():
                    remedy = f"Make a capture of the frames that are there: `neuspring make-capture --phystwin-raw {case}`."
                    raise InputError(source, "this image must exist", "no such file", remedy)
                writer.link(kind, name, frame, source)
            if has_masks:
                writer.mask(name, frame, labels_of(case, camera, frame, ids))
    return writer.finish(annotated(case, frames))


def read_calibration(case: Path) -> tuple[dict[str, Any], list[Camera]]:
    """metadata.json, and the cameras in it and in calibrate.pkl, named by their numbers. Raises InputError."""
    metadata, poses = load_json(case / METADATA), load_pickle(case / CALIBRATION)
    path = case / METADATA
    refuse(examine("metadata", path, metadata) + examine("lenses of metadata", path, metadata, None))
    count = metadata.get("frame_num")
    if type(count) is not int or count < FEWEST_FRAMES:
        raise InputError(case / METADATA, f"frame_num: at least {FEWEST_FRAMES} frames are required", count)
    refuse(examine("calibration", case / CALIBRATION, poses, len(metadata["intrinsics"])))
    width, height = metadata["WH"]
    intrinsics = np.asarray(metadata["intrinsics"], dtype=np.float64)
    return metadata, [
        Camera(str(index), width, height, matrix, np.asarray(pose, dtype=np.float64))
        for index, (matrix, pose) in enumerate(zip(intrinsics, poses, strict=True))
    ]


def detections(case: Path, camera: str) -> dict[int, list[str]]:
    """Label -> ids of its detections. Exactly one detection is not a hand."""
    path = case / "mask" / f"mask_info_{camera}.json"
    info = load_json(path)
    if not isinstance(info, dict) or not all(isinstance(v, str) for v in info.values()):
        raise InputError(path, "an object of detection ids and phrases is required", type(info).__name__)
    objects = [key for key, phrase in info.items() if phrase != "hand"]
    if len(objects) != 1:
        rule = "exactly one detection must not be 'hand': the object"
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
