"""Files of a processed PhysTwin case: what its reader refuses (errors), and what is not as released and harmless (warnings)."""

from __future__ import annotations

from collections.abc import Iterator
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
Words = dict[str, Any]
Found = Iterator[Words]


@dataclass(frozen=True)
class ArrayRule:
    """The rule for one array of a pickle. In its shape, names stand for sizes that agree within the file; digits are fixed."""

    key: str
    shape: tuple[str, ...]
    kind: str
    """NumPy's letter: f (finite floating point) or b (bool)."""
    required: bool = True
    """True where the reader uses it."""

    def broken(self, rule: str, value: object = None) -> Words:
        """Words about the array: an error where it is required, else a warning."""
        return (wrong if self.required else odd)(self.key, rule, value)


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


def wrong(key: str, rule: str, value: object = None, level: Level = "error") -> Words:
    """Words about a key: the rule that it breaks, and what was received."""
    return {"key": key, "text": rule if value is None else f"{rule}; received {value}", "level": level}


def odd(key: str, rule: str, value: object = None) -> Words:
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


def structure(data: Any) -> Found:
    """Faults of keys, types, shapes and dtypes of final_data.pkl. Without errors the content of the arrays can be looked at."""
    if not isinstance(data, dict):
        yield wrong("", "a dict of arrays is required", type(data).__name__)
        return
    keys = {rule.key for rule in CASE_ARRAYS} | set(IGNORED)
    yield from (odd(str(key), "unknown key, not read") for key in data if key not in keys)
    sizes: dict[str, int] = {}
    """The symbolic dimensions of the file."""
    for rule in CASE_ARRAYS:
        shape, value = f"[{', '.join(rule.shape)}]", data.get(rule.key)
        if rule.key not in data:
            yield rule.broken("this key is missing")
        elif not isinstance(value, np.ndarray):
            yield rule.broken(f"an array {shape} is required", type(value).__name__)
        elif value.ndim != len(rule.shape):
            yield rule.broken(f"the shape must be {shape}", value.shape)
        else:
            for axis, (symbol, size) in enumerate(zip(rule.shape, value.shape, strict=True)):
                wanted = int(symbol) if symbol.isdigit() else sizes.setdefault(symbol, size)
                if size != wanted:
                    yield rule.broken(f"the shape must be {shape} with {wanted} entries along axis {axis}", value.shape)
            if value.dtype.kind != rule.kind:
                yield rule.broken(f"the dtype must be {KIND_NAMES[rule.kind]}", value.dtype)


def whole(data: Any) -> bool:
    """True where final_data.pkl has arrays of the right keys, shapes and dtypes, and there are some points."""
    return not any(one["level"] == "error" for one in structure(data)) and bool(data["object_visibilities"].size)


def values(data: Any) -> list[Words]:
    """Finite coordinates, and the rules without which nothing can be simulated."""
    findings = list[Words]()
    for rule in CASE_ARRAYS if isinstance(data, dict) else ():
        value = data.get(rule.key)
        if rule.kind != "f" or not isinstance(value, np.ndarray) or value.dtype.kind != "f" or value.ndim != len(rule.shape):
            continue
        if value.dtype != np.float64:
            findings.append(odd(rule.key, "the released dtype is float64", value.dtype))
        if len(bad := np.argwhere(~np.isfinite(value))):
            findings.append(rule.broken("every coordinate must be finite", describe_bad(value, bad)))
    if any(one["level"] == "error" for one in [*findings, *structure(data)]):
        return findings
    frames, points = data["object_visibilities"].shape
    hidden = np.flatnonzero(~data["object_visibilities"][0]) if frames else np.zeros(0, int)
    required = (
        (points > 0, "object_points", "at least one tracked object point is required", "none"),
        (data["controller_points"].shape[1] > 0, "controller_points", "at least one controller point is required", "none"),
        (frames > 1, "object_points", "at least 2 frames are required", frames),
        (
            not len(hidden),
            "object_visibilities",
            "every tracked point must be visible in frame 0, which is the rest state",
            f"{len(hidden)} of {points} hidden, first: point {hidden.min(initial=points)}",
        ),
    )
    return findings + [wrong(key, rule, received) for there, key, rule, received in required if not there]


