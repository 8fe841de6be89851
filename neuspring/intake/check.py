"""Findings about a data set: its layout, file by file, and a capture against what a scene on a table looks like.
Nothing here raises for bad content.

What cannot work is an error, what is only unusual a warning with the next move; `neuspring.checks` has what is looked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.checks import examine
from neuspring.checks.case import FINAL_DATA, Case, whole
from neuspring.checks.masks import Shown
from neuspring.checks.moving import Moving
from neuspring.checks.rig import CameraAlone, Judged, Rig
from neuspring.checks.table import object_on_table
from neuspring.checks.things import HAND_LEAST, Sample, hands_on, lifted, outline, place_of, sampled
from neuspring.checks.timing import Streams, Watched, in_space, measure, of_cameras, on_images
from neuspring.config import Config
from neuspring.core.artifacts import up_sign
from neuspring.core.errors import InputError
from neuspring.core.files import load_json
from neuspring.core.findings import Finding, note, refusal, unusual
from neuspring.core.text import listed
from neuspring.data.c3d import Markers, is_c3d, plain_file
from neuspring.data.capture import CAPTURE, NODES, OBJECT, POINTS, Capture, description_findings, read_description
from neuspring.data.unpickle import load_pickle
from neuspring.intake import phystwin
from neuspring.intake.points import InSpace, look
from neuspring.registry import Registry

LEAST_AROUND = 0.1
"""Share of the image that must have depth, beside object and hands, before the table is looked for."""
CAMERAS = 3
"""Cameras of every released case."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Files of another kind that `check-data` can look at; a package brings one by an entry point of `neuspring.layouts`."""

    recognizes: Callable[[Path], bool]
    """True for a file of this kind, by its name."""
    check: Callable[[Path, Config], list[Finding]]
    """Every finding about a file; bad content is a finding and raises nothing."""


LAYOUTS: Registry[Layout] = Registry("layouts", {}, Layout)


def check_capture(folder: Path) -> list[Finding]:
    """Description, calibration, every image, masks of frame 0, tracks, marked points."""
    path = folder / CAPTURE
    try:
        description = read_description(path)
    except InputError as error:
        return [refusal(error)]
    findings = description_findings(path, description) + examine("category", path, description.category)
    findings += examine("frame rate", path, description.frame_rate) if description.cameras else []
    capture, calibrated = Capture(folder, description), not any(one.level == "error" for one in findings)
    grips = np.zeros(capture.frame_count, int)
    samples, watched = {}, {name: Watched(capture.frame_count) for name in capture.cameras}
    for name in capture.cameras:
        sampled_here, of_camera = _check_camera(capture, name, calibrated, grips, watched[name])
        findings += of_camera
        if sampled_here:
            samples[name] = sampled_here
    findings += examine("grips", path, grips, description.frame_rate, folder)
    if calibrated and capture.has_depth and samples:
        findings += _rig(capture, samples)
    space, of_space = look(capture)
    findings += of_space
    if calibrated:
        findings += examine("streams", path, list(_streams(capture, watched, space)))
    for name in capture.cameras:
        _read(findings, folder / POINTS, lambda _, name=name: capture.points(name))  # type: ignore[misc]
    if capture.cameras and not description.masks:
        findings.append(note(path, f"no masks yet (masks: false). Draw them: `neuspring annotate {folder}`; then check again"))
    return findings


def _streams(capture: Capture, watched: Mapping[str, Watched], space: InSpace) -> Iterator[Streams]:
    """Every two streams of a capture that show one motion."""
    again = "Make the capture again, with `make-capture --shift {}={{frames}}`."
    masks = "Mask {frames} is that of frame 0.", "Mask 0 is that of frame {back}."
    rows = "Row {frames} is frame 0: leave out the rows before it.", "Row 0 is frame {back}: fill in rows before it."
    maps = in_space(watched, capture.cameras) if len(watched) > 1 else {}
    shifts = of_cameras(maps) if maps else {}
    files = {"controllers": None if space.hands is None else space.hands.points, "annotated points": space.annotated}
    for name, one in watched.items():
        if capture.has_depth:
            yield Streams(f"color {name}", f"depth {name}", measure(one.color, one.depth), again.format(f"{name}.depth"))
        if capture.description.masks:
            yield Streams(f"color {name}", f"masks {name}", measure(one.color, one.masks), *masks)
        if name in shifts:
            yield Streams(f"camera {next(iter(watched))}", f"camera {name}", shifts[name], again.format(name))
        for what, points in files.items():
            if points is not None and points.size:
                yield Streams(
                    f"camera {name}",
                    f"{what} in camera {name}",
                    measure(one.color, on_images(points, capture.cameras[name])),
                    *rows,
                )


