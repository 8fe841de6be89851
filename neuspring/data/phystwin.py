"""PhysTwin's folders `data/different_types/{case}/`: processed -> Observations, raw -> a capture folder; the table of its 22 cases.

Layout: the released PhysTwin data. Each `*_findings` function lists everything in one file that the reader refuses (errors) or
that is not as released and harmless (warnings); `read` and `convert` raise the first error, `neuspring check-data`
prints them all. Of raw cases images are linked where the file system allows it, else copied; masks are put together from one image
per detection.
"""

from __future__ import annotations

import csv
import os
import shutil
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from neuspring.config import Config, ScenarioRow
from neuspring.core.artifacts import Observations, Scenario
from neuspring.core.errors import InputError
from neuspring.core.files import load_json
from neuspring.core.findings import Finding, broken, refuse, unusual
from neuspring.core.records import digest_file
from neuspring.data.capture import (
    HANDS,
    OBJECT,
    Camera,
    Capture,
    Description,
    Writer,
    intrinsics_findings,
    make_way,
    pose_findings,
    read_image,
)
from neuspring.data.unpickle import load_pickle


@cache
def released_cases() -> dict[str, dict[str, str]]:
    """The table of the 22 released cases: case -> column -> text, empty where unknown."""
    text = resources.files("neuspring.data").joinpath("tables", "phystwin22.csv").read_text(encoding="utf-8")
    return {row["case"]: row for row in csv.DictReader(text.splitlines())}


FINAL_DATA, SPLIT, TRACKS, METADATA = "final_data.pkl", "split.json", "gt_track_3d.pkl", "metadata.json"
CALIBRATION = "calibrate.pkl"
FILES = (FINAL_DATA, SPLIT, TRACKS, METADATA)
"""The files that the reader looks for in a processed case's folder."""
RAW_FILES = (METADATA, CALIBRATION, SPLIT, TRACKS)
"""The files beside images that the importer looks for in a raw case's folder."""
RELEASED_FRAME_RATE = 30.0
"""Frames per second of every released recording; used where metadata.json is absent."""
MAX_FRAME_RATE = 1e6
BINARY_TOLERANCE = 1e-5
"""Allowed deviation from R^T R = 1 in a pickle of float64 products of OpenCV rotations."""


@dataclass(frozen=True)
class ArrayRule:
    """The rule for one array of a pickle. In its shape, names stand for sizes that agree within the file; digits are fixed."""

    key: str
    shape: tuple[str, ...]
    kind: str
    """NumPy's letter: f (finite floating point) or b (bool)."""
    required: bool = True
    """Whether the reader uses it."""


ARRAYS = (
    ArrayRule("object_points", ("T", "No", "3"), "f"),
    ArrayRule("object_visibilities", ("T", "No"), "b"),
    ArrayRule("object_motions_valid", ("T", "No"), "b"),
    ArrayRule("controller_points", ("T", "C", "3"), "f"),
    ArrayRule("surface_points", ("Ns", "3"), "f"),
    ArrayRule("interior_points", ("Ni", "3"), "f"),
    ArrayRule("object_colors", ("T", "No", "3"), "f", required=False),
)
IGNORED = ("controller_mask",)
"""A left-over key of the released processing, which is accepted and not read."""
KIND_NAMES = {"f": "floating point", "b": "bool"}


def observe(row: ScenarioRow, path: Path, config: Config, output: Path) -> Observations:
    """See `neuspring.data.sources`."""
    return read(row, path)


def write_capture(row: ScenarioRow, path: Path, config: Config, folder: Path) -> None:
    """See `neuspring.data.sources`."""
    convert(row, path, folder)


def read(row: ScenarioRow, folder: Path) -> Observations:
    """Read one processed case from its `folder`.

    Uses final_data.pkl and split.json; gt_track_3d.pkl (else no tracks) and metadata.json (else 30 frames per second) where
    present. Meters, float32, world with -z up. Raises InputError naming file and key.
    """
    folder = Path(folder)
    data_path, split_path = folder / FINAL_DATA, folder / SPLIT
    data = load_pickle(data_path)
    refuse(final_data_findings(data_path, data))
    frames = len(data["object_points"])
    split = load_json(split_path)
    refuse(split_findings(split_path, split, frames))
    used = [data_path, split_path]

    tracks = annotated(folder, frames)
    if tracks is not None:
        used.append(folder / TRACKS)
    frame_rate = RELEASED_FRAME_RATE
    if (folder / METADATA).exists():
        metadata = load_json(folder / METADATA)
        refuse(frame_rate_findings(folder / METADATA, metadata))
        frame_rate = float(metadata.get("fps", RELEASED_FRAME_RATE))
        used.append(folder / METADATA)

    return Observations(
        scenario=Scenario(
            name=row.scenario,
            source="phystwin",
            category=row.category,
            frame_count=frames,
            train_end=split["train"][1],
            frame_rate=frame_rate,
            up="-z",
            self_collision=row.self_collision,
            ground=row.ground,
            provenance={file.name: f"sha256:{digest_file(file)}" for file in used},
        ),
        object_points=data["object_points"],
        object_visibility=data["object_visibilities"],
        object_motion_valid=data["object_motions_valid"],
        controller_points=data["controller_points"],
        surface_points=data["surface_points"],
        interior_points=data["interior_points"],
        tracks=np.zeros((frames, 0, 3)) if tracks is None else tracks,
    )


