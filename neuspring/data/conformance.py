"""Conformance checks 1 to 4 with the released PhysTwin data: sizes, topology, evaluator, deprojection.

They compare a case with its released results where these are present; a check that lacks its files says so in a note.
"""

from __future__ import annotations

import csv
import zipfile
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from neuspring.artifacts import Observations
from neuspring.config import ScenarioRow
from neuspring.data import phystwin
from neuspring.data.departure import Case, Departure, broken, note, unusual
from neuspring.data.unpickle import load_pickle
from neuspring.errors import InputError

DEPTH_GATE = (0.2, 1.5)
"""Camera depths that the released lifting keeps, m."""
DEPTH_SCALE = 1000.0
"""Depth units per metre."""
PUBLISHED = {"chamfer": 0.011579, "track_error": 0.022019}
"""Equal-case means over the future frames of the 22 released predictions, m."""
LARGEST = 1e30
"""No parameter comes near; also refuses infinity and NaN."""
SELF_COLLIDING = ("cloth", "package")
"""Released cases whose name holds one of these words use the cloth configuration."""
OPTIMAL_KEYS = (
    "global_spring_Y",
    "object_radius",
    "object_max_neighbours",
    "controller_radius",
    "controller_max_neighbours",
    "collide_elas",
    "collide_fric",
    "collide_object_elas",
    "collide_object_fric",
    "collision_dist",
    "drag_damping",
    "dashpot_damping",
)


def read_case(case: Case) -> Observations | None:
    """The case as the reader gives it; None where it refuses (its reasons are reported file by file)."""
    flag = any(word in case.name for word in SELF_COLLIDING)
    known = released_cases().get(case.name, {})
    row = ScenarioRow(
        scenario=case.name,
        source="phystwin",
        category=known.get("category", "unknown"),
        path=str(case.folder),
        self_collision=flag,
        ground=True,
    )
    try:
        return phystwin.read(row, case.folder)
    except InputError as error:
        if not any(str(error).startswith(f"{d.file}: {d.message}") for d in case.found):  # a reason that no file check gave
            case.found.append(Departure(case.folder, "error", str(error)))
        return None


@cache
def released_cases() -> dict[str, dict[str, str]]:
    """The table of the 22 released cases: case -> column -> text, empty where unknown."""
    text = resources.files("neuspring.data").joinpath("phystwin22.csv").read_text(encoding="utf-8")
    return {row["case"]: row for row in csv.DictReader(text.splitlines())}


def check_table(case: Case, observations: Observations) -> None:
    """Check 1, first half: sizes of a released case."""
    known = released_cases().get(case.name)
    if known is None:
        case.found.append(note(case.folder, "not one of the 22 released cases: the comparison of sizes is skipped"))
        return
    sizes = {
        "frames": observations.scenario.frame_count,
        "train_end": observations.scenario.train_end,
        "object_points": observations.object_points.shape[1],
        "nodes": len(observations.nodes),
    }
    path = case.folder / phystwin.FINAL_DATA
    for column, value in sizes.items():
        if known[column] and int(known[column]) != value:
            case.found.append(broken(path, column, f"the released case has {known[column]}", value))


def check_results(case: Case, observations: Observations) -> None:
    """Check 1, second half, and checks 2 and 3: released results of this case."""
    if case.root is None:
        case.found.append(
            note(case.folder, "no experiments folder is known for this case: conformance checks 1 (prediction) to 3 skipped")
        )
        return
    _check_prediction(case, observations, case.root / "experiments" / case.name / "inference.pkl")
    _check_topology(case, observations, case.root)


def _check_prediction(case: Case, observations: Observations, path: Path) -> None:
    if not path.exists():
        case.skip(path, "the checks of frame 0 (1) and of the evaluator (3) are")
        return
    positions = case.load(path, load_pickle)
    if positions is None:
        return
    wanted = (observations.scenario.frame_count, len(observations.nodes), 3)
    if not isinstance(positions, np.ndarray) or positions.dtype.kind != "f" or positions.shape != wanted:
        received = f"{positions.shape} {positions.dtype}" if isinstance(positions, np.ndarray) else type(positions).__name__
        case.found.append(broken(path, "", f"floating point positions of shape {wanted} are required", received))
        return
    if positions.dtype != np.float32:
        case.found.append(unusual(path, "", "the released dtype is float32", positions.dtype))
    positions = positions.astype(np.float32)
    different = np.flatnonzero((positions[0] != observations.nodes).any(axis=1))
    if len(different):
        rule = "frame 0 must equal [object_points[0] | surface_points | interior_points] in float32"
        largest = float(np.abs(positions[0] - observations.nodes).max())
        case.found.append(
            broken(path, "", rule, f"{len(different)} other nodes, first {different[0]}, largest difference {largest:.3g} m")
        )
    if not np.isfinite(positions).all():
        case.found.append(broken(path, "", "every coordinate must be finite"))
        return
    _evaluate(case, observations, positions, path)


