"""Findings about a data set: its layout, file by file, and a capture against what a scene on a table looks like.
Nothing here raises for bad content.

What cannot work is an error, what is only unusual a warning with the next move; see `plausible`. `neuspring check-data` adds
the comparison with the released results: `neuspring.extensions.released.run`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.core.artifacts import up_sign
from neuspring.core.errors import InputError
from neuspring.core.files import load_json
from neuspring.core.findings import Finding, broken, note, refusal, unusual
from neuspring.data import mocap, phystwin, plausible
from neuspring.data.capture import CAPTURE, NODES, OBJECT, POINTS, Capture, Description, description_findings, read_description
from neuspring.data.intake.depth import FAR, FASTEST, NEAR, SLOWEST, cloud, planes
from neuspring.data.points import look
from neuspring.data.released import Released, parameter_findings, prediction_findings, read_checkpoint
from neuspring.data.unpickle import load_pickle

INSIDE, INSIDE_SHARE = 0.01, 0.05
"""m, and share of the object's points: deeper in an obstacle than depth cameras err, they are inside."""
LEAST_AROUND = 0.1
"""Share of the image that must have depth, beside object and hands, before the table is looked for."""


@dataclass
class Inspection:
    """A folder under inspection and its findings so far."""

    folder: Path
    findings: list[Finding] = field(default_factory=list)

    def load(self, path: Path, reader: Callable[[Path], Any]) -> Any:
        """The content of `path`, or None (with a finding) if it is missing or damaged."""
        try:
            return reader(path)
        except InputError as error:
            self.findings.append(refusal(error))
            return None

    def load_optional(self, path: Path, reader: Callable[[Path], Any], skipped: str) -> Any:
        """As `load`, with a note if `path` is missing: what is therefore `skipped`, with its verb ("the check is")."""
        if path.exists():
            return self.load(path, reader)
        self.findings.append(note(path, f"not found: {skipped} skipped"))
        return None


def check_capture(folder: Path) -> list[Finding]:
    """Description, calibration, every image, masks of frame 0, tracks, marked points."""
    case, path = Inspection(folder), folder / CAPTURE
    description = case.load(path, read_description)
    if description is None:
        return case.findings
    case.findings += description_findings(path, description)
    if not SLOWEST <= description.frame_rate <= FASTEST:  # Speeds and forces of the twin scale with it.
        rule = f"frames per second at which it was filmed are required, {SLOWEST:g} to {FASTEST:g}"
        case.findings.append(broken(path, "frame_rate", rule, f"{description.frame_rate:g}"))
    capture = Capture(folder, description)
    case.findings += plausible.category_findings(path, description.category)
    calibrated = not any(d.level == "error" for d in case.findings)
    grips = np.zeros(capture.frame_count, int)
    samples = {name: _check_camera(case, capture, name, calibrated, grips) for name in capture.cameras}
    case.findings += plausible.grip_findings(folder, grips, description.frame_rate)
    if calibrated and len(samples) > 1:
        first = {name: found[0].depth for name, found in samples.items() if 0 in found}
        case.findings += plausible.view_findings(path, capture.cameras, first, description.up)
    case.findings += look(capture)[1]
    for name in capture.cameras:
        case.load(folder / POINTS, lambda _, name=name: capture.points(name))  # type: ignore[misc]
    if capture.cameras and not description.masks:
        message = f"no masks yet (masks: false). Draw them: `neuspring annotate {folder}`; then check again"
        case.findings.append(note(path, message))
    return case.findings


def _at(file: Path, findings: Iterable[Finding]) -> list[Finding]:
    """Findings about the content of `file`."""
    return [replace(one, where=str(file), name=f"{one.where}: {one.name}") for one in findings]


