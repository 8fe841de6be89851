"""Write a capture folder from streams of cameras or from points in space; an interrupted call resumes."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import TypeAdapter
from scipy.spatial.transform import Rotation

from neuspring.config import parse
from neuspring.core.errors import InputError
from neuspring.core.files import load_json, write_text
from neuspring.core.findings import refuse
from neuspring.core.geometry import lean
from neuspring.core.records import digest_file
from neuspring.core.text import Progress
from neuspring.data import capture
from neuspring.data.c3d import Markers, is_c3d, plain_file
from neuspring.data.camera import Camera, CameraEntry
from neuspring.data.capture import CAPTURE, POINTS, TRACKS, Capture, Description, Writer, description_findings
from neuspring.extensions.make_capture.formats import open_recording, open_streams
from neuspring.extensions.make_capture.options import Intake
from neuspring.extensions.make_capture.poses import Placed, SeenCamera, place
from neuspring.extensions.make_capture.rig import RigCamera, StatedRig, Straightener, lens_of, read_rig, stated
from neuspring.extensions.make_capture.streams import CameraStreams, FrameChoice, choose
from neuspring.intake import points

OF_FILM = ("color", "depth", "recording", "rig", "frames", "shift", "pose", "pair")
"""Options that only concern cameras."""
FEW_FRAMES = 5
"""Number of frames of a camera in which the table or a board is searched."""
RATE_APART = 0.02
"""Largest relative difference of a stated frame rate from that of the stamps."""
PRECIOUS = ("mask", "marks.json", "annotations.json", TRACKS, POINTS, *capture.CONTROLLERS, *capture.NODES, capture.REST)
"""Files that took people or programs hours; --force does not remove them."""


def make_capture(intake: Intake) -> tuple[Capture, list[str]]:
    """Write the capture, and return it with a report.

    All input is checked before the first image is written. An interrupted call resumes. Raises InputError with the option or file,
    the rule, the received value and the next move.
    """
    for option, value in (("--output", intake.output != Path()), ("--category", intake.category)):
        if not value:
            raise InputError(option, "is required", "none", "Run neuspring make-capture --help for all options.")
    require_free(intake.output, intake.force)
    if bool(intake.color) == bool(intake.recording):
        if intake.color or not intake.controllers:
            rule = "one of --color and --recording is required, or --controllers with --nodes and --tracks"
            raise InputError("make-capture", rule, "both" if intake.color else "none")
        return _of_points(intake)
    if intake.plumb:
        raise InputError("--plumb", "is only for points without color", "cameras", "State the pose of the table in rig.json.")
    rig = read_rig(intake.rig)
    if intake.recording:
        opened = open_recording(intake)
        if isinstance(opened, Capture):
            return opened, [f"frames: {opened.frame_count}, cameras: {len(opened.cameras)}"]
    else:
        opened = open_streams(intake)
    names = [rig.cameras[k].name or str(k) if k < len(rig.cameras) else str(k) for k in range(len(opened))]
    if len(set(names)) < len(names) or len(rig.cameras) > len(names):
        rule = f"cameras: one entry with its own name is required for each of the {len(names)} cameras"
        raise InputError(intake.rig, rule, f"{len(rig.cameras)} entries, {' '.join(names)}")
    late = shifts(intake.shift, opened, names)
    views = [
        replace(view, name=name, pairing=intake.pair, late=late.get(f"{name}.depth", 0))
        for name, view in zip(names, opened, strict=True)
    ]
    choice = choose(views, intake.frames, intake.pair, late)
    rate = rate_of(intake.rig, rig, views, choice.step)
    unit = unit_of(intake.rig, rig, views)
    seen = {
        view.name: look(
            intake.rig, rig.cameras[k] if k < len(rig.cameras) else RigCamera(), view, choice, unit, rig.poses == "board"
        )
        for k, view in enumerate(views)
    }
    placed = place(intake.rig, rig, seen)
    made = _described(intake, views, choice, rate, unit, seen, placed)
    with _begun(intake, made, seen) as (writer, begun):
        _write(writer, begun, views, choice, unit, seen)
    missing = {name: len(choice.missing(name)) for name in names if choice.missing(name)}
    alone = {view.name: view.without_partner for view in views if view.without_partner}
    lines = [f"frames: {choice.text()}; {rate:g} frames per second", f"poses: {placed.how}, up {placed.up}"]
    lines += [f"depth: {unit:g} m per count"] if unit else []
    lines += [f"warning: camera {name} misses {count} frames of other cameras" for name, count in missing.items()]
    lines += [f"warning: camera {name}: {count} images without a partner are left out" for name, count in alone.items()]
    return Capture.load(intake.output), lines


def shifts(given: Sequence[str], views: Sequence[CameraStreams], names: Sequence[str]) -> dict[str, int]:
    """Stream -> number of images by which it is late, from options such as `0.depth=1`. Raises InputError."""
    known = [*(f"{name}.depth" for name, view in zip(names, views, strict=True) if view.depth is not None), *names[1:]]
    late = {}
    for text in given:
        stream, _, images = text.partition("=")
        if stream not in known or not re.fullmatch(r"[+-]?\d{1,5}", images):
            raise InputError("--shift", f"STREAM=IMAGES is required, with a stream of {' '.join(known) or 'none'}", text)
        late[stream] = int(images)
    return late


def rate_of(path: Path | None, rig: StatedRig, views: Sequence[CameraStreams], step: int) -> float:
    """Frames per second of the capture: the stated rate, or that of the stamps, divided by `step`. Raises InputError."""
    value = stated(path, "frame_rate", rig.frame_rate)
    known = [rate for view in views if (rate := view.color.series.rate) is not None]
    if value == "stamps":
        if not known or max(known) > (1 + RATE_APART) * min(known):
            received = " and ".join(f"{rate:.4g}" for rate in known) or "none"
            raise InputError(path, "frame_rate: stamps of one rate are required", received, "State the frames per second.")
        return round(known[0], 2) / step
    for rate in known:
        if abs(rate - value) > RATE_APART * value:
            remedy = 'Correct the rate, or state "stamps".'
            raise InputError(path, "frame_rate: must be the rate of the stamps", f"{value:g}, and {rate:.4g} by stamps", remedy)
    return float(value) / step


def unit_of(path: Path | None, rig: StatedRig, views: Sequence[CameraStreams]) -> float | None:
    """Meters per count of depth, from the recording or rig.json; None without depth. Raises InputError."""
    if all(view.depth is None for view in views):
        return None
    if any(view.depth is None for view in views):
        raise InputError("--depth", "is required for all cameras or for none", "some")
    known = {view.unit for view in views if view.unit is not None}
    if known and (len(known) > 1 or rig.depth_unit not in (None, *known)):
        received = " and ".join(map(str, sorted(known))) + f"; stated {rig.depth_unit}"
        raise InputError(path or "--recording", "depth_unit: must be that of the recording, the same for all cameras", received)
    return known.pop() if known else float(stated(path, "depth_unit", rig.depth_unit))


def look(
    path: Path | None, entry: RigCamera, view: CameraStreams, choice: FrameChoice, unit: float | None, board: bool
) -> SeenCamera:
    """A few undistorted frames of a camera: chosen frames, or with `board` the first ones of the source. Raises InputError."""
    places = [place for _, place in sorted(choice.places[view.name].items())]
    some = sorted({places[k] for k in np.linspace(0, len(places) - 1, FEW_FRAMES).astype(int)})
    pairs = list(view.read(range(min(FEW_FRAMES, len(view.pairs))) if board else some))
    size = pairs[0][0].shape[1], pairs[0][0].shape[0]
    lens = lens_of(path, view.name, entry, view.lens, size)
    straight = Straightener(lens, size)
    depths = [straight.depth(plain(depth)) * unit for _, depth in pairs if depth is not None and unit]
    return SeenCamera(view.name, view.path, size, lens, straight, [straight.color(color) for color, _ in pairs], depths)


def plain(depth: np.ndarray) -> np.ndarray:
    """Depth with 16-bit counts unchanged, and other numbers as float32, 0 where there is no depth."""
    return depth if depth.dtype == np.uint16 else np.nan_to_num(depth.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0).clip(0)


def _described(
    intake: Intake,
    views: Sequence[CameraStreams],
    choice: FrameChoice,
    rate: float,
    unit: float | None,
    seen: Mapping[str, SeenCamera],
    placed: Placed,
) -> Description:
    """The content of capture.json. Raises InputError."""
    cameras = []
    for name, view in seen.items():
        entry = Camera(name, *view.size, view.lens.matrix, placed.poses[name]).entry()
        cameras.append(TypeAdapter(CameraEntry).dump_python(replace(entry, missing=choice.missing(name))))
    digest = hashlib.sha256()
    files = {path for view in views for path in view.files([place for _, place in sorted(choice.places[view.name].items())])}
    for path in sorted(files):
        digest.update(f"{path.name} {digest_file(path)}\n".encode())
    first = next(views[0].read([choice.places[views[0].name][0]]))[1]
    counted = first is None or first.dtype == np.uint16
    provenance = {"source": "make-capture", "files": f"sha256:{digest.hexdigest()}", "frames": choice.text(), "poses": placed.how}
    return _parsed(
        intake,
        frame_count=len(choice.numbers),
        frame_rate=rate,
        cameras=cameras,
        tracks="train" if intake.teach else "score",
        depth="none" if unit is None else "measured",
        depth_unit=unit if unit and counted else 0.001,
        depth_format="png" if counted else "npy",
        pose=intake.pose,
        up=placed.up,
        provenance=provenance | digests({"rig": intake.rig} | intake.brought),
    )


def _parsed(intake: Intake, **entries: Any) -> Description:
    shared = {"name": intake.called, "category": intake.category, "train_end": intake.train_end, "mass": intake.mass}
    made = parse(Description, {"format": 1} | shared | entries, "make-capture")
    refuse(description_findings(Path("make-capture"), made))
    return made


@contextmanager
def _begun(intake: Intake, made: Description, seen: Mapping[str, SeenCamera]) -> Iterator[tuple[Writer, bool]]:
    """Yield a writer for the images, and whether the folder contains some of them already; then write points in space.

    Raises InputError, before anything is written, for points that cannot make a twin.
    """
    folder = intake.output
    space, findings = points.look(Capture(folder, made), intake.brought)
    refuse(findings)
    if intake.plumb and space.hands is not None:
        first = space.annotated[0, np.isfinite(space.annotated[0]).all(axis=1)]
        turn = lean(np.concatenate([space.nodes, first]), space.hands.points[0], made.up_sign)
        space = space.turned(Rotation.from_rotvec(turn).as_matrix())
    lenses = {name: [view.lens.model, *view.lens.distortion.tolist()] for name, view in seen.items()}
    begun = prepare(folder, TypeAdapter(Description).dump_python(made, mode="json") | {"distortion": lenses}, intake.force)
    writer = Writer(folder, made)
    yield writer, begun
    points.write(folder, space.hands, space.nodes)
    writer.finish(space.annotated if intake.tracks else None)
    (folder / capture.RECIPE).unlink()


def _write(
    writer: Writer,
    begun: bool,
    views: Sequence[CameraStreams],
    choice: FrameChoice,
    unit: float | None,
    seen: Mapping[str, SeenCamera],
) -> None:
    """Write the images that do not exist yet."""
    made, done = writer.capture.description, 0
    kinds: tuple[Literal["color", "depth"], ...] = ("color", "depth") if unit else ("color",)
    progress = Progress(f"make-capture {made.name}", sum(len(places) for places in choice.places.values()))
    for view in views:
        straight, places = seen[view.name].straight, dict(sorted(choice.places[view.name].items()))
        if begun:
            written = [f for f in places if all(writer.capture.path(kind, view.name, f).is_file() for kind in kinds)]
            done += len(written[:-1])  # The last image may be incomplete.
            places = {frame: place for frame, place in places.items() if frame not in written[:-1]}
        for frame, (color, depth) in zip(places, view.read(list(places.values())), strict=True):
            stored = None
            if depth is not None and unit is not None:
                stored = straight.depth(plain(depth))
                if (stored.dtype == np.uint16) != (made.depth_format == "png"):
                    raise InputError(view.path, "all depth images must be 16-bit integers, or none of them", "both")
                stored = stored if made.depth_format == "png" else (stored * unit).astype(np.float32)
            writer.frame(view.name, frame, straight.color(color), stored)
            done += 1
            progress.update(done)


def _of_points(intake: Intake) -> tuple[Capture, list[str]]:
    """Write a capture of points in space, without cameras."""
    brought = intake.brought
    if missing := [f"--{name}" for name in ("controllers", "nodes", "tracks") if name not in brought]:
        raise InputError("make-capture", "points without color need --controllers, --nodes and --tracks", f"no {' '.join(missing)}")
    if given := [f"--{name}" for name in OF_FILM if getattr(intake, name)]:
        raise InputError(given[0], "requires --color or --recording", "points", "Remove the option: each row is a frame.")
    if intake.up is None:
        raise InputError("--up", "is required for points in space", "none", "State the axis that points up: --up +z or --up -z.")
    read = {path: Markers.read(path) for path in brought.values() if is_c3d(path)}
    known = {one.rate for one in read.values()}
    if len({one.first for one in read.values()}) > 1:
        firsts = ", ".join(f"{path.name} {one.first}" for path, one in read.items())
        rule = "all C3D files of a capture must begin at the same frame of the recording"
        raise InputError("make-capture", rule, firsts, "Export the same frames for all files.")
    rate = intake.rate or (known.pop() if len(known) == 1 else None)
    if rate is None or (known and known != {rate}):
        received = " and ".join(f"{one:g}" for one in sorted(known)) or "none"
        raise InputError(
            "--rate", "rows per second are required, one rate for all files", received, "State the rate, like --rate 120."
        )
    frames = len(points.read_hands(brought["controllers"]).points)
    made = _parsed(
        intake,
        frame_count=frames,
        frame_rate=rate,
        cameras=(),
        depth="none",
        tracks="train",
        up=intake.up,
        ground=not intake.no_table,
        provenance=digests(brought),
    )
    with _begun(intake, made, {}):
        pass
    return Capture.load(intake.output), [f"points in space: {frames} frames of {rate:g} Hz"]


def digests(files: Mapping[str, Path | None]) -> dict[str, str]:
    """Digests of the user's files, for the provenance."""
    return {f"{name} file": f"sha256:{digest_file(plain_file(path))}" for name, path in files.items() if path is not None}


