"""Findings about a data set: captures, cases of PhysTwin, C3D files, and layouts of other packages.

Bad content never raises an exception. An error makes a twin wrong or impossible; a warning is unusual and states the next step.
`neuspring.checks.table` lists all checks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.checks import examine
from neuspring.checks.masks import Shown
from neuspring.checks.moving import Moving
from neuspring.checks.objects import Sample, hands_on, lifted, place_of, sampled
from neuspring.checks.rig import Rig
from neuspring.checks.sheet import SHEET_FILE, draw_sheet
from neuspring.checks.timing import Streams, Watched, in_space, measure, on_images
from neuspring.config import Config, ScenarioRow
from neuspring.core.artifacts import up_sign
from neuspring.core.errors import InputError
from neuspring.core.findings import Finding, note, refusal
from neuspring.core.text import listed
from neuspring.data.c3d import Markers, is_c3d, plain_file
from neuspring.data.capture import CAPTURE, OBJECT, Capture, description_findings, read_description
from neuspring.intake import phystwin, phystwin_raw
from neuspring.intake.phystwin import FINAL_DATA, SPLIT
from neuspring.intake.points import InSpace, look
from neuspring.registry import Registry

LEAST_AROUND = 0.1
"""Fraction of the image that must have depth outside object and hands before the table is searched."""


@dataclass(frozen=True)
class Layout:
    """Another kind of data that check-data accepts."""

    recognizes: Callable[[Path], bool]
    """True for a file or folder of this kind."""
    check: Callable[[Path, Config], list[Finding]]
    """All findings about it; bad content must not raise."""


LAYOUTS: Registry[Layout] = Registry("layouts", {}, Layout)
"""Layouts of other packages: entry points of the group `neuspring.layouts`."""


def check_layout(folder: Path, config: Config | None = None) -> list[Finding]:
    """Check a file or folder of data and return every finding.

    Accepts a capture or a folder of captures, a processed or raw case, a folder of cases, a root with data/different_types, C3D
    files (one file may have labels: FILE.c3d#LABEL), and layouts of other packages. Raises InputError only if `folder` does not
    exist or contains no data of a known layout.
    """
    folder = Path(folder)
    if is_c3d(folder) and plain_file(folder).is_file():
        return check_markers(folder)
    if not folder.exists():
        raise InputError(folder, "a folder or file to check is required", "no such path")
    if folder.is_dir():
        if captures := _captures(folder):
            return [finding for path in captures for finding in check_capture(path)]
        if cases := find_cases(folder):
            return [finding for case in cases for finding in _check_case(case)]
        if c3d_files := sorted(path for path in folder.rglob("*") if path.suffix.lower() == ".c3d"):
            return [finding for file in c3d_files for finding in check_markers(file)]
    files = sorted(filter(Path.is_file, folder.rglob("*"))) if folder.is_dir() else [folder]
    found = [kind.check(file, config or Config()) for file in files for kind in LAYOUTS.values() if kind.recognizes(file)]
    if not found:
        rule = "a capture, a case with final_data.pkl, a folder of cases, a root with data/different_types, or files of "
        raise InputError(folder, f"{rule}{', '.join(['C3D', *LAYOUTS])} are required", "none of them")
    return [finding for listed in found for finding in listed]


def check_capture(folder: Path) -> list[Finding]:
    """Check description, calibration, every image, masks and points in space; write the contact sheet into the folder."""
    path = folder / CAPTURE
    try:
        description = read_description(path)
    except InputError as error:
        return [refusal(error)]
    findings = description_findings(path, description)
    capture, calibrated = Capture(folder, description), not any(one.level == "error" for one in findings)
    grips = np.zeros(capture.frame_count, int)
    samples, watched = dict[str, dict[int, Sample]](), dict[str, Watched]()
    for name in capture.cameras:
        watched[name] = Watched(capture.frame_count)
        samples[name], of_camera = _check_camera(capture, name, calibrated, grips, watched[name])
        findings += of_camera
    findings += at(path, examine("mask fit", path, watched, streams=capture.streams))
    findings += examine("grips", path, grips, description.frame_rate, folder)
    if calibrated and capture.cameras:
        findings += at(path, examine("rig", path, _rig(capture, samples), streams=capture.streams))
    space, of_space = look(capture)
    findings += of_space
    for name in capture.cameras:
        try:
            capture.points(name)
        except InputError as error:
            findings.append(refusal(error))
    if calibrated:
        findings += examine("streams", path, list(_streams(capture, watched, space)))
        if capture.cameras:
            try:
                controllers = np.zeros((capture.frame_count, 0, 3)) if space.hands is None else space.hands.points
                draw_sheet(capture, controllers, space.annotated, folder / SHEET_FILE)
                findings.append(
                    note(folder / SHEET_FILE, "look at it: grids belong on the table, dots on the object, outlines around it")
                )
            except InputError as error:
                findings.append(replace(refusal(error), level="note"))
    if capture.cameras and not description.masks:
        findings.append(
            note(path, f"no masks yet (masks: false). Annotate them with `neuspring annotate {folder}`, then check again")
        )
    return findings


def at(file: Path, findings: Iterable[Finding]) -> list[Finding]:
    """Findings about the content of `file`."""
    return [replace(one, where=str(file), title=f"{one.where}: {one.name}") for one in findings]


def _check_camera(
    capture: Capture, name: str, calibrated: bool, grips: np.ndarray, watched: Watched
) -> tuple[dict[int, Sample], list[Finding]]:
    """A few frames of a camera, and all findings about its images.

    Updates `grips` [T], the number of hands at the object, and `watched`, which receives every frame.
    """
    view, path, streams = capture.cameras[name], capture.folder / CAPTURE, capture.streams
    shown, medians = Shown(capture.frame_count, (view.width, view.height)), list[float]()
    samples, refused = dict[int, Sample](), dict[str, list[Finding]]()
    for frame in (frame for frame in range(capture.frame_count) if capture.has(name, frame)):
        try:
            color, depth, mask = (
                capture.color(name, frame),
                capture.depth(name, frame),
                np.zeros((view.height, view.width), np.uint8),
            )
            medians += [float(np.median(depth[depth > 0]))] if (depth > 0).any() else []
            if "mask" in streams:
                mask = capture.mask(name, frame)
                shown.see(frame, mask)
                grips[frame] = max(grips[frame], hands_on(view, Sample(depth, mask)))
            watched.see(frame, color, depth if "depth" in streams else None, mask if "mask" in streams else None)
            if frame in sampled(capture.frame_count):
                samples[frame] = Sample(depth, mask, color)
        except InputError as error:
            one = refusal(error)
            refused.setdefault(f"{Path(one.where).parent} {one.text}", []).append(one)
    more = {
        key: f" {len(alike) - 1} more files of the folder have the same fault." for key, alike in refused.items() if len(alike) > 1
    }
    findings = [replace(alike[0], text=alike[0].text + more.get(key, "")) for key, alike in refused.items()]
    where, median = f"camera {name}", float(np.median(medians)) if medians else 0.0
    wrong_depth = examine("depths", where, median, streams=streams)
    found = wrong_depth + examine("masks", where, shown) + examine("repeats", where, capture, name, watched)
    if calibrated and not wrong_depth:
        bodies = {frame: lifted(view, sample, OBJECT) for frame, sample in samples.items()}
        found += examine("object and hands", where, view, samples, streams=streams)
        found += examine("hands", where, view, samples, streams=streams)
        found += examine("object", where, place_of(bodies, up_sign(capture.description.up)))
    return {} if wrong_depth else samples, findings + at(path, found)


def _rig(capture: Capture, samples: Mapping[str, Mapping[int, Sample]]) -> Rig:
    """All cameras together. The table is searched outside object and hands, where enough of the image has depth."""
    around = {name: [np.where(one.mask == 0, one.depth, 0.0) for one in some.values()] for name, some in samples.items()}
    depths = {
        n: some if some and np.mean([(depth > 0).mean() for depth in some]) >= LEAST_AROUND else [] for n, some in around.items()
    }
    first = {name: some[0].depth for name, some in samples.items() if 0 in some}
    return Rig(capture.cameras, depths, first, capture.description.up)


def _streams(capture: Capture, watched: Mapping[str, Watched], space: InSpace) -> Iterator[Streams]:
    """Every two streams of a capture that show the same motion."""
    again, rows = "Make the capture again with `make-capture --shift {}={{frames}}`.", "Shift its rows by {frames}."
    maps = in_space(watched, capture.cameras) if len(watched) > 1 else {}
    files = {"controllers": None if space.hands is None else space.hands.points, "annotated points": space.annotated}
    for name, one in watched.items():
        if "depth" in capture.streams:
            yield Streams(f"color {name}", f"depth {name}", measure(one.color, one.depth), again.format(f"{name}.depth"))
        if "mask" in capture.streams:
            yield Streams(f"color {name}", f"masks {name}", measure(one.color, one.masks), "Name mask {frames} as frame 0.")
        first = next(iter(watched))
        if name in maps and name != first:
            yield Streams(f"camera {first}", f"camera {name}", measure(maps[first], maps[name]), again.format(name))
        for what, points in files.items():
            if points is not None and points.size:
                yield Streams(f"camera {name}", what, measure(one.color, on_images(points, capture.cameras[name])), rows)


def check_markers(path: Path) -> list[Finding]:
    """A note about the markers of a C3D file, or those that FILE.c3d#LABEL,LABEL selects, and findings about their motion."""
    try:
        markers = Markers.read(path)
    except InputError as error:
        return [refusal(error)]
    unseen = np.isnan(markers.points[..., 0]).sum(axis=0)
    sides = " x ".join(f"{side:.3g}" for side in np.nanmax(markers.points, axis=(0, 1)) - np.nanmin(markers.points, axis=(0, 1)))
    gaps = listed(f"{label} in {count} frames" for label, count in zip(markers.labels, unseen, strict=True) if count)
    size = f"{len(markers.points)} frames of {markers.rate:g} Hz, within {sides} m, of {len(markers.labels)} markers: "
    listing = note(path, size + ", ".join(markers.labels) + f"; lost: {gaps or 'none'}")
    remedy = "Fill gaps in the recording software, or select other markers: FILE.c3d#LABEL,LABEL"
    return [listing, *examine("moving", path, Moving(markers.points, markers.rate), remedy)]


def find_cases(folder: Path) -> list[Path]:
    """The case folders in or below `folder`. Raises InputError for a root with data/different_types but without cases."""
    below = folder / "data" / "different_types"
    cases = [folder] if is_case(folder) else _subfolders(below) if below.is_dir() else list(filter(is_case, _subfolders(folder)))
    if below.is_dir() and not cases:
        raise InputError(folder, "at least one case folder is required", "none")
    return cases


def is_case(folder: Path) -> bool:
    """True if the folder contains a processed or raw case."""
    return any((folder / name).exists() for name in (FINAL_DATA, SPLIT, phystwin.CALIBRATION))


def _check_case(folder: Path) -> list[Finding]:
    """Errors of a case's readers: for its processed data, and for its raw data if it has images."""
    findings = list[Finding]()
    row = ScenarioRow(scenario=folder.name, source="phystwin", category="", path=".", self_collision=False, ground=True)
    readers: list[Callable[[], Any]] = []
    images = (folder / "color").is_dir()
    if (folder / FINAL_DATA).exists() or not images:
        readers.append(lambda: phystwin.read(row, folder))
    if images:
        readers.append(lambda: phystwin_raw.read(folder.name, "", folder))
    elif (folder / phystwin.CALIBRATION).exists():
        readers.append(lambda: phystwin_raw.read_calibration(folder))
    for reader in readers:
        try:
            reader()
        except InputError as error:
            findings.append(refusal(error))
    return findings


def _captures(folder: Path) -> list[Path]:
    return [path for path in (folder, *_subfolders(folder)) if Capture.begun(path)]


def _subfolders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))


def render(findings: list[Finding]) -> str:
    """Findings as text, grouped by file; the last line is 'N errors, N warnings'."""
    ordered = sorted(findings, key=lambda d: d.where)
    lines = []
    for file, group in groupby(ordered, key=lambda d: d.where):
        lines.append(file)
        lines += [f"  {d.level:8} {d.message}" for d in group]
    counts = [sum(d.level == level for d in findings) for level in ("error", "warning")]
    total = ", ".join(f"{n} {word}{'' if n == 1 else 's'}" for n, word in zip(counts, ("error", "warning"), strict=True))
    return "\n".join([*lines, total])