def describe_bad(value: np.ndarray, bad: np.ndarray) -> str:
    """'nan at frame 3, point 17 (5 in all)' for rows `bad` of np.argwhere on a [T, K, 3] or [K, 3] array."""
    first = tuple(int(i) for i in bad[0])
    place = f"frame {first[0]}, point {first[1]}" if value.ndim == 3 else f"point {first[0]}"
    return f"{value[first]} at {place} ({len(bad)} in all)"


def motions(data: Any) -> Found:
    """Departures from the release that the reader accepts."""
    if not whole(data):
        return
    points, visible, valid = data["object_points"], data["object_visibilities"], data["object_motions_valid"]
    if len(moved := np.argwhere(~visible & (points != 0).any(axis=2))):
        yield odd("object_points", "(0, 0, 0) is expected where a point is invisible", place(moved))
    if len(below := np.argwhere(points[..., 2] > 0)):
        received = f"z up to {float(np.nanmax(points[..., 2])):.4g} m, {place(below)}"
        yield odd("object_points", "z <= 0 (on or above the table) is expected", received)
    if empty := np.flatnonzero(~visible.any(axis=1)).tolist():
        frames = ", ".join(map(str, empty[:8])) + (f", ... ({len(empty)} in all)" if len(empty) > 8 else "")
        yield odd("object_visibilities", "a visible point in every frame is expected", f"none in frames {frames}")
    if last := int(valid[-1].sum()):
        yield odd("object_motions_valid", "the last row has no next frame and must be all False", f"{last} True")
    if len(unseen := np.argwhere(valid[:-1] & ~(visible[:-1] & visible[1:]))):
        rule = "a valid motion from t to t+1 requires the point to be visible in both frames"
        yield wrong("object_motions_valid", rule, place(unseen))
    rest = points[0]
    if duplicates := len(rest) - len(np.unique(rest, axis=0)):  # springs between them would have no length
        yield odd("object_points", "the points of frame 0 are expected to differ", f"{duplicates} duplicates")
    if not np.array_equal(rest[np.lexsort(rest.T[::-1])], rest, equal_nan=True):
        yield odd("object_points", "columns are expected in lexicographic order of their frame-0 coordinates", "another order")
    if (controllers := data["controller_points"].shape[1]) != RELEASED_CONTROLLERS:
        yield odd("controller_points", f"released cases have {RELEASED_CONTROLLERS} controllers", controllers)


def place(rows: np.ndarray) -> str:
    """The first of some rows of frame and point, and their number."""
    return f"frame {rows[0][0]}, point {rows[0][1]} ({len(rows)} in all)"


def ranges(split: Any, frames: int) -> list[Words]:
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
    meaning = f"NeuSpring trains on [0, {split['train'][1]}) and predicts [{split['train'][1]}, {frames})"
    for key, wanted in (("train", [0, end]), ("test", [end, frames])):
        if split[key] != wanted:
            findings.append(odd(key, f"the released splits are {wanted} for {frames} frames; {meaning}", split[key]))
    if split.get("frame_len") != frames:
        findings.append(odd("frame_len", f"{FINAL_DATA} has {frames} frames", split.get("frame_len", "nothing")))
    return findings