def _read(findings: list[Finding], path: Path, reader: Callable[[Path], Any], skipped: str = "") -> Any:
    """The content of `path`, or None with a finding; where it is missing, a note says what is therefore `skipped`."""
    if skipped and not path.exists():
        findings.append(note(path, f"not found: {skipped} skipped"))
        return None
    try:
        return reader(path)
    except InputError as error:
        findings.append(refusal(error))
        return None


def at(file: Path, findings: Iterable[Finding]) -> list[Finding]:
    """Findings about the content of `file`."""
    return [replace(one, where=str(file), title=f"{one.where}: {one.name}") for one in findings]


def _check_camera(
    capture: Capture, name: str, calibrated: bool, grips: np.ndarray, watched: Watched
) -> tuple[dict[int, Sample], list[Finding]]:
    """A few frames of a camera, and all findings about its images and these. `grips` [T] counts hands at the object, and `watched`
    sees all frames."""
    view, path, described = capture.cameras[name], capture.folder / CAPTURE, capture.description
    medians, shown = list[float](), Shown(capture.frame_count, (view.width, view.height))
    samples: dict[int, Sample] = {}
    refused: dict[str, list[Finding]] = {}
    wanted = sampled(capture.frame_count)
    for frame in range(capture.frame_count):
        if not capture.has(name, frame):
            continue
        try:
            color, depth = capture.color(name, frame), capture.depth(name, frame)
            if capture.has_depth:
                medians.append(float(np.median(depth[depth > 0])) if (depth > 0).any() else np.nan)
            mask = np.zeros(depth.shape, np.uint8)
            if described.masks:
                mask = capture.mask(name, frame)
                shown.see(frame, mask)
                if capture.has_depth:
                    grips[frame] = max(grips[frame], hands_on(view, Sample(depth, mask)))
            watched.see(frame, color, depth if capture.has_depth else None, mask if described.masks else None)
            if frame in wanted:
                samples[frame] = Sample(depth, mask, color)
        except InputError as error:
            one = refusal(error)
            refused.setdefault(f"{Path(one.where).parent} {one.text}", []).append(one)
    more = {key: f" The same in {len(alike) - 1} more files of the folder." for key, alike in refused.items() if len(alike) > 1}
    findings = [replace(alike[0], text=alike[0].text + more.get(key, "")) for key, alike in refused.items()]
    measured = [median for median in medians if np.isfinite(median)]
    typical = float(np.median(measured)) if measured else None
    wrong = examine("depths", path, name, described.depth_unit, typical) if medians else []
    findings += wrong
    if calibrated and not wrong:
        findings += (_with_depth if capture.has_depth else _color_alone)(capture, name, samples)
    return {} if wrong else samples, findings + at(capture.folder / "mask" / name, examine("masks", f"camera {name}", shown))


def _with_depth(capture: Capture, name: str, samples: dict[int, Sample]) -> list[Finding]:
    """The table, and object and hands in the masks, of one camera."""
    path, camera, described, up = capture.folder / CAPTURE, capture.cameras[name], capture.description, capture.description.up
    bodies = {frame: lifted(camera, sample, OBJECT) for frame, sample in samples.items()}
    pictures = [(s.mask if s.mask.any() else s.color, s.depth) for s in samples.values() if s.color is not None]
    where, sign = f"camera {name}", up_sign(up)
    found = examine("edges", where, pictures) + examine("object and hands", where, camera, samples, 0.0)
    found += examine("hands", where, camera, samples)
    found += examine("object", f"{where}, object", place_of(bodies, sign))
    if 0 not in bodies:
        return at(path, found)
    found += examine("support", f"{where}, object", camera, samples[0], sign)
    found += examine("sheet", f"{where}, object", bodies[0], sign, described.category)
    return at(path, found)