def final_data_findings(path: Path, data: Any) -> list[Finding]:
    """Keys, shapes, dtypes and finiteness of final_data.pkl, and the rules without which nothing can be simulated."""
    findings = structure_findings(path, data)
    if not isinstance(data, dict):
        return findings
    for rule in ARRAYS:
        value = data.get(rule.key)
        if rule.kind != "f" or not isinstance(value, np.ndarray) or value.dtype.kind != "f" or value.ndim != len(rule.shape):
            continue
        if value.dtype != np.float64:
            findings.append(unusual(path, rule.key, "the released dtype is float64", value.dtype))
        bad = np.argwhere(~np.isfinite(value))
        if len(bad):
            severity = broken if rule.required else unusual
            findings.append(severity(path, rule.key, "every coordinate must be finite", describe_bad(value, bad)))
    if any(d.level == "error" for d in findings):
        return findings
    frames, points = data["object_visibilities"].shape
    if points == 0:
        findings.append(broken(path, "object_points", "at least one tracked object point is required", "none"))
    if data["controller_points"].shape[1] == 0:
        findings.append(broken(path, "controller_points", "at least one controller point is required", "none"))
    if frames < 2:
        findings.append(broken(path, "object_points", "at least 2 frames are required", frames))
    hidden = np.flatnonzero(~data["object_visibilities"][0]) if frames else np.zeros(0, int)
    if len(hidden):
        needed = "every tracked point must be visible in frame 0, which is the rest state"
        findings.append(broken(path, "object_visibilities", needed, f"{len(hidden)} of {points} hidden, first: point {hidden[0]}"))
    return findings


def structure_findings(path: Path, data: Any) -> list[Finding]:
    """Keys, types, shapes and dtypes. Without errors the content of the arrays can be looked at."""
    if not isinstance(data, dict):
        return [broken(path, "", "a dict of arrays is required", type(data).__name__)]
    keys = {rule.key for rule in ARRAYS} | set(IGNORED)
    findings = [unusual(path, str(key), "unknown key, not read") for key in data if key not in keys]
    sizes: dict[str, int] = {}
    """The symbolic dimensions of the file."""
    for rule in ARRAYS:
        severity = broken if rule.required else unusual
        shape, value = f"[{', '.join(rule.shape)}]", data.get(rule.key)
        if rule.key not in data:
            findings.append(severity(path, rule.key, "this key is missing"))
        elif not isinstance(value, np.ndarray):
            findings.append(severity(path, rule.key, f"an array {shape} is required", type(value).__name__))
        elif value.ndim != len(rule.shape):
            findings.append(severity(path, rule.key, f"the shape must be {shape}", value.shape))
        else:
            for axis, (symbol, size) in enumerate(zip(rule.shape, value.shape, strict=True)):
                wanted = int(symbol) if symbol.isdigit() else sizes.setdefault(symbol, size)
                if size != wanted:
                    message = f"the shape must be {shape} with {wanted} entries along axis {axis}"
                    findings.append(severity(path, rule.key, message, value.shape))
            if value.dtype.kind != rule.kind:
                findings.append(severity(path, rule.key, f"the dtype must be {KIND_NAMES[rule.kind]}", value.dtype))
    return findings


def describe_bad(value: np.ndarray, bad: np.ndarray) -> str:
    """'nan at frame 3, point 17 (5 in all)' for rows `bad` of np.argwhere on a [T, K, 3] or [K, 3] array."""
    first = tuple(int(i) for i in bad[0])
    place = f"frame {first[0]}, point {first[1]}" if value.ndim == 3 else f"point {first[0]}"
    return f"{value[first]} at {place} ({len(bad)} in all)"