def require_free(folder: Path, force: bool) -> None:
    """Raise InputError if `folder` contains files that must not be overwritten."""
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "--output must be a folder", "a file")
    made, begun = (folder / CAPTURE).exists(), (folder / capture.RECIPE).exists()
    if not folder.is_dir() or not any(folder.iterdir()) or (begun and not made):
        return
    if not (force and made):
        remedy = "Choose another folder" + (", or add --force to replace its images." if made else ".")
        raise InputError(folder, "--output must be a new or empty folder", "a capture" if made else "other files", remedy)
    if kept := [name for name in PRECIOUS if (folder / name).exists()]:
        rule = "--force does not remove masks, annotations or tracks"
        raise InputError(folder, rule, " and ".join(kept), "Move these files first.")


def prepare(folder: Path, recipe: dict[str, Any], force: bool) -> bool:
    """Prepare `folder` for a capture with `recipe`; returns True if it contains an unfinished capture with the same recipe.

    Raises InputError for a folder with other files, unless `force` replaces the images of a capture.
    """
    path = folder / capture.RECIPE
    require_free(folder, force)
    if path.exists() and not (folder / CAPTURE).exists():
        if load_json(path) == json.loads(json.dumps(recipe)):
            return True
        if not force:
            remedy = "Choose another folder, or add --force to replace its images."
            raise InputError(folder, "--output must be a new or empty folder", "an unfinished capture from other input", remedy)
    if folder.is_dir() and any(folder.iterdir()):
        write_text(path, "{}\n")  # An empty recipe: after an interruption, the old images do not count as part of the new capture.
        (folder / CAPTURE).unlink(missing_ok=True)
        for kind in ("color", "depth"):
            shutil.rmtree(folder / kind, ignore_errors=True)
    write_text(path, json.dumps(recipe, indent=1) + "\n")
    return False
