"""PhysTwin's folders `data/different_types/{case}/`: processed cases -> Observations; the table of the 22 released cases."""

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
"""The files that the reader looks for in a processed case's folder."""
RAW_FILES = (METADATA, CALIBRATION, SPLIT, GT_TRACKS)
"""The files beside images that the importer looks for in a raw case's folder."""
RATE_KEYS = ("fps", "record_hz")
RELEASED_FRAME_RATE = 30.0
"""Frames per second of every released recording; used where metadata.json is absent."""
CASE_ARRAYS = {
    "object_points": (("T", "No", 3), "f"),
    "object_visibilities": (("T", "No"), "b"),
    "object_motions_valid": (("T", "No"), "b"),
    "controller_points": (("T", "C", 3), "f"),
    "surface_points": (("Ns", 3), "f"),
    "interior_points": (("Ni", 3), "f"),
}
"""Key -> shape, in which a letter is one size in all arrays, and NumPy's kind."""


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

    Uses final_data.pkl and split.json; gt_track_3d.pkl (else no tracks) and metadata.json (else 30 frames per second) where
    present. Meters, float32, world with -z up. Raises InputError naming file and key.
    """
    from neuspring.checks.moving import ORDER, Moving, swapped

    folder = Path(folder)
    data = arrays_of(folder / FINAL_DATA)
    frames = len(data["object_points"])
    train_end, rate = split_and_rate(folder, frames)
    tracks = annotated(folder, frames)
    words = swapped(Moving(data["controller_points"], rate))
    if words and "level" in words:
        rule = "controller_points: each point must keep its index in all frames"
        raise InputError(folder / FINAL_DATA, rule, f"other orders {words['detail']}", ORDER)
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
    """End of training and frames per second, of the small files, which a plan reads without the number of frames.

    Raises InputError.
    """
    metadata = metadata_of(case) if (case / METADATA).exists() else {}
    return train_end_of(case, frames), rate_of(case / METADATA, metadata, RELEASED_FRAME_RATE)


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    """The arrays of final_data.pkl. Raises InputError for the first rule that they break."""
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
        "object_visibilities: no point may be hidden in frame 0, the rest state": (~visible[:1]).sum(),
        "object_motions_valid: no motion may be valid where its point is hidden before or after": (moves[:-1] & ~both).sum(),
        "object_points: up is -z, and the object's median may not be below the table, m": points.size
        and max(0.0, np.median(points[0, :, 2])),
    }
    for rule, fault in faults.items():
        _require(not fault, path, rule, fault)
    return dict(data)


def _require(kept: object, path: Path, rule: str, received: object) -> None:
    if not kept:
        raise InputError(path, rule, received)


def metadata_of(case: Path) -> dict[str, Any]:
    """metadata.json. Raises InputError."""
    metadata = load_json(case / METADATA)
    _require(isinstance(metadata, dict), case / METADATA, "a JSON object is required", type(metadata).__name__)
    return dict(metadata)


def rate_of(path: Path, metadata: dict[str, Any], default: float | None = None) -> float:
    """Frames per second by metadata.json: `fps`, or `record_hz` as forks call it. Raises InputError."""
    return stated(path, metadata, RATE_KEYS, "a positive number of frames per second", default)


def stated(path: Path, metadata: dict[str, Any], keys: Sequence[str], rule: str, default: float | None = None) -> float:
    """The one positive number that keys of metadata.json state, for all cameras or for each. Raises InputError."""
    given = {key: metadata[key] for key in keys if key in metadata}
    values = [one for value in given.values() for one in (value if isinstance(value, list) else [value])] or [default]
    if len(set(map(str, values))) != 1 or type(values[0]) not in (int, float) or not 0 < values[0] < 1e6:
        raise InputError(path, f"{' or '.join(keys)}: {rule} is required, one for all cameras", given or None)
    return float(values[0])


def has_images(case: Path) -> bool:
    """True where a case's folder holds what a capture with masks needs: images, masks and calibration."""
    files = all((Path(case) / name).is_file() for name in (METADATA, CALIBRATION))
    return files and all((Path(case) / kind).is_dir() for kind in ("color", "depth", "mask"))


def camera_count(case: Path) -> int:
    """Number of cameras that metadata.json declares. Raises InputError."""
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
    """Training frames are [0, this) as split.json states. Raises InputError."""
    split = load_json(case / SPLIT)
    for key in ("train", "test"):
        value = split.get(key) if isinstance(split, dict) else None
        whole = isinstance(value, list) and len(value) == 2 and all(type(v) is int for v in value)
        inside = whole and 0 <= value[0] <= value[1] <= (frames or value[1]) and (key == "test" or value[1] >= 2)  # type: ignore[index]
        within = f" within {frames} frames" if frames else ""
        _require(inside, case / SPLIT, f"{key}: whole numbers [start, end){within} are required", value or split)
    return int(split["train"][1])
