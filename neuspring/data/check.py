"""`neuspring check-data`: every departure of a data set from its described layout, and the conformance checks 1 to 4.

Nothing here raises for bad content; a check that lacks its files says so in a note.
"""

from __future__ import annotations

from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.core.errors import InputError
from neuspring.data import mocap, phystwin
from neuspring.data.check_capture import check_capture, is_capture
from neuspring.data.departure import Case, Departure, broken, note, unusual
from neuspring.data.json_file import load_json
from neuspring.data.unpickle import load_pickle
from neuspring.scores.released import conformance

__all__ = ["Departure", "check", "render"]

CONTROLLERS = 30
"""Controller points of every released case."""
RIGID_TOLERANCE = 1e-5
"""Calibration matrices are float64 products of OpenCV rotations; 1e-5 leaves room for text round trips."""


def check(folder: Path) -> list[Departure]:
    """Check `folder`: a capture or a folder of them, a processed case, a folder of cases, a root with data/different_types, or
    cable recordings (folder or .pkl file).

    Reports every departure. Raises InputError only if `folder` does not exist or holds no data that we know.
    """
    folder = Path(folder)
    if folder.is_file():
        return mocap.check_mocap(folder)
    if not folder.is_dir():
        raise InputError(folder, "a folder or file to check is required", "nothing there")
    captures = [path for path in (folder, *_subfolders(folder)) if is_capture(path)]
    if captures:
        return [departure for path in captures for departure in check_capture(path)]
    paths, root = _find_cases(folder)
    if not paths and root is None:
        return _check_recordings(folder)
    if not paths:
        raise InputError(folder, "at least one case folder is required", "none")
    cases = [Case(path, root) for path in paths]
    for case in cases:
        _check_case(case)
    return [departure for case in cases for departure in case.found] + conformance.compare_published(folder, cases)


def render(departures: list[Departure]) -> str:
    """Departures as text, grouped by file, ending in 'N errors, N warnings'."""
    ordered = sorted(departures, key=lambda d: str(d.file))
    lines = []
    for file, group in groupby(ordered, key=lambda d: d.file):
        lines.append(str(file))
        lines += [f"  {d.level:8} {d.message}" for d in group]
    counts = [sum(d.level == level for d in departures) for level in ("error", "warning")]
    total = ", ".join(f"{n} {word}{'' if n == 1 else 's'}" for n, word in zip(counts, ("error", "warning"), strict=True))
    return "\n".join([*lines, total])


def _is_case(folder: Path) -> bool:
    return (folder / phystwin.FINAL_DATA).exists() or (folder / phystwin.SPLIT).exists()


def _find_cases(folder: Path) -> tuple[list[Path], Path | None]:
    """Case folders in or below `folder`, and the root that their results belong to."""
    below = folder / "data" / "different_types"
    if below.is_dir():
        return _subfolders(below), folder
    cases = [folder] if _is_case(folder) else [path for path in _subfolders(folder) if _is_case(path)]
    around = (folder.parent if cases == [folder] else folder).resolve()
    known_root = around.name == "different_types" and around.parent.name == "data"
    return cases, around.parent.parent if known_root else None


def _subfolders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))


def _check_recordings(folder: Path) -> list[Departure]:
    files = sorted(folder.rglob("*.pkl"))
    if not files:
        raise InputError(
            folder,
            "a case with final_data.pkl, a folder of cases, a root with data/different_types, or cable recordings is required",
            "none of them",
        )
    return [departure for file in files for departure in mocap.check_mocap(file)]


def _check_case(case: Case) -> None:
    data = _check_final_data(case)
    frames = None if data is None else len(data["object_points"])
    _check_split(case, frames)
    _check_tracks(case, frames)
    cameras = _check_calibration(case)
    metadata = _check_metadata(case, frames)
    conformance.check_deprojection(case, data, cameras, metadata)
    observations = None if data is None else conformance.read_case(case)
    if observations is not None:
        conformance.check_table(case, observations)
        conformance.check_results(case, observations)
    else:
        case.found.append(note(case.folder, "the reader refuses this case: conformance checks 1 to 3 skipped"))


# --- the processed case, file by file -------------------------------------------------------------------------------------