def tracks_of(tracks: Any, frames: int | None) -> Found:
    """gt_track_3d.pkl: floating point [T, K, 3], NaN rows where not annotated. `frames` None skips the comparison of T."""
    if not isinstance(tracks, np.ndarray):
        yield wrong("", "an array [T, K, 3] is required", type(tracks).__name__)
    elif tracks.ndim != 3 or tracks.shape[2] != 3:
        yield wrong("", "the shape must be [T, K, 3]", tracks.shape)
    elif tracks.dtype.kind != "f":
        yield wrong("", "the dtype must be floating point", tracks.dtype)
    else:
        if frames is not None and len(tracks) != frames:
            yield wrong("", f"{FINAL_DATA} has {frames} frames", tracks.shape)
        if tracks.dtype != np.float64:
            yield odd("", "the released dtype is float64", tracks.dtype)
        if len(infinite := np.argwhere(np.isinf(tracks))):
            yield wrong("", "coordinates must be finite, or NaN where not annotated", describe_bad(tracks, infinite))
        missing = np.isnan(tracks)
        if len(partial := np.argwhere(missing.any(axis=2) & ~missing.all(axis=2))):
            yield odd("", "a point is NaN in all three coordinates or in none", place(partial))


def frame_rate(metadata: Any) -> Words | None:
    """The only field of metadata.json that the reader uses: fps, a positive number; 30 where absent."""
    if not isinstance(metadata, dict):
        return wrong("", "a JSON object is required", type(metadata).__name__)
    fps = metadata.get("fps", RELEASED_FRAME_RATE)
    if type(fps) not in (int, float) or not 0 < fps < MAX_FRAME_RATE:
        return wrong("fps", "a positive number of frames per second is required", fps)
    rule = f"released recordings have {RELEASED_FRAME_RATE:g} frames per second"
    return None if fps == RELEASED_FRAME_RATE else odd("fps", rule, fps)


def cameras_of(metadata: Any, cameras: int | None) -> Found:
    """Image size and intrinsics of metadata.json. `cameras` is the required number of cameras; None allows any but zero."""
    if not isinstance(metadata, dict):
        return
    size: Any = metadata.get("WH")
    has_size = isinstance(size, list) and len(size) == 2 and all(type(value) is int and value > 0 for value in size)
    if not has_size:
        yield wrong("WH", "two positive whole numbers [width, height] are required", size)
    try:
        intrinsics = np.asarray(metadata.get("intrinsics"), dtype=np.float64)
    except (TypeError, ValueError):
        intrinsics = np.zeros(0)
    count = cameras or max(len(intrinsics) if intrinsics.ndim else 0, 1)
    if intrinsics.shape != (count, 3, 3) or not np.isfinite(intrinsics).all():
        yield wrong("intrinsics", f"{cameras or 'one or more'} finite 3 x 3 matrices are required", f"shape {intrinsics.shape}")
        return
    for index, matrix in enumerate(intrinsics):
        key = f"intrinsics, camera {index}"
        of_lens = intrinsics_findings(Path(), key, matrix, (size[0], size[1]) if has_size else None)
        yield from (wrong(key, one.text) for one in of_lens)


def poses_of(poses: Any, cameras: int | None) -> Found:
    """The matrices of calibrate.pkl. `cameras` is the required number of cameras; None skips the comparison."""
    if not isinstance(poses, (list, tuple)) or (cameras is not None and len(poses) != cameras):
        received = f"{type(poses).__name__} of {len(poses)}" if isinstance(poses, (list, tuple)) else type(poses).__name__
        yield wrong("", f"a list of {cameras or ''} camera-to-world matrices is required".replace("  ", " "), received)
        return
    for index, pose in enumerate(poses):
        key = f"camera {index}"
        if not isinstance(pose, np.ndarray) or pose.shape != (4, 4) or pose.dtype.kind != "f":
            received = f"{pose.shape} {pose.dtype}" if isinstance(pose, np.ndarray) else type(pose).__name__
            yield wrong(key, "a (4, 4) floating point matrix is required", received)
            continue
        if pose.dtype != np.float64:
            yield odd(key, "the released dtype is float64", pose.dtype)
        yield from (wrong(key, one.text) for one in pose_findings(Path(), key, pose, BINARY_TOLERANCE))


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
