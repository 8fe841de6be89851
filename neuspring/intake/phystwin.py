"""PhysTwin's folders `data/different_types/{case}/`: processed -> Observations, raw -> a capture folder; the table of its 22 cases.

Layout: the released PhysTwin data. Each `*_findings` function lists everything in one file that the reader refuses (errors) or
that is not as released and harmless (warnings); `read` and `convert` raise the first error, `neuspring check-data`
prints them all. Of raw cases images are linked where the file system allows it, else copied; masks are put together from one image
per detection.
"""

from __future__ import annotations

import csv
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np

from neuspring.checks import examine
from neuspring.checks.case import FINAL_DATA, RELEASED_FRAME_RATE
from neuspring.config import Config, ScenarioRow
from neuspring.core.artifacts import Observations, Scenario
from neuspring.core.errors import InputError
from neuspring.core.files import load_json
from neuspring.core.findings import refuse
from neuspring.core.records import digest_file
from neuspring.data.unpickle import load_pickle


@cache
def released_cases() -> dict[str, dict[str, str]]:
    """The table of the 22 released cases: case -> column -> text, empty where unknown."""
    text = resources.files("neuspring.data").joinpath("tables", "phystwin22.csv").read_text(encoding="utf-8")
    return {row["case"]: row for row in csv.DictReader(text.splitlines())}


SPLIT, GT_TRACKS, METADATA = "split.json", "gt_track_3d.pkl", "metadata.json"
CALIBRATION = "calibrate.pkl"
FILES = (FINAL_DATA, SPLIT, GT_TRACKS, METADATA)
"""The files that the reader looks for in a processed case's folder."""
RAW_FILES = (METADATA, CALIBRATION, SPLIT, GT_TRACKS)
"""The files beside images that the importer looks for in a raw case's folder."""


def observe(row: ScenarioRow, path: Path, config: Config, output: Path) -> Observations:
    """See `neuspring.scenes.sources`."""
    return read(row, path)


def read(row: ScenarioRow, folder: Path) -> Observations:
    """Read one processed case from its `folder`.

    Uses final_data.pkl and split.json; gt_track_3d.pkl (else no tracks) and metadata.json (else 30 frames per second) where
    present. Meters, float32, world with -z up. Raises InputError naming file and key.
    """
    folder = Path(folder)
    data_path, split_path = folder / FINAL_DATA, folder / SPLIT
    data = load_pickle(data_path)
    refuse(examine("final data", data_path, data))
    frames = len(data["object_points"])
    split = load_json(split_path)
    refuse(examine("split", split_path, split, frames))
    used = [data_path, split_path]

    if (tracks := annotated(folder, frames)) is not None:
        used.append(folder / GT_TRACKS)
    frame_rate = RELEASED_FRAME_RATE
    if (folder / METADATA).exists():
        metadata = load_json(folder / METADATA)
        refuse(examine("metadata", folder / METADATA, metadata))
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


def has_images(case: Path) -> bool:
    """True where a case's folder holds what a capture with masks needs: images, masks and calibration."""
    files = all((Path(case) / name).is_file() for name in (METADATA, CALIBRATION))
    return files and all((Path(case) / kind).is_dir() for kind in ("color", "depth", "mask"))


def camera_count(case: Path) -> int:
    """Number of cameras that metadata.json declares. Raises InputError."""
    path = Path(case) / METADATA
    metadata = load_json(path)
    intrinsics = metadata.get("intrinsics") if isinstance(metadata, dict) else None
    if not isinstance(intrinsics, list) or not intrinsics:
        raise InputError(path, "intrinsics: a list of 3 x 3 matrices is required", type(intrinsics).__name__)
    return len(intrinsics)


def annotated(case: Path, frames: int) -> np.ndarray | None:
    """Annotated tracks [T, K, 3], m, if there are any. Raises InputError."""
    path = case / GT_TRACKS
    if not path.exists():
        return None
    tracks = load_pickle(path)
    refuse(examine("annotated tracks", path, tracks, frames))
    return np.asarray(tracks, dtype=float)


def train_end_of(case: Path, frames: int) -> int | None:
    """Training frames are [0, this), if split.json says so. Raises InputError."""
    path = case / SPLIT
    if not path.exists():
        return None
    split = load_json(path)
    refuse(examine("split", path, split, frames))
    return int(split["train"][1])