def _check_final_data(case: Case) -> dict[str, np.ndarray] | None:
    """final_data.pkl. Returns its arrays if they have the right keys, shapes and dtypes."""
    path = case.folder / phystwin.FINAL_DATA
    data = case.load(path, load_pickle)
    if data is None:
        return None
    found = phystwin.final_data_departures(path, data)
    case.found += found
    if not _has_structure(data):
        return None
    case.found += _invisible_departures(path, data)
    case.found += _motion_departures(path, data)
    case.found += _rest_state_departures(path, data)
    controllers = data["controller_points"].shape[1]
    if controllers != CONTROLLERS:
        case.found.append(unusual(path, "controller_points", f"released cases have {CONTROLLERS} controllers", controllers))
    return dict(data)


def _has_structure(data: Any) -> bool:
    """Whether the arrays that the reader uses have agreeing shapes and kinds, so that their content can be looked at."""
    if not isinstance(data, dict) or any(rule.required and rule.key not in data for rule in phystwin.ARRAYS):
        return False
    sizes: dict[str, int] = {}
    for rule in phystwin.ARRAYS:
        if not rule.required:
            continue
        value = data[rule.key]
        if not isinstance(value, np.ndarray) or value.dtype.kind != rule.kind or value.ndim != len(rule.shape):
            return False
        if any(n != (int(s) if s.isdigit() else sizes.setdefault(s, n)) for s, n in zip(rule.shape, value.shape, strict=True)):
            return False
    return sizes["T"] > 0 and sizes["No"] > 0


def _invisible_departures(path: Path, data: dict[str, np.ndarray]) -> list[Departure]:
    points, visible = data["object_points"], data["object_visibilities"]
    found = []
    moved = np.argwhere(~visible & (points != 0).any(axis=2))
    if len(moved):
        found.append(unusual(path, "object_points", "(0, 0, 0) is expected where a point is invisible", _place(moved)))
    below = np.argwhere(points[..., 2] > 0)
    if len(below):
        depth = float(np.nanmax(points[..., 2]))
        found.append(
            unusual(path, "object_points", "z <= 0 (on or above the table) is expected", f"z up to {depth:.4g} m, {_place(below)}")
        )
    empty = np.flatnonzero(~visible.any(axis=1))
    if len(empty):
        found.append(
            unusual(path, "object_visibilities", "a visible point in every frame is expected", f"none in frames {_list(empty)}")
        )
    return found


def _motion_departures(path: Path, data: dict[str, np.ndarray]) -> list[Departure]:
    visible, valid = data["object_visibilities"], data["object_motions_valid"]
    key, found = "object_motions_valid", []
    if valid[-1].any():
        found.append(unusual(path, key, "the last row has no next frame and must be all False", f"{int(valid[-1].sum())} True"))
    unseen = np.argwhere(valid[:-1] & ~(visible[:-1] & visible[1:]))
    if len(unseen):
        rule = "a valid motion from t to t+1 requires the point to be visible in both frames"
        found.append(broken(path, key, rule, _place(unseen)))
    return found


def _rest_state_departures(path: Path, data: dict[str, np.ndarray]) -> list[Departure]:
    """Duplicates and order of the frame-0 points. Duplicates would make springs without length."""
    rest = data["object_points"][0]
    key, found = "object_points", []
    duplicates = len(rest) - len(np.unique(rest, axis=0))
    if duplicates:
        found.append(unusual(path, key, "the points of frame 0 are expected to differ", f"{duplicates} duplicates"))
    order = np.lexsort(rest.T[::-1])
    if not np.array_equal(rest[order], rest, equal_nan=True):
        found.append(
            unusual(path, key, "columns are expected in lexicographic order of their frame-0 coordinates", "another order")
        )
    return found


def _place(rows: np.ndarray) -> str:
    return f"frame {rows[0][0]}, point {rows[0][1]} ({len(rows)} in all)"


def _list(values: np.ndarray, most: int = 8) -> str:
    return ", ".join(str(int(v)) for v in values[:most]) + (f", ... ({len(values)} in all)" if len(values) > most else "")


def _check_split(case: Case, frames: int | None) -> None:
    path = case.folder / phystwin.SPLIT
    split = case.load(path, load_json)
    if split is None:
        return
    if frames is None:
        case.found.append(note(path, "needs the number of frames of final_data.pkl: the check of the split is skipped"))
    else:
        case.found += phystwin.split_departures(path, split, frames)


def _check_tracks(case: Case, frames: int | None) -> None:
    path = case.folder / phystwin.TRACKS
    if not path.exists():
        case.skip(path, "annotated tracks and the track error are")
        return
    tracks = case.load(path, load_pickle)
    if tracks is not None:
        case.found += phystwin.tracks_departures(path, tracks, frames)