def _check_camera(
    case: Inspection, capture: Capture, name: str, calibrated: bool, grips: np.ndarray
) -> dict[int, plausible.Sample]:
    """Check every image of a camera, and a few frames against the world; returns these. `grips` [T] counts hands at the object."""
    view = capture.cameras[name]
    depths, shown = [], plausible.Shown(capture.frame_count, (view.width, view.height))
    samples: dict[int, plausible.Sample] = {}
    refused: dict[str, list[Finding]] = {}
    wanted = plausible.sampled(capture.frame_count)
    for frame in range(capture.frame_count):
        if not capture.has(name, frame):
            continue
        try:
            color, depth = capture.color(name, frame), capture.depth(name, frame)
            if capture.has_depth:
                depths.append(float(np.median(depth[depth > 0])) if (depth > 0).any() else np.nan)
            mask = np.zeros(depth.shape, np.uint8)
            if capture.description.masks:
                mask = capture.mask(name, frame)
                shown.see(frame, mask)
                if capture.has_depth:
                    grips[frame] = max(grips[frame], plausible.hands_on(view, plausible.Sample(depth, mask)))
            if frame in wanted:
                samples[frame] = plausible.Sample(depth, mask, color)
        except InputError as error:
            one = refusal(error)
            refused.setdefault(f"{Path(one.where).parent} {one.text}", []).append(one)
    for first, *others in refused.values():
        more = f" The same in {len(others)} more files of the folder." if others else ""
        case.findings.append(replace(first, text=first.text + more))
    path, measured = capture.folder / CAPTURE, [median for median in depths if np.isfinite(median)]
    typical = float(np.median(measured)) if measured else 0.0
    if depths and not measured:
        case.findings.append(broken(path, f"cameras.{name}", "some depth is required", "0 in every pixel of every frame"))
    elif measured and not NEAR < typical < FAR:
        rule = f"the median depth of camera {name} must lie between {NEAR:g} and {FAR:g} m, with the unit of the images"
        received = f"{capture.description.depth_unit:g} m per count, which makes it {typical:.4g} m"
        case.findings.append(broken(path, "depth_unit", rule, received))
    elif calibrated and capture.has_depth:
        case.findings += _world_findings(capture, name, samples)
    if calibrated and not capture.has_depth:
        case.findings += _color_alone_findings(capture, name, samples)
    case.findings += _at(capture.folder / "mask" / name, plausible.mask_findings(name, shown))
    return samples


def _world_findings(capture: Capture, name: str, samples: dict[int, plausible.Sample]) -> list[Finding]:
    """The table, and object and hands in the masks, of one camera."""
    path, camera, up = capture.folder / CAPTURE, capture.cameras[name], capture.description.up
    is_counted = capture.description.depth_format == "png"
    unit = capture.description.depth_unit if is_counted else None
    # Object and hands are no table; what is left must be enough of the image to tell one.
    around = [np.where(sample.mask == 0, sample.depth, 0.0) for sample in samples.values()]
    enough = around and np.mean([(depth > 0).mean() for depth in around]) >= LEAST_AROUND
    found = planes(cloud(around, camera.intrinsics)) if enough else []
    findings = plausible.table_findings(path, name, found, camera.camera_to_world, up, unit)
    bodies = {frame: plausible.lifted(camera, sample, OBJECT) for frame, sample in samples.items()}
    pairs = [(s.mask if s.mask.any() else s.color, s.depth) for s in samples.values() if s.color is not None]
    things = [
        *plausible.edge_findings(f"camera {name}", pairs),
        *plausible.depth_findings(camera, samples),
        *plausible.place_findings(f"camera {name}, object", list(bodies.values()), up_sign(up)),
        *plausible.hand_findings(camera, samples),
        *plausible.reach_findings(camera, samples),
    ]
    if 0 in bodies:
        things += plausible.support_findings(camera, samples[0], up_sign(up), capture.description.obstacles)
        things += plausible.sheet_findings(f"camera {name}, object", bodies[0], up_sign(up), capture.description.category)
    findings += _at(path, things)
    if 0 in bodies:
        findings += obstacle_findings(path, capture.description, bodies[0])
    return findings


def _color_alone_findings(capture: Capture, name: str, samples: dict[int, plausible.Sample]) -> list[Finding]:
    """The camera above the table, and the object in the mask of frame 0 on it, without depth."""
    path, camera, up = capture.folder / CAPTURE, capture.cameras[name], capture.description.up
    findings = plausible.color_alone_findings(path, camera, up, f"poses {capture.description.provenance.get('poses', '')}".rstrip())
    if any(d.level == "error" for d in findings) or 0 not in samples:
        return findings
    mask = samples[0].mask
    findings += plausible.horizon_findings(path, camera, mask)
    category = capture.description.category
    findings += _at(path, plausible.size_findings(camera, mask))
    findings += _at(path, plausible.outline_findings(f"camera {name}, object", mask, category))
    # Nodes that are given say how it is.
    given = any((capture.folder / file).exists() for file in NODES)
    if not given and capture.description.pose is None and category not in ("cloth", "rope"):
        rule = 'one picture cannot say how the object is in frame 0: write "lying" or "standing"'
        findings.append(unusual(path, "pose", f"{rule}. Without it, what would lie farther behind than it is wide rises", "none"))
    # Hands are about as far as the object on the table.
    depth = np.nanmedian(camera.project(plausible.object_on_table(camera, mask))[1]) if (mask == OBJECT).any() else np.nan
    if np.isfinite(depth):
        supposed = {frame: replace(sample, depth=np.full(mask.shape, depth)) for frame, sample in samples.items()}
        findings += _at(path, plausible.hand_findings(camera, supposed, plausible.HAND_LEAST))
    # Obstacles stand on the table: what lies beneath one is met above it.
    on_table = plausible.object_on_table(camera, mask) + np.array([0.0, 0.0, 2 * INSIDE * up_sign(up)])
    return findings + obstacle_findings(path, capture.description, on_table[np.isfinite(on_table[:, 0])])