def split_findings(path: Path, split: Any, frames: int) -> list[Finding]:
    """split.json against the number of frames: half-open ranges [start, end) inside [0, frames]."""
    if not isinstance(split, dict):
        return [broken(path, "", "a JSON object with train and test is required", type(split).__name__)]
    findings = []
    for key in ("train", "test"):
        value = split.get(key)
        if not (isinstance(value, list) and len(value) == 2 and all(type(v) is int for v in value)):
            received = value if key in split else "nothing"
            findings.append(broken(path, key, "two whole numbers [start, end) are required", received))
        elif not 0 <= value[0] <= value[1] <= frames:
            findings.append(broken(path, key, f"the range must lie within the {frames} frames of {FINAL_DATA}", value))
        elif key == "train" and value[1] < 2:
            findings.append(broken(path, key, "at least one frame after frame 0 must be for training", value))
    if findings:
        return findings
    end = int(0.7 * frames)
    for key, wanted in (("train", [0, end]), ("test", [end, frames])):
        if split[key] != wanted:
            meaning = f"NeuSpring trains on [0, {split['train'][1]}) and predicts [{split['train'][1]}, {frames})"
            findings.append(unusual(path, key, f"the released splits are {wanted} for {frames} frames; {meaning}", split[key]))
    if split.get("frame_len") != frames:
        findings.append(unusual(path, "frame_len", f"{FINAL_DATA} has {frames} frames", split.get("frame_len", "nothing")))
    return findings


def tracks_findings(path: Path, tracks: Any, frames: int | None) -> list[Finding]:
    """gt_track_3d.pkl: floating point [T, K, 3], NaN rows where not annotated. `frames` None skips the comparison of T."""
    if not isinstance(tracks, np.ndarray):
        return [broken(path, "", "an array [T, K, 3] is required", type(tracks).__name__)]
    if tracks.ndim != 3 or tracks.shape[2] != 3:
        return [broken(path, "", "the shape must be [T, K, 3]", tracks.shape)]
    if tracks.dtype.kind != "f":
        return [broken(path, "", "the dtype must be floating point", tracks.dtype)]
    findings = []
    if frames is not None and len(tracks) != frames:
        findings.append(broken(path, "", f"{FINAL_DATA} has {frames} frames", tracks.shape))
    if tracks.dtype != np.float64:
        findings.append(unusual(path, "", "the released dtype is float64", tracks.dtype))
    infinite = np.argwhere(np.isinf(tracks))
    if len(infinite):
        findings.append(broken(path, "", "coordinates must be finite, or NaN where not annotated", describe_bad(tracks, infinite)))
    missing = np.isnan(tracks)
    partial = np.argwhere(missing.any(axis=2) & ~missing.all(axis=2))
    if len(partial):
        place = f"frame {partial[0][0]}, point {partial[0][1]} ({len(partial)} in all)"
        findings.append(unusual(path, "", "a point is NaN in all three coordinates or in none", place))
    return findings


def frame_rate_findings(path: Path, metadata: Any) -> list[Finding]:
    """The only field of metadata.json that the reader uses: fps, a positive number; 30 where absent."""
    if not isinstance(metadata, dict):
        return [broken(path, "", "a JSON object is required", type(metadata).__name__)]
    fps = metadata.get("fps", RELEASED_FRAME_RATE)
    if type(fps) not in (int, float) or not 0 < fps < MAX_FRAME_RATE:
        return [broken(path, "fps", "a positive number of frames per second is required", fps)]
    if fps != RELEASED_FRAME_RATE:
        return [unusual(path, "fps", f"released recordings have {RELEASED_FRAME_RATE:g} frames per second", fps)]
    return []


def has_images(case: Path) -> bool:
    """Whether a case's folder holds what a capture with masks needs: images, masks and calibration."""
    files = all((Path(case) / name).is_file() for name in (METADATA, CALIBRATION))
    return files and all((Path(case) / kind).is_dir() for kind in ("color", "depth", "mask"))


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
    for name, camera in writer.capture.cameras.items():
        ids = detections(case, name) if has_masks else {}
        for frame in range(frames):
            for kind, ending in (("color", "png"), ("depth", "npy")):
                source, target = case / kind / name / f"{frame}.{ending}", folder / kind / name / f"{frame:05d}.{ending}"
                if not source.is_file():
                    remedy = f"Make a capture of the frames that are there: `neuspring make-capture --phystwin-raw {case}`."
                    raise InputError(source, "this image must exist", "no such file", remedy)
                make_way(target)
                try:
                    os.link(source, target)
                except OSError:
                    shutil.copyfile(source, target)
            if has_masks:
                writer.mask(name, frame, labels_of(case, camera, frame, ids))
    return writer.finish(annotated(case, frames))