def _rig(capture: Capture, samples: Mapping[str, Mapping[int, Sample]]) -> list[Finding]:
    """All cameras with depth together: table, unit, lenses and poses, and whether they agree."""
    described, path = capture.description, capture.folder / CAPTURE
    # Object and hands are no table; what is left must be enough of the image to tell one.
    around = {name: [np.where(one.mask == 0, one.depth, 0.0) for one in some.values()] for name, some in samples.items()}
    enough = {n: bool(some) and np.mean([(depth > 0).mean() for depth in some]) >= LEAST_AROUND for n, some in around.items()}
    depths = {name: some if enough[name] else [] for name, some in around.items()}
    first = {name: some[0].depth for name, some in samples.items() if 0 in some}
    rig = Rig({name: capture.cameras[name] for name in samples}, depths, first, described.up)
    unit = described.depth_unit if described.depth_format == "png" else None
    judged = Judged(rig, dict.fromkeys(samples, unit))
    return examine("rig", path, judged) + (examine("views", path, rig.views) if len(samples) > 1 else [])


def _color_alone(capture: Capture, name: str, samples: dict[int, Sample]) -> list[Finding]:
    """The camera above the table, and the object in the mask of frame 0 on it, without depth."""
    path, camera, described, up = capture.folder / CAPTURE, capture.cameras[name], capture.description, capture.description.up
    findings = examine("camera alone", path, CameraAlone(camera, up, f"poses {described.provenance.get('poses', '')}".rstrip()))
    if any(one.level == "error" for one in findings) or 0 not in samples:
        return findings
    mask, category = samples[0].mask, described.category
    findings += examine("horizon", path, camera, mask)
    where = f"camera {name}, object"
    findings += at(path, examine("outline", where, outline(camera, mask)) + examine("silhouette", where, mask, category))
    # Nodes that are given say how it is.
    given = any((capture.folder / file).exists() for file in NODES)
    if not given and described.pose is None and category not in ("cloth", "rope"):
        rule = 'one picture cannot say how the object is in frame 0: write "lying" or "standing"'
        findings.append(unusual(path, "pose", f"{rule}. Without it, what would lie farther behind than it is wide rises", "none"))
    # Hands are about as far as the object on the table.
    places = object_on_table(camera, mask)
    depth = np.nanmedian(camera.project(places)[1]) if (mask == OBJECT).any() else np.nan
    if np.isfinite(depth):
        supposed = {frame: replace(sample, depth=np.full(mask.shape, depth)) for frame, sample in samples.items()}
        seen = examine("object and hands", f"camera {name}", camera, supposed, HAND_LEAST)
        findings += at(path, [one for one in seen if one.name != "depth holes"])
    return findings


def check_layout(folder: Path, config: Config | None = None) -> list[Finding]:
    """Check a capture or a folder of them, a processed case, a folder of cases, a root with data/different_types, C3D files (or
    one, with labels or without), or files of a kind in `LAYOUTS`, which may read the configuration. Returns every finding.

    Raises InputError only if `folder` does not exist or holds no data of a known layout.
    """
    folder = Path(folder)
    if not plain_file(folder).exists():
        raise InputError(folder, "a folder or file to check is required", "nothing there")
    if captures := _captures(folder):
        return [finding for path in captures for finding in check_capture(path)]
    if cases := find_cases(folder):
        findings = [finding for case in cases for finding in _check_case(case)]
        return findings + examine("cases", folder, folder, cases, findings)
    files = sorted(folder.rglob("*")) if folder.is_dir() else [folder]
    found = [check_markers(file) for file in files if is_c3d(file)]
    found += [kind.check(file, config or Config()) for file in files for kind in LAYOUTS.values() if kind.recognizes(file)]
    if not found:
        rule = "a capture, a case with final_data.pkl, a folder of cases, a root with data/different_types, or files of "
        raise InputError(folder, f"{rule}{', '.join(['C3D', *LAYOUTS])} are required", "none of them")
    return [finding for findings in found for finding in findings]