def _evaluate(case: Case, observations: Observations, positions: np.ndarray, path: Path) -> None:
    """Check 3 for one case: mean metrics over the future frames."""
    from neuspring import metrics

    future = slice(observations.scenario.train_end, None)
    per_frame = {
        "chamfer": metrics.chamfer_per_frame(positions, observations),
        "track_error": metrics.track_error_per_frame(positions, observations),
    }
    for name, values in per_frame.items():
        usable = values[future][~np.isnan(values[future])]
        if len(usable):
            case.scores[name] = float(usable.mean())
            case.found.append(note(path, f"future {name} {case.scores[name]:.6f} m over {len(usable)} frames"))


def compare_published(folder: Path, cases: list[Case]) -> list[Departure]:
    """Check 3 over cases: the equal-case mean beside the published one."""
    found = []
    for name, published in PUBLISHED.items():
        values = [case.scores[name] for case in cases if name in case.scores]
        if len(values) > 1:
            mean = float(np.mean(values))
            whole = len(values) == len(released_cases())
            message = f"future {name}, equal-case mean {mean:.6f} m over {len(values)} cases; published {published} m over 22"
            # Published to six decimals; only the complete set can be held against it.
            differs = whole and abs(mean - published) > 1e-6
            found.append(unusual(folder, "", message + ": they differ") if differs else note(folder, message))
    return found


def _check_topology(case: Case, observations: Observations, root: Path) -> None:
    """Check 2: springs rebuilt from the released parameters against the released checkpoint."""
    parameters_path = root / "experiments_optimization" / case.name / "optimal_params.pkl"
    checkpoint_path = _best_checkpoint(root / "experiments" / case.name / "train")
    if not parameters_path.exists():
        case.skip(parameters_path, "the topology check (2) is")
        return
    parameters = case.load(parameters_path, load_pickle)
    if parameters is None:
        return
    found = _parameter_departures(parameters_path, parameters)
    case.found += found
    if checkpoint_path is None:
        case.skip(root / "experiments" / case.name / "train" / "best_*.pth", "the topology check (2) is")
        return
    counts = _checkpoint_counts(case, checkpoint_path)
    if counts is None or any(d.level == "error" for d in found):
        return
    _compare_topology(case, observations, parameters, checkpoint_path, counts)


def _best_checkpoint(folder: Path) -> Path | None:
    """The released best_{epoch}.pth, of the highest epoch if there are several."""
    numbered = [path for path in folder.glob("best_*.pth") if path.stem.removeprefix("best_").isdecimal()]
    return max(numbered, key=_epoch, default=None)


def _epoch(path: Path) -> int:
    return int(path.stem.removeprefix("best_"))


def _parameter_departures(path: Path, parameters: Any) -> list[Departure]:
    if not isinstance(parameters, dict):
        return [broken(path, "", "a dict of 12 numbers is required", type(parameters).__name__)]
    found = []
    for key in OPTIMAL_KEYS:
        value = parameters.get(key)
        if key not in parameters:
            found.append(broken(path, key, "this key is missing"))
        elif not isinstance(value, (int, float, np.integer, np.floating)) or not -LARGEST < value < LARGEST:
            found.append(broken(path, key, "a finite number is required", value))
        elif key.endswith("neighbours") and value != int(value):
            found.append(broken(path, key, "a whole number is required", value))
        elif key.endswith(("neighbours", "radius")) and value <= 0:
            found.append(broken(path, key, "a positive number is required", value))
    found += [unusual(path, str(key), "unknown key, not read") for key in parameters if key not in OPTIMAL_KEYS]
    return found


def _checkpoint_counts(case: Case, path: Path) -> tuple[int, int] | None:
    """(springs, object springs) of a checkpoint, or None with a departure."""
    import torch  # slow to import, and needed for this check alone

    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
        return len(stored["spring_Y"]), int(stored["num_object_springs"])
    except Exception as error:  # torch names no closed set of exceptions for damaged or refused files
        reason = str(error).partition("\n")[0]
        rule = "a checkpoint with spring_Y and num_object_springs is required (read with weights_only)"
        case.found.append(broken(path, "", rule, f"{type(error).__name__}: {reason}"))
        return None


def _compare_topology(
    case: Case, observations: Observations, parameters: dict[str, Any], checkpoint: Path, counts: tuple[int, int]
) -> None:
    from neuspring.topology import uniform_topology

    try:
        topology = uniform_topology(
            observations.nodes,
            observations.controller_points[0],
            float(parameters["object_radius"]),
            int(parameters["object_max_neighbours"]),
            float(parameters["controller_radius"]),
            int(parameters["controller_max_neighbours"]),
        )
    except InputError as error:
        case.found.append(Departure(checkpoint, "error", f"the springs cannot be rebuilt: {error}"))
        return
    rebuilt = (len(topology.springs), topology.object_spring_count)
    if rebuilt == counts:
        case.found.append(note(checkpoint, f"{counts[0]} springs ({counts[1]} between object nodes), as rebuilt"))
    else:
        rule = f"{rebuilt[0]} springs ({rebuilt[1]} between object nodes) are rebuilt from optimal_params.pkl"
        case.found.append(broken(checkpoint, "spring_Y", rule, f"{counts[0]} ({counts[1]})"))
    known = released_cases().get(case.name)
    if known is not None and int(known["springs"]) != counts[0]:
        case.found.append(broken(checkpoint, "spring_Y", f"the released case has {known['springs']} springs", counts[0]))
    if known is not None and int(known["best_epoch"]) != _epoch(checkpoint):
        case.found.append(unusual(checkpoint, "", f"the released best epoch is {known['best_epoch']}", _epoch(checkpoint)))


