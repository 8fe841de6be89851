"""Read PhysTwin's processed cases, `data/different_types/{case}/`, as Observations; table of the 22 released cases."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.config import Config, ScenarioRow
from neuspring.core.artifacts import Observations, Scenario
from neuspring.core.errors import InputError
from neuspring.core.files import load_json
from neuspring.core.records import digest_file
from neuspring.data.unpickle import load_pickle

FINAL_DATA, SPLIT, GT_TRACKS, METADATA, CALIBRATION = (
    "final_data.pkl",
    "split.json",
    "gt_track_3d.pkl",
    "metadata.json",
    "calibrate.pkl",
)
FILES = (FINAL_DATA, SPLIT, GT_TRACKS, METADATA)
"""Files of a processed case that the reader uses."""
RAW_FILES = (METADATA, CALIBRATION, SPLIT, GT_TRACKS)
"""Files of a raw case that the importer uses, besides images."""
RATE_KEYS = ("fps", "record_hz")
RELEASED_FRAME_RATE = 30.0
"""Frames per second of every released recording; the default without metadata.json."""
CASE_ARRAYS = {
    "object_points": (("T", "No", 3), "f"),
    "object_visibilities": (("T", "No"), "b"),
    "object_motions_valid": (("T", "No"), "b"),
    "controller_points": (("T", "C", 3), "f"),
    "surface_points": (("Ns", 3), "f"),
    "interior_points": (("Ni", 3), "f"),
}
"""Key -> shape and NumPy's kind; equal letters are equal sizes in all arrays."""


@cache
def released_cases() -> dict[str, dict[str, str]]:
    """The table of the 22 released cases: case -> column -> text, empty where unknown."""
    text = resources.files("neuspring.data").joinpath("tables", "phystwin22.csv").read_text(encoding="utf-8")
    return {row["case"]: row for row in csv.DictReader(text.splitlines())}


def observe(row: ScenarioRow, path: Path, config: Config, output: Path) -> Observations:
    """See `neuspring.scenes.sources`."""
    return read(row, path)


def read(row: ScenarioRow, folder: Path) -> Observations:
    """Read one processed case from its `folder`.

    Requires final_data.pkl and split.json. Optional are gt_track_3d.pkl (default: no tracks) and metadata.json (default: 30 frames
    per second). Meters, float32; up is -z. Raises InputError with file and key.
    """
    from neuspring.checks.moving import ORDER, Moving, swapped

    folder = Path(folder)
    data = arrays_of(folder / FINAL_DATA)
    frames = len(data["object_points"])
    train_end, rate = split_and_rate(folder, frames)
    tracks = annotated(folder, frames)
    finding = swapped(Moving(data["controller_points"], rate))
    if finding and "level" in finding:
        rule = "controller_points: each point must keep its index in all frames"
        raise InputError(folder / FINAL_DATA, rule, f"another order {finding['detail']}", ORDER)
    return Observations(
        scenario=Scenario(
            name=row.scenario,
            source="phystwin",
            category=row.category,
            frame_count=frames,
            train_end=train_end,
            frame_rate=rate,
            up="-z",
            self_collision=row.self_collision,
            ground=row.ground,
            provenance={name: f"sha256:{digest_file(folder / name)}" for name in FILES if (folder / name).exists()},
        ),
        object_points=data["object_points"],
        object_visibility=data["object_visibilities"],
        object_motion_valid=data["object_motions_valid"],
        controller_points=data["controller_points"],
        surface_points=data["surface_points"],
        interior_points=data["interior_points"],
        tracks=np.zeros((frames, 0, 3)) if tracks is None else tracks,
    )