def check_markers(path: Path) -> list[Finding]:
    """Contents of a C3D file, or those markers of it that FILE.c3d#LABEL,LABEL names, and every finding about their motion."""
    findings: list[Finding] = []
    markers = _read(findings, path, Markers.read)
    if markers is None:
        return findings
    unseen = np.isnan(markers.points[..., 0]).sum(axis=0)
    sides = np.ptp(markers.points[np.isfinite(markers.points).all(axis=2)], axis=0) if (unseen < len(markers.points)).any() else []
    size = " x ".join(f"{100 * side:.1f}" for side in sides)
    found = f"{len(markers.points)} frames of {markers.rate:g} Hz, within {size or 0} cm, of {len(markers.labels)} markers: "
    gaps = [f"{label} in {count} frames" for label, count in zip(markers.labels, unseen, strict=True) if count]
    lost = f"; lost: {listed(gaps)}" if gaps else "; none is ever lost"
    findings.append(note(path, found + ", ".join(markers.labels) + lost))
    remedy = "Fill gaps where it was recorded, or leave the marker out: FILE.c3d#LABEL,LABEL"
    return findings + examine("moving", path, Moving(markers.points, markers.rate), remedy)


def find_cases(folder: Path) -> list[Case]:
    """The processed cases in or below `folder`; none in a file, or if there are captures.

    Raises InputError for a root with data/different_types that holds no case.
    """
    folder = Path(folder)
    if not folder.is_dir() or _captures(folder):
        return []
    below = folder / "data" / "different_types"
    if below.is_dir():
        if not (paths := _subfolders(below)):
            raise InputError(folder, "at least one case folder is required", "none")
        return [Case(root=folder, name=path.name) for path in paths]
    cases = []
    for path in [folder] if is_case(folder) else filter(is_case, _subfolders(folder)):
        path = path.absolute()
        if path.parts[-3:-1] == ("data", "different_types"):
            cases.append(Case(root=path.parents[2], name=path.name))
        else:
            cases.append(Case(root=path.parent, name=path.name, loose=path))
    return cases


def is_case(folder: Path) -> bool:
    """True where the folder holds processed data."""
    return (folder / FINAL_DATA).exists() or (folder / phystwin.SPLIT).exists()


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
    return sorted(path for path in folder.glob("*") if path.is_dir() and not path.name.startswith("."))


def _check_case(case: Case) -> list[Finding]:
    folder, found = case.folder, list[Finding]()
    path, frames = folder / FINAL_DATA, None
    if (data := _read(found, path, load_pickle)) is not None:
        found += examine("final data", path, data) + examine("released data", path, data)
        frames = len(data["object_points"]) if whole(data) else None
    path = folder / phystwin.SPLIT
    split = _read(found, path, load_json)
    if split is not None and frames is None:
        found.append(note(path, "needs the number of frames of final_data.pkl: the check of the split is skipped"))
    elif split is not None and frames is not None:
        found += examine("split", path, split, frames)
    path = folder / phystwin.GT_TRACKS
    if (tracks := _read(found, path, load_pickle, "annotated tracks and the track error are")) is not None:
        found += examine("annotated tracks", path, tracks, frames)
    path = folder / phystwin.CALIBRATION
    if (poses := _read(found, path, load_pickle, "the calibration check is")) is not None:
        found += examine("calibration", path, poses, CAMERAS)
    path = folder / phystwin.METADATA
    if (metadata := _read(found, path, load_json, "the check of intrinsics and frame rate is")) is not None:
        found += examine("metadata", path, metadata) + examine("lenses of metadata", path, metadata, CAMERAS)
    if isinstance(metadata, dict):
        if "fps" not in metadata:
            found.append(unusual(path, "fps", "missing; 30 frames per second are assumed"))
        if frames is not None and metadata.get("frame_num", frames) != frames:
            found.append(unusual(path, "frame_num", f"{FINAL_DATA} has {frames} frames", metadata["frame_num"]))
    return found
