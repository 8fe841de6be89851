"""Files of a processed PhysTwin case: what its reader refuses (errors), and what is not as released and harmless (warnings)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.core.checks import Check
from neuspring.core.findings import Level
from neuspring.data.capture import intrinsics_findings, pose_findings

FINAL_DATA = "final_data.pkl"
RELEASED_FRAME_RATE = 30.0
"""Frames per second of every released recording; used where metadata.json is absent."""
MAX_FRAME_RATE = 1e6
BINARY_TOLERANCE = 1e-5
"""Allowed deviation from R^T R = 1 in a pickle of float64 products of OpenCV rotations."""
RELEASED_CONTROLLERS = 30
"""Controller points of every released case."""
Words = list[dict[str, Any]]


@dataclass(frozen=True)
class ArrayRule:
    """The rule for one array of a pickle. In its shape, names stand for sizes that agree within the file; digits are fixed."""

    key: str
    shape: tuple[str, ...]
    kind: str
    """NumPy's letter: f (finite floating point) or b (bool)."""
    required: bool = True
    """True where the reader uses it."""


CASE_ARRAYS = (
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


def wrong(key: str, rule: str, value: object = None, level: Level = "error") -> dict[str, Any]:
    """Words about a key: the rule that it breaks, and what was received."""
    return {"key": key, "text": rule if value is None else f"{rule}; received {value}", "level": level}


def odd(key: str, rule: str, value: object = None) -> dict[str, Any]:
    """The same as a warning."""
    return wrong(key, rule, value, "warning")


@dataclass(frozen=True, kw_only=True)
class Case:
    """One processed case: its place."""

    root: Path
    """The folder that the archives were unpacked in."""
    name: str
    loose: Path | None = None
    """Folder of a case that lies elsewhere. No released results are known for it."""

    @property
    def folder(self) -> Path:
        """The processed case."""
        return self.loose or self.root / "data" / "different_types" / self.name


def structure(data: Any) -> Words:
    """Faults of keys, types, shapes and dtypes of final_data.pkl. Without errors the content of the arrays can be looked at."""
    if not isinstance(data, dict):
        return [wrong("", "a dict of arrays is required", type(data).__name__)]
    keys = {rule.key for rule in CASE_ARRAYS} | set(IGNORED)
    findings = [odd(str(key), "unknown key, not read") for key in data if key not in keys]
    sizes: dict[str, int] = {}
    """The symbolic dimensions of the file."""
    for rule in CASE_ARRAYS:
        severity = wrong if rule.required else odd
        shape, value = f"[{', '.join(rule.shape)}]", data.get(rule.key)
        if rule.key not in data:
            findings.append(severity(rule.key, "this key is missing"))
        elif not isinstance(value, np.ndarray):
            findings.append(severity(rule.key, f"an array {shape} is required", type(value).__name__))
        elif value.ndim != len(rule.shape):
            findings.append(severity(rule.key, f"the shape must be {shape}", value.shape))
        else:
            for axis, (symbol, size) in enumerate(zip(rule.shape, value.shape, strict=True)):
                wanted = int(symbol) if symbol.isdigit() else sizes.setdefault(symbol, size)
                if size != wanted:
                    message = f"the shape must be {shape} with {wanted} entries along axis {axis}"
                    findings.append(severity(rule.key, message, value.shape))
            if value.dtype.kind != rule.kind:
                findings.append(severity(rule.key, f"the dtype must be {KIND_NAMES[rule.kind]}", value.dtype))
    return findings


def whole(data: Any) -> bool:
    """True where final_data.pkl has arrays of the right keys, shapes and dtypes, and there are some points."""
    return not any(one["level"] == "error" for one in structure(data)) and bool(data["object_visibilities"].size)


def values(data: Any) -> Words:
    """Finite coordinates, and the rules without which nothing can be simulated."""
    findings = Words()
    if not isinstance(data, dict):
        return findings
    for rule in CASE_ARRAYS:
        value = data.get(rule.key)
        if rule.kind != "f" or not isinstance(value, np.ndarray) or value.dtype.kind != "f" or value.ndim != len(rule.shape):
            continue
        if value.dtype != np.float64:
            findings.append(odd(rule.key, "the released dtype is float64", value.dtype))
        bad = np.argwhere(~np.isfinite(value))
        if len(bad):
            severity = wrong if rule.required else odd
            findings.append(severity(rule.key, "every coordinate must be finite", describe_bad(value, bad)))
    if any(one["level"] == "error" for one in [*findings, *structure(data)]):
        return findings
    frames, points = data["object_visibilities"].shape
    if points == 0:
        findings.append(wrong("object_points", "at least one tracked object point is required", "none"))
    if data["controller_points"].shape[1] == 0:
        findings.append(wrong("controller_points", "at least one controller point is required", "none"))
    if frames < 2:
        findings.append(wrong("object_points", "at least 2 frames are required", frames))
    hidden = np.flatnonzero(~data["object_visibilities"][0]) if frames else np.zeros(0, int)
    if len(hidden):
        needed = "every tracked point must be visible in frame 0, which is the rest state"
        findings.append(wrong("object_visibilities", needed, f"{len(hidden)} of {points} hidden, first: point {hidden[0]}"))
    return findings


def describe_bad(value: np.ndarray, bad: np.ndarray) -> str:
    """'nan at frame 3, point 17 (5 in all)' for rows `bad` of np.argwhere on a [T, K, 3] or [K, 3] array."""
    first = tuple(int(i) for i in bad[0])
    place = f"frame {first[0]}, point {first[1]}" if value.ndim == 3 else f"point {first[0]}"
    return f"{value[first]} at {place} ({len(bad)} in all)"


def motions(data: Any) -> Words:
    """Departures from the release that the reader accepts."""
    if not whole(data):
        return []
    findings = Words()
    points, visible, valid = data["object_points"], data["object_visibilities"], data["object_motions_valid"]
    moved = np.argwhere(~visible & (points != 0).any(axis=2))
    if len(moved):
        findings.append(odd("object_points", "(0, 0, 0) is expected where a point is invisible", place(moved)))
    below = np.argwhere(points[..., 2] > 0)
    if len(below):
        received = f"z up to {float(np.nanmax(points[..., 2])):.4g} m, {place(below)}"
        findings.append(odd("object_points", "z <= 0 (on or above the table) is expected", received))
    empty = np.flatnonzero(~visible.any(axis=1)).tolist()
    if empty:
        frames = ", ".join(map(str, empty[:8])) + (f", ... ({len(empty)} in all)" if len(empty) > 8 else "")
        rule = "a visible point in every frame is expected"
        findings.append(odd("object_visibilities", rule, f"none in frames {frames}"))
    if valid[-1].any():
        rule = "the last row has no next frame and must be all False"
        findings.append(odd("object_motions_valid", rule, f"{int(valid[-1].sum())} True"))
    unseen = np.argwhere(valid[:-1] & ~(visible[:-1] & visible[1:]))
    if len(unseen):
        rule = "a valid motion from t to t+1 requires the point to be visible in both frames"
        findings.append(wrong("object_motions_valid", rule, place(unseen)))
    rest = points[0]
    duplicates = len(rest) - len(np.unique(rest, axis=0))  # springs between them would have no length
    if duplicates:
        findings.append(odd("object_points", "the points of frame 0 are expected to differ", f"{duplicates} duplicates"))
    if not np.array_equal(rest[np.lexsort(rest.T[::-1])], rest, equal_nan=True):
        rule = "columns are expected in lexicographic order of their frame-0 coordinates"
        findings.append(odd("object_points", rule, "another order"))
    controllers = data["controller_points"].shape[1]
    if controllers != RELEASED_CONTROLLERS:
        findings.append(odd("controller_points", f"released cases have {RELEASED_CONTROLLERS} controllers", controllers))
    return findings


def place(rows: np.ndarray) -> str:
    """The first of some rows of frame and point, and their number."""
    return f"frame {rows[0][0]}, point {rows[0][1]} ({len(rows)} in all)"


def ranges(split: Any, frames: int) -> Words:
    """split.json against the number of frames: half-open ranges [start, end) inside [0, frames]."""
    if not isinstance(split, dict):
        return [wrong("", "a JSON object with train and test is required", type(split).__name__)]
    findings = []
    for key in ("train", "test"):
        value = split.get(key)
        if not (isinstance(value, list) and len(value) == 2 and all(type(v) is int for v in value)):
            received = value if key in split else "nothing"
            findings.append(wrong(key, "two whole numbers [start, end) are required", received))
        elif not 0 <= value[0] <= value[1] <= frames:
            findings.append(wrong(key, f"the range must lie within the {frames} frames of {FINAL_DATA}", value))
        elif key == "train" and value[1] < 2:
            findings.append(wrong(key, "at least one frame after frame 0 must be for training", value))
    if findings:
        return findings
    end = int(0.7 * frames)
    for key, wanted in (("train", [0, end]), ("test", [end, frames])):
        if split[key] != wanted:
            meaning = f"NeuSpring trains on [0, {split['train'][1]}) and predicts [{split['train'][1]}, {frames})"
            findings.append(odd(key, f"the released splits are {wanted} for {frames} frames; {meaning}", split[key]))
    if split.get("frame_len") != frames:
        findings.append(odd("frame_len", f"{FINAL_DATA} has {frames} frames", split.get("frame_len", "nothing")))
    return findings


def tracks_of(tracks: Any, frames: int | None) -> Words:
    """gt_track_3d.pkl: floating point [T, K, 3], NaN rows where not annotated. `frames` None skips the comparison of T."""
    if not isinstance(tracks, np.ndarray):
        return [wrong("", "an array [T, K, 3] is required", type(tracks).__name__)]
    if tracks.ndim != 3 or tracks.shape[2] != 3:
        return [wrong("", "the shape must be [T, K, 3]", tracks.shape)]
    if tracks.dtype.kind != "f":
        return [wrong("", "the dtype must be floating point", tracks.dtype)]
    findings = []
    if frames is not None and len(tracks) != frames:
        findings.append(wrong("", f"{FINAL_DATA} has {frames} frames", tracks.shape))
    if tracks.dtype != np.float64:
        findings.append(odd("", "the released dtype is float64", tracks.dtype))
    infinite = np.argwhere(np.isinf(tracks))
    if len(infinite):
        findings.append(wrong("", "coordinates must be finite, or NaN where not annotated", describe_bad(tracks, infinite)))
    missing = np.isnan(tracks)
    partial = np.argwhere(missing.any(axis=2) & ~missing.all(axis=2))
    if len(partial):
        findings.append(odd("", "a point is NaN in all three coordinates or in none", place(partial)))
    return findings


def frame_rate(metadata: Any) -> Words:
    """The only field of metadata.json that the reader uses: fps, a positive number; 30 where absent."""
    if not isinstance(metadata, dict):
        return [wrong("", "a JSON object is required", type(metadata).__name__)]
    fps = metadata.get("fps", RELEASED_FRAME_RATE)
    if type(fps) not in (int, float) or not 0 < fps < MAX_FRAME_RATE:
        return [wrong("fps", "a positive number of frames per second is required", fps)]
    if fps != RELEASED_FRAME_RATE:
        return [odd("fps", f"released recordings have {RELEASED_FRAME_RATE:g} frames per second", fps)]
    return []


def cameras_of(metadata: Any, cameras: int | None) -> Words:
    """Image size and intrinsics of metadata.json. `cameras` is the required number of cameras; None allows any but zero."""
    findings = Words()
    if not isinstance(metadata, dict):
        return findings
    size: Any = metadata.get("WH")
    has_size = isinstance(size, list) and len(size) == 2 and all(type(value) is int and value > 0 for value in size)
    if not has_size:
        findings.append(wrong("WH", "two positive whole numbers [width, height] are required", size))
    try:
        intrinsics = np.asarray(metadata.get("intrinsics"), dtype=np.float64)
    except (TypeError, ValueError):
        intrinsics = np.zeros(0)
    count = cameras or max(len(intrinsics) if intrinsics.ndim else 0, 1)
    if intrinsics.shape != (count, 3, 3) or not np.isfinite(intrinsics).all():
        rule = f"{cameras or 'one or more'} finite 3 x 3 matrices are required"
        return [*findings, wrong("intrinsics", rule, f"shape {intrinsics.shape}")]
    for index, matrix in enumerate(intrinsics):
        key = f"intrinsics, camera {index}"
        of_lens = intrinsics_findings(Path(), key, matrix, (size[0], size[1]) if has_size else None)
        findings += [wrong(key, one.text) for one in of_lens]
    return findings


def poses_of(poses: Any, cameras: int | None) -> Words:
    """The matrices of calibrate.pkl. `cameras` is the required number of cameras; None skips the comparison."""
    if not isinstance(poses, (list, tuple)) or (cameras is not None and len(poses) != cameras):
        received = f"{type(poses).__name__} of {len(poses)}" if isinstance(poses, (list, tuple)) else type(poses).__name__
        return [wrong("", f"a list of {cameras or ''} camera-to-world matrices is required".replace("  ", " "), received)]
    findings = []
    for index, pose in enumerate(poses):
        key = f"camera {index}"
        if not isinstance(pose, np.ndarray) or pose.shape != (4, 4) or pose.dtype.kind != "f":
            received = f"{pose.shape} {pose.dtype}" if isinstance(pose, np.ndarray) else type(pose).__name__
            findings.append(wrong(key, "a (4, 4) floating point matrix is required", received))
            continue
        if pose.dtype != np.float64:
            findings.append(odd(key, "the released dtype is float64", pose.dtype))
        findings += [wrong(key, one.text) for one in pose_findings(Path(), key, pose, BINARY_TOLERANCE)]
    return findings


# fmt: off
checks = (
    Check("arrays", "final data", structure, None, "error", "{text}", title="{key}"),
    Check("values", "final data", values, None, "error", "{text}", title="{key}"),
    Check("motions", "released data", motions, None, "warning", "{text}", title="{key}"),
    Check("split", "split", ranges, None, "error", "{text}", title="{key}"),
    Check("annotated tracks", "annotated tracks", tracks_of, None, "error", "{text}", title=""),
    Check("frame rate", "metadata", frame_rate, None, "error", "{text}", title="{key}"),
    Check("intrinsics", "lenses of metadata", cameras_of, None, "error", "{text}", title="{key}"),
    Check("poses", "calibration", poses_of, None, "error", "{text}", title="{key}"),
)