def camera_count(case: Path) -> int:
    """How many cameras metadata.json declares. Raises InputError."""
    path = Path(case) / METADATA
    metadata = load_json(path)
    intrinsics = metadata.get("intrinsics") if isinstance(metadata, dict) else None
    if not isinstance(intrinsics, list) or not intrinsics:
        raise InputError(path, "intrinsics: a list of 3 x 3 matrices is required", type(intrinsics).__name__)
    return len(intrinsics)


def raw_findings(case: Path, metadata: Any, poses: Any) -> list[Finding]:
    """Frame rate, frame count and calibration in metadata.json and calibrate.pkl."""
    path = case / METADATA
    findings = frame_rate_findings(path, metadata)
    if not isinstance(metadata, dict):
        return findings
    count, intrinsics = metadata.get("frame_num"), metadata.get("intrinsics")
    if type(count) is not int or count < 5:
        findings.append(broken(path, "frame_num", "at least 5 frames are required", count))
    findings += metadata_findings(path, metadata)
    return findings + poses_findings(case / CALIBRATION, poses, len(intrinsics) if isinstance(intrinsics, list) else None)


def metadata_findings(file: Path, metadata: dict[str, Any], cameras: int | None = None) -> list[Finding]:
    """Image size and intrinsics of metadata.json. `cameras` is the required number of cameras; None allows any but zero."""
    findings = []
    size: Any = metadata.get("WH")
    has_size = isinstance(size, list) and len(size) == 2 and all(type(value) is int and value > 0 for value in size)
    if not has_size:
        findings.append(broken(file, "WH", "two positive whole numbers [width, height] are required", size))
    try:
        intrinsics = np.asarray(metadata.get("intrinsics"), dtype=np.float64)
    except (TypeError, ValueError):
        intrinsics = np.zeros(0)
    count = cameras or max(len(intrinsics) if intrinsics.ndim else 0, 1)
    if intrinsics.shape != (count, 3, 3) or not np.isfinite(intrinsics).all():
        rule = f"{cameras or 'one or more'} finite 3 x 3 matrices are required"
        return [*findings, broken(file, "intrinsics", rule, f"shape {intrinsics.shape}")]
    for index, matrix in enumerate(intrinsics):
        key = f"intrinsics, camera {index}"
        findings += intrinsics_findings(file, key, matrix, (size[0], size[1]) if has_size else None)
    return findings


def poses_findings(file: Path, poses: Any, cameras: int | None) -> list[Finding]:
    """The matrices of calibrate.pkl. `cameras` is the required number of cameras; None skips the comparison."""
    if not isinstance(poses, (list, tuple)) or (cameras is not None and len(poses) != cameras):
        received = f"{type(poses).__name__} of {len(poses)}" if isinstance(poses, (list, tuple)) else type(poses).__name__
        return [broken(file, "", f"a list of {cameras or ''} camera-to-world matrices is required".replace("  ", " "), received)]
    findings = []
    for index, pose in enumerate(poses):
        key = f"camera {index}"
        if not isinstance(pose, np.ndarray) or pose.shape != (4, 4) or pose.dtype.kind != "f":
            received = f"{pose.shape} {pose.dtype}" if isinstance(pose, np.ndarray) else type(pose).__name__
            findings.append(broken(file, key, "a (4, 4) floating point matrix is required", received))
            continue
        if pose.dtype != np.float64:
            findings.append(unusual(file, key, "the released dtype is float64", pose.dtype))
        findings += pose_findings(file, key, pose, BINARY_TOLERANCE)
    return findings


def read_calibration(case: Path) -> tuple[dict[str, Any], list[Camera]]:
    """metadata.json, and the cameras in it and in calibrate.pkl, named by their numbers. Raises InputError."""
    metadata, poses = load_json(case / METADATA), load_pickle(case / CALIBRATION)
    refuse(raw_findings(case, metadata, poses))
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


def annotated(case: Path, frames: int) -> np.ndarray | None:
    """Annotated tracks [T, K, 3], m, if there are any. Raises InputError."""
    path = case / TRACKS
    if not path.exists():
        return None
    tracks = load_pickle(path)
    refuse(tracks_findings(path, tracks, frames))
    return np.asarray(tracks, dtype=float)


def train_end_of(case: Path, frames: int) -> int | None:
    """Training frames are [0, this), if split.json says so. Raises InputError."""
    path = case / SPLIT
    if not path.exists():
        return None
    split = load_json(path)
    refuse(split_findings(path, split, frames))
    return int(split["train"][1])
