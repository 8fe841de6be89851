"""Conformance checks 1 to 4 with the released PhysTwin data: sizes, topology, evaluator, deprojection.

They compare a case with its released results where these are present; a check that lacks its files says so in a note.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from neuspring.config import ScenarioRow
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.data import phystwin
from neuspring.data.capture import Camera
from neuspring.data.cases import released_cases
from neuspring.data.departure import Case, Departure, broken, note, unusual
from neuspring.data.released import (
    best_checkpoint,
    depth_image,
    gated_lift,
    mirrored,
    parameter_departures,
    read_checkpoint,
    visible_pixels,
)
from neuspring.data.unpickle import load_pickle

PUBLISHED = {"chamfer": 0.011579, "track_error": 0.022019}
"""Equal-case means over the future frames of the 22 released predictions, m."""
SELF_COLLIDING = ("cloth", "package")
"""Released cases whose name holds one of these words use the cloth configuration."""


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
    from neuspring.scores import metrics

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
    checkpoint_path = best_checkpoint(root / "experiments" / case.name / "train")
    if not parameters_path.exists():
        case.skip(parameters_path, "the topology check (2) is")
        return
    parameters = case.load(parameters_path, load_pickle)
    if parameters is None:
        return
    found = parameter_departures(parameters_path, parameters)
    case.found += found
    if checkpoint_path is None:
        case.skip(root / "experiments" / case.name / "train" / "best_*.pth", "the topology check (2) is")
        return
    checkpoint = case.load(checkpoint_path, read_checkpoint)
    if checkpoint is None or any(d.level == "error" for d in found):
        return
    counts = (len(checkpoint.stiffness), checkpoint.object_springs)
    _compare_topology(case, observations, parameters, checkpoint_path, counts)


def _compare_topology(
    case: Case, observations: Observations, parameters: dict[str, Any], checkpoint: Path, counts: tuple[int, int]
) -> None:
    from neuspring.twin.topology import uniform_topology

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
    epoch = int(checkpoint.stem.removeprefix("best_"))
    if known is not None and int(known["best_epoch"]) != epoch:
        case.found.append(unusual(checkpoint, "", f"the released best epoch is {known['best_epoch']}", epoch))


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
    pixels = case.load(tracks_path, visible_pixels)
    depth = case.load(depth_path, depth_image)
    if pixels is None or depth is None:
        return
    if depth.shape != tuple(reversed(metadata["WH"])):
        case.found.append(broken(depth_path, "", f"[height, width] must match WH = {metadata['WH']}", depth.shape))
        return
    width, height = metadata["WH"]
    camera = Camera("0", width, height, np.asarray(metadata["intrinsics"][0], dtype=np.float64), cameras[0])
    observed = data["object_points"][0]
    distances = [_lift_distance(pixels, depth, used, observed) for used in (camera, mirrored(camera))]
    if None in distances:
        case.found.append(note(tracks_path, "no visible track has a depth within the gate: the deprojection check (4) is skipped"))
        return
    true, mirror = (float(d) for d in distances if d is not None)
    better = "the true c_x" if true < mirror else "the mirrored W - c_x" if mirror < true else "neither"
    medians = f"{true:.6f} m with c_x, {mirror:.6f} m with W - c_x"
    message = f"deprojection: median distance to object_points[0] {medians}; {better} fits better"
    case.found.append(note(tracks_path, message))


def _lift_distance(pixels: np.ndarray, depth: np.ndarray, camera: Camera, observed: np.ndarray) -> float | None:
    """Median distance, m, from lifted `pixels` [Q, 2] (row, column) to their nearest observed point; None where none lifts."""
    lifted = gated_lift(camera, pixels, depth)
    return float(np.median(cKDTree(observed).query(lifted)[0])) if len(lifted) else None