def split_and_rate(case: Path, frames: int | None = None) -> tuple[int, float]:
    """End of the training frames, and frames per second, from the small files. Raises InputError.

    A plan reads them before the number of frames is known.
    """
    metadata = metadata_of(case) if (case / METADATA).exists() else {}
    return train_end_of(case, frames), rate_of(case / METADATA, metadata, RELEASED_FRAME_RATE)


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of final_data.pkl. Raises InputError for the first broken rule."""
    data: dict[str, np.ndarray] = load_pickle(path)
    sizes = dict[str, int]()
    _require(isinstance(data, dict), path, "a dict of arrays is required", type(data).__name__)
    for key, (shape, kind) in CASE_ARRAYS.items():
        value, form = data.get(key), f"{key}: a {'bool' if kind == 'b' else 'floating point'} array {list(shape)} is required"
        if not isinstance(value, np.ndarray) or value.dtype.kind != kind or value.ndim != len(shape):
            received = f"{value.dtype} {list(value.shape)}" if isinstance(value, np.ndarray) else type(value).__name__
            raise InputError(path, form, received if key in data else "nothing: this key is missing")
        wanted = [
            size if isinstance(size, int) else sizes.setdefault(size, have) for size, have in zip(shape, value.shape, strict=True)
        ]
        _require(list(value.shape) == wanted, path, f"{form}, here {wanted}", list(value.shape))
        bad = np.argwhere(~np.isfinite(value))
        _require(not len(bad), path, f"{key}: every coordinate must be finite", bad[:1].tolist())
    visible, points, moves = data["object_visibilities"], data["object_points"], data["object_motions_valid"]
    both = visible[:-1] & visible[1:]
    faults = {
        "object_points: at least 2 frames and one point are required": (len(visible) < 2 or not points.size) and visible.shape,
        "controller_points: at least one controller point is required": not sizes["C"] and "none",
        "object_visibilities: all points must be visible in frame 0, the rest state": (~visible[:1]).sum(),
        "object_motions_valid: a motion may be valid only if its point is visible before and after it": (moves[:-1] & ~both).sum(),
        "object_points: the object's median must not be below the table (up is -z), m": points.size
        and max(0.0, np.median(points[0, :, 2])),
    }
    for rule, fault in faults.items():
        _require(not fault, path, rule, fault)
    return dict(data)


def _require(kept: object, path: Path, rule: str, received: object) -> None:
    if not kept:
        raise InputError(path, rule, received)


def metadata_of(case: Path) -> dict[str, Any]:
    """Read metadata.json. Raises InputError."""
    metadata = load_json(case / METADATA)
    _require(isinstance(metadata, dict), case / METADATA, "a JSON object is required", type(metadata).__name__)
    return dict(metadata)


def rate_of(path: Path, metadata: dict[str, Any], default: float | None = None) -> float:
    """Frames per second in metadata.json: `fps`, or `record_hz` in forks. Raises InputError."""
    return stated(path, metadata, RATE_KEYS, "a positive number of frames per second", default)


def stated(path: Path, metadata: dict[str, Any], keys: Sequence[str], rule: str, default: float | None = None) -> float:
    """The positive number that `keys` of metadata.json state, once or for each camera. Raises InputError if numbers differ."""
    given = {key: metadata[key] for key in keys if key in metadata}
    values = [one for value in given.values() for one in (value if isinstance(value, list) else [value])] or [default]
    if len(set(map(str, values))) != 1 or type(values[0]) not in (int, float) or not 0 < values[0] < 1e6:
        raise InputError(path, f"{' or '.join(keys)}: {rule} is required, the same for all cameras", given or None)
    return float(values[0])


def has_images(case: Path) -> bool:
    """True if a case contains what a capture with masks needs: images, masks and calibration."""
    files = all((Path(case) / name).is_file() for name in (METADATA, CALIBRATION))
    return files and all((Path(case) / kind).is_dir() for kind in ("color", "depth", "mask"))


def camera_count(case: Path) -> int:
    """Number of cameras in metadata.json. Raises InputError."""
    intrinsics = metadata_of(Path(case)).get("intrinsics")
    if not isinstance(intrinsics, list) or not intrinsics:
        raise InputError(Path(case) / METADATA, "intrinsics: a list of 3 x 3 matrices is required", type(intrinsics).__name__)
    return len(intrinsics)


def annotated(case: Path, frames: int) -> np.ndarray | None:
    """Annotated tracks [T, K, 3], m, NaN where not annotated; None without any. Raises InputError."""
    path = case / GT_TRACKS
    if not path.exists():
        return None
    tracks = load_pickle(path)
    form = isinstance(tracks, np.ndarray) and tracks.dtype.kind == "f" and tracks.ndim == 3 and tracks.shape[::2] == (frames, 3)
    received = tracks.shape if isinstance(tracks, np.ndarray) else type(tracks).__name__
    _require(form and not np.isinf(tracks).any(), path, f"floating point [{frames}, K, 3] is required, NaN where unseen", received)
    return np.asarray(tracks, dtype=float)


def train_end_of(case: Path, frames: int | None) -> int:
    """The end of the training frames [0, end), from split.json. Raises InputError."""
    split = load_json(case / SPLIT)
    for key in ("train", "test"):
        value = split.get(key) if isinstance(split, dict) else None
        whole = isinstance(value, list) and len(value) == 2 and all(type(v) is int for v in value)
        inside = whole and 0 <= value[0] <= value[1] <= (frames or value[1]) and (key == "test" or value[1] >= 2)  # type: ignore[index]
        within = f" within {frames} frames" if frames else ""
        _require(inside, case / SPLIT, f"{key}: whole numbers [start, end){within} are required", value or split)
    return int(split["train"][1])