def check_deprojection(
    case: Case,
    data: dict[str, np.ndarray] | None,
    cameras: list[np.ndarray] | None,
    metadata: dict[str, Any] | None,
) -> None:
    """Check 4 (gotcha 1): which principal point the released 3D points were lifted with."""
    tracks_path, depth_path = case.folder / "cotracker" / "0.npz", case.folder / "depth" / "0" / "0.npy"
    if not (tracks_path.exists() and depth_path.exists()):
        case.skip(tracks_path.parent if not tracks_path.exists() else depth_path, "the deprojection check (4) is")
        return
    if data is None or cameras is None or metadata is None or not np.isfinite(data["object_points"][0]).all():
        case.found.append(
            note(tracks_path, "needs usable final_data.pkl, calibrate.pkl and metadata.json: the deprojection check (4) is skipped")
        )
        return
    pixels = case.load(tracks_path, _visible_pixels)
    depth = case.load(depth_path, _depth_image)
    if pixels is None or depth is None:
        return
    if depth.shape != tuple(reversed(metadata["WH"])):
        case.found.append(broken(depth_path, "", f"[height, width] must match WH = {metadata['WH']}", depth.shape))
        return
    camera = np.asarray(metadata["intrinsics"][0], dtype=np.float64)
    mirrored = camera.copy()
    mirrored[0, 2] = metadata["WH"][0] - camera[0, 2]
    observed = data["object_points"][0]
    distances = [_lift_distance(pixels, depth, matrix, cameras[0], observed) for matrix in (camera, mirrored)]
    if None in distances:
        case.found.append(note(tracks_path, "no visible track has a depth within the gate: the deprojection check (4) is skipped"))
        return
    true, mirror = (float(d) for d in distances if d is not None)
    better = "the true c_x" if true < mirror else "the mirrored W - c_x" if mirror < true else "neither"
    medians = f"{true:.6f} m with c_x, {mirror:.6f} m with W - c_x"
    message = f"deprojection: median distance to object_points[0] {medians}; {better} fits better"
    case.found.append(note(tracks_path, message))


def _lift_distance(
    pixels: np.ndarray, depth: np.ndarray, camera: np.ndarray, pose: np.ndarray, observed: np.ndarray
) -> float | None:
    """Median distance, m, from lifted `pixels` [Q, 2] (row, column) to their nearest observed point; None where none lifts."""
    height, width = depth.shape
    row, column = np.rint(pixels).astype(np.int64).T
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    row, column = row[inside], column[inside]
    z = depth[row, column] / DEPTH_SCALE
    gate = (z > DEPTH_GATE[0]) & (z < DEPTH_GATE[1])
    row, column, z = row[gate], column[gate], z[gate]
    if not len(z):
        return None
    rays = np.linalg.solve(camera, np.stack([column, row, np.ones_like(row)]).astype(np.float64))
    world = pose[:3, :3] @ (rays * z) + pose[:3, 3:]
    return float(np.median(cKDTree(observed).query(world.T)[0]))


def _visible_pixels(path: Path) -> np.ndarray:
    """Frame-0 pixels [Q, 2] (row, column) of the visible tracks. Raises InputError."""
    stored = _numpy(path)
    try:
        tracks, visible = stored["tracks"], stored["visibility"]
    except (KeyError, IndexError) as error:
        raise InputError(path, "arrays `tracks` and `visibility` are required", str(error)) from error
    if (
        tracks.ndim != 3
        or tracks.shape[2] != 2
        or visible.shape != tracks.shape[:2]
        or not len(tracks)
        or visible.dtype != np.bool_
    ):
        received = f"{tracks.shape} and {visible.shape} {visible.dtype}"
        raise InputError(path, "tracks [T, Q, 2] and bool visibility [T, Q] are required", received)
    pixels: np.ndarray = tracks[0][visible[0]].astype(np.float64)
    if not np.isfinite(pixels).all():
        raise InputError(path, "track pixels of frame 0 must be finite")
    return pixels


def _depth_image(path: Path) -> np.ndarray:
    """Depth of one frame [H, W], uint16. Raises InputError."""
    depth = _numpy(path)
    if not isinstance(depth, np.ndarray) or depth.ndim != 2 or depth.dtype != np.uint16:
        raise InputError(path, "a uint16 image [H, W] is required", getattr(depth, "dtype", type(depth).__name__))
    return depth


def _numpy(path: Path) -> Any:
    """An .npy array or the arrays of an .npz, without pickle. Raises InputError."""
    try:
        stored = np.load(path, allow_pickle=False)
        if isinstance(stored, np.ndarray):
            return stored
        with stored:
            return {name: stored[name] for name in stored.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(path, "this file must be a NumPy file without pickle", f"{type(error).__name__}: {error}") from error