def obstacle_findings(path: Path, description: Description, points: np.ndarray) -> list[Finding]:
    """Findings about obstacles in which points [n, 3], m, of the object lie in frame 0: nodes there would be thrown out."""
    found = []
    for number, obstacle in enumerate(description.obstacles):
        share = float((obstacle.depth(points) > INSIDE).mean()) if len(points) else 0.0
        if share > INSIDE_SHARE:
            rule = f"the object of frame 0 must be outside, but for {INSIDE_SHARE:.0%} of what is seen of it"
            rule += ". Look at center, rotation and sizes; they are in meters, in the world of the cameras."
            found.append(broken(path, f"obstacles[{number}]", rule, f"{share:.0%} more than {1e3 * INSIDE:g} mm inside"))
    return found


CONTROLLERS = 30
"""Controller points of every released case."""
CAMERAS = 3
"""Cameras of every released case."""


def check_layout(folder: Path) -> list[Finding]:
    """Check a capture or a folder of them, a processed case, a folder of cases, a root with data/different_types, or cable
    recordings (folder or .pkl file). Returns every finding.

    Raises InputError only if `folder` does not exist or holds no data of a known layout.
    """
    folder = Path(folder)
    if folder.is_file():
        return mocap.check_mocap(folder)
    if not folder.is_dir():
        raise InputError(folder, "a folder or file to check is required", "nothing there")
    if captures := _captures(folder):
        return [finding for path in captures for finding in check_capture(path)]
    if cases := find_cases(folder):
        return [finding for case in cases for finding in _check_case(case)]
    files = sorted(folder.rglob("*.pkl"))
    if not files:
        rule = "a case with final_data.pkl, a folder of cases, a root with data/different_types, or cable recordings is required"
        raise InputError(folder, rule, "none of them")
    return [finding for file in files for finding in mocap.check_mocap(file)]


def find_cases(folder: Path) -> list[Released]:
    """The processed cases in or below `folder`; none in a file, or if there are captures.

    Raises InputError for a root with data/different_types that holds no case.
    """
    folder = Path(folder)
    if folder.is_file() or _captures(folder):
        return []
    below = folder / "data" / "different_types"
    if below.is_dir():
        paths = _subfolders(below)
        if not paths:
            raise InputError(folder, "at least one case folder is required", "none")
        return [Released(root=folder, name=path.name) for path in paths]
    cases = []
    for path in [folder] if is_case(folder) else filter(is_case, _subfolders(folder)):
        path = path.absolute()
        if path.parts[-3:-1] == ("data", "different_types"):
            cases.append(Released(root=path.parents[2], name=path.name))
        else:
            cases.append(Released(root=path.parent, name=path.name, loose=path))
    return cases


def is_case(folder: Path) -> bool:
    """Whether the folder holds processed data."""
    return (folder / phystwin.FINAL_DATA).exists() or (folder / phystwin.SPLIT).exists()


def render(findings: list[Finding]) -> str:
    """Findings as text, grouped by file, ending in 'N errors, N warnings'."""
    ordered = sorted(findings, key=lambda d: d.where)
    lines = []
    for file, group in groupby(ordered, key=lambda d: d.where):
        lines.append(file)
        lines += [f"  {d.level:8} {d.message}" for d in group]
    counts = [sum(d.level == level for d in findings) for level in ("error", "warning")]
    total = ", ".join(f"{n} {word}{'' if n == 1 else 's'}" for n, word in zip(counts, ("error", "warning"), strict=True))
    return "\n".join([*lines, total])


def _captures(folder: Path) -> list[Path]:
    return [path for path in (folder, *_subfolders(folder)) if Capture.begun(path)]


def _subfolders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))