def _check_calibration(case: Case) -> list[np.ndarray] | None:
    """calibrate.pkl: three rigid camera-to-world matrices. Returned if usable."""
    path = case.folder / "calibrate.pkl"
    if not path.exists():
        case.skip(path, "the calibration check is")
        return None
    cameras = case.load(path, load_pickle)
    if cameras is None:
        return None
    found = _calibration_departures(path, cameras)
    case.found += found
    return None if any(d.level == "error" for d in found) else list(cameras)


def _calibration_departures(path: Path, cameras: Any) -> list[Departure]:
    if not isinstance(cameras, (list, tuple)) or len(cameras) != 3:
        size = f" of {len(cameras)}" if isinstance(cameras, (list, tuple)) else ""
        return [broken(path, "", "a list of 3 camera-to-world matrices is required", f"{type(cameras).__name__}{size}")]
    found = []
    for index, pose in enumerate(cameras):
        where = f"camera {index}"
        if not isinstance(pose, np.ndarray) or pose.shape != (4, 4) or pose.dtype.kind != "f":
            received = f"{pose.shape} {pose.dtype}" if isinstance(pose, np.ndarray) else type(pose).__name__
            found.append(broken(path, where, "a (4, 4) floating point matrix is required", received))
            continue
        if pose.dtype != np.float64:
            found.append(unusual(path, where, "the released dtype is float64", pose.dtype))
        deviation = _rigid_deviation(pose)
        if not deviation <= RIGID_TOLERANCE:
            rule = f"the matrix must be rigid (rotation, translation, last row 0 0 0 1) within {RIGID_TOLERANCE}"
            found.append(broken(path, where, rule, f"a deviation of {deviation:.3g}"))
    return found


def _rigid_deviation(pose: np.ndarray) -> float:
    """Largest entry of R Rt - 1, last row - (0, 0, 0, 1) and det R - 1; NaN where the matrix is not finite."""
    if not np.isfinite(pose).all():
        return float("nan")
    rotation = pose[:3, :3]
    parts = (rotation @ rotation.T - np.eye(3), pose[3] - np.array([0.0, 0.0, 0.0, 1.0]), np.array([np.linalg.det(rotation) - 1]))
    return max(float(np.abs(part).max()) for part in parts)


def _check_metadata(case: Case, frames: int | None) -> dict[str, Any] | None:
    """metadata.json. Returned if its intrinsics and image size are usable."""
    path = case.folder / phystwin.METADATA
    if not path.exists():
        case.skip(path, "the check of intrinsics and frame rate is")
        return None
    metadata = case.load(path, load_json)
    if metadata is None:
        return None
    case.found += phystwin.frame_rate_departures(path, metadata)
    if not isinstance(metadata, dict):
        return None
    if "fps" not in metadata:
        case.found.append(unusual(path, "fps", "missing; 30 frames per second are assumed"))
    if frames is not None and metadata.get("frame_num", frames) != frames:
        case.found.append(unusual(path, "frame_num", f"{phystwin.FINAL_DATA} has {frames} frames", metadata["frame_num"]))
    found = _camera_departures(path, metadata)
    case.found += found
    return metadata if not found else None


def _camera_departures(path: Path, metadata: dict[str, Any]) -> list[Departure]:
    found = []
    size = metadata.get("WH")
    if not (isinstance(size, list) and len(size) == 2 and all(type(n) is int and n > 0 for n in size)):
        found.append(broken(path, "WH", "two positive whole numbers [width, height] are required", size))
    try:
        intrinsics = np.asarray(metadata.get("intrinsics"), dtype=np.float64)
    except (TypeError, ValueError):
        intrinsics = np.zeros(0)
    if intrinsics.shape != (3, 3, 3) or not np.isfinite(intrinsics).all():
        found.append(broken(path, "intrinsics", "three finite 3x3 matrices are required", f"shape {intrinsics.shape}"))
        return found
    form = np.array([[False, True, False], [True, False, False], [True, True, False]])  # entries that must be 0
    wrong = (intrinsics[:, form] != 0).any() or (intrinsics[:, 2, 2] != 1).any() or (intrinsics[:, [0, 1], [0, 1]] <= 0).any()
    if wrong:
        found.append(broken(path, "intrinsics", "each matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0"))
    return found