def _check_case(case: Released) -> list[Finding]:
    inspection = Inspection(case.folder)
    load, findings = inspection.load, inspection.findings
    data = _check_final_data(inspection)
    frames = None if data is None else len(data["object_points"])
    path = case.folder / phystwin.SPLIT
    split = load(path, load_json)
    if split is not None and frames is None:
        findings.append(note(path, "needs the number of frames of final_data.pkl: the check of the split is skipped"))
    elif split is not None and frames is not None:
        findings += phystwin.split_findings(path, split, frames)
    path = case.folder / phystwin.TRACKS
    tracks = inspection.load_optional(path, load_pickle, "annotated tracks and the track error are")
    if tracks is not None:
        findings += phystwin.tracks_findings(path, tracks, frames)
    path = case.folder / phystwin.CALIBRATION
    poses = inspection.load_optional(path, load_pickle, "the calibration check is")
    if poses is not None:
        findings += phystwin.poses_findings(path, poses, CAMERAS)
    path = case.folder / phystwin.METADATA
    metadata = inspection.load_optional(path, load_json, "the check of intrinsics and frame rate is")
    if metadata is not None:
        findings += phystwin.frame_rate_findings(path, metadata)
    if isinstance(metadata, dict):
        if "fps" not in metadata:
            findings.append(unusual(path, "fps", "missing; 30 frames per second are assumed"))
        if frames is not None and metadata.get("frame_num", frames) != frames:
            findings.append(unusual(path, "frame_num", f"{phystwin.FINAL_DATA} has {frames} frames", metadata["frame_num"]))
        findings += phystwin.metadata_findings(path, metadata, CAMERAS)
    if case.loose is not None:
        return findings
    # Results: a file that is missing skips the checks that need it.
    if case.parameters.exists() and (parameters := load(case.parameters, load_pickle)) is not None:
        findings += parameter_findings(case.parameters, parameters)
    if case.checkpoint.exists():
        load(case.checkpoint, read_checkpoint)
    if data is not None and case.prediction.exists() and (positions := load(case.prediction, load_pickle)) is not None:
        nodes = data["object_points"].shape[1] + len(data["surface_points"]) + len(data["interior_points"])
        findings += prediction_findings(case.prediction, positions, len(data["object_points"]), nodes)
    return findings


def _check_final_data(case: Inspection) -> dict[str, np.ndarray] | None:
    """final_data.pkl. Returns its arrays if they have the right keys, shapes and dtypes."""
    path = case.folder / phystwin.FINAL_DATA
    data = case.load(path, load_pickle)
    if data is None:
        return None
    case.findings += phystwin.final_data_findings(path, data)
    if any(d.level == "error" for d in phystwin.structure_findings(path, data)) or not data["object_visibilities"].size:
        return None
    findings = case.findings
    points, visible, valid = data["object_points"], data["object_visibilities"], data["object_motions_valid"]
    moved = np.argwhere(~visible & (points != 0).any(axis=2))
    if len(moved):
        findings.append(unusual(path, "object_points", "(0, 0, 0) is expected where a point is invisible", _place(moved)))
    below = np.argwhere(points[..., 2] > 0)
    if len(below):
        received = f"z up to {float(np.nanmax(points[..., 2])):.4g} m, {_place(below)}"
        findings.append(unusual(path, "object_points", "z <= 0 (on or above the table) is expected", received))
    empty = np.flatnonzero(~visible.any(axis=1)).tolist()
    if empty:
        frames = ", ".join(map(str, empty[:8])) + (f", ... ({len(empty)} in all)" if len(empty) > 8 else "")
        rule = "a visible point in every frame is expected"
        findings.append(unusual(path, "object_visibilities", rule, f"none in frames {frames}"))
    if valid[-1].any():
        rule = "the last row has no next frame and must be all False"
        findings.append(unusual(path, "object_motions_valid", rule, f"{int(valid[-1].sum())} True"))
    unseen = np.argwhere(valid[:-1] & ~(visible[:-1] & visible[1:]))
    if len(unseen):
        rule = "a valid motion from t to t+1 requires the point to be visible in both frames"
        findings.append(broken(path, "object_motions_valid", rule, _place(unseen)))
    rest = points[0]
    duplicates = len(rest) - len(np.unique(rest, axis=0))  # springs between them would have no length
    if duplicates:
        findings.append(unusual(path, "object_points", "the points of frame 0 are expected to differ", f"{duplicates} duplicates"))
    if not np.array_equal(rest[np.lexsort(rest.T[::-1])], rest, equal_nan=True):
        rule = "columns are expected in lexicographic order of their frame-0 coordinates"
        findings.append(unusual(path, "object_points", rule, "another order"))
    controllers = data["controller_points"].shape[1]
    if controllers != CONTROLLERS:
        findings.append(unusual(path, "controller_points", f"released cases have {CONTROLLERS} controllers", controllers))
    return dict(data)


def _place(rows: np.ndarray) -> str:
    return f"frame {rows[0][0]}, point {rows[0][1]} ({len(rows)} in all)"
