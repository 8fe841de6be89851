"""From what cameras gave to a capture folder; never over another one, and from where it was interrupted."""

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

from neuspring.checks import examine
from neuspring.checks.timing import in_space
from neuspring.config import parse
from neuspring.core.errors import InputError
from neuspring.core.files import load_json, write_text
from neuspring.core.findings import refuse, refuse_errors
from neuspring.core.records import digest_file
from neuspring.core.text import Progress
from neuspring.data import capture
from neuspring.data.c3d import Markers, is_c3d, plain_file
from neuspring.data.camera import CameraEntry, Lens
from neuspring.data.capture import CAPTURE, POINTS, TRACKS, Capture, Description, Writer, description_findings
from neuspring.extensions.make_capture.feeds import Paired, Recorded
from neuspring.extensions.make_capture.film import cameras_in_step, in_step, looked_at, watch
from neuspring.extensions.make_capture.formats import open_recording, pairs
from neuspring.extensions.make_capture.formats.bag import open_bags
from neuspring.extensions.make_capture.forms import read_lenses
from neuspring.extensions.make_capture.lenses import Board
from neuspring.extensions.make_capture.options import FILM_OPTIONS, SPACE_OPTIONS, Intake
from neuspring.extensions.make_capture.poses import (
    FrameChoice,
    Placed,
    Seen,
    choose,
    in_report,
    look,
    meters_of,
    place,
    plain,
    stored_as,
)
from neuspring.extensions.make_capture.table import Unit, find_rate
from neuspring.extensions.make_capture.takes import Takes
from neuspring.intake import points

NAME_FORM = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,79}")


def opened(intake: Intake) -> Recorded:
    """The film of the cameras; no views of points in space alone. Raises InputError."""
    given = [f"--{name.replace('_', '-')}" for name in FILM_OPTIONS if getattr(intake, name)]
    if len(given) != 1 and (given or not intake.controllers):
        rule = "one of --color with --depth, --recording, --bag, --phystwin-raw is required, or --controllers with --nodes and "
        rule += "--tracks"
        raise InputError("make-capture", rule, " ".join(given) or "none")
    if intake.bag:
        return open_bags(intake.bag, intake.cameras, intake.topics)
    if paths := (intake.phystwin_raw,) if intake.phystwin_raw else intake.recording:
        return open_recording(paths, "phystwin_raw" if intake.phystwin_raw else intake.format, intake.cameras)
    return Recorded(views=pairs(intake.color, intake.depth, intake.cameras) if intake.color else ())


OF_FILM = "frames shift take depth_unit intrinsics poses board board_images level top_down table_at pose"
"""Options that say nothing of points in space alone."""


def make_capture(intake: Intake) -> tuple[Capture, list[str]]:
    """Write the capture; returns it with a report of what was found.

    All is checked before the first image is written. An interrupted call goes on where it was. Raises InputError naming the option
    or file, the rule, what was received and the next move.
    """
    for option, value in (("--output", intake.output != Path()), ("--category", intake.category)):
        if not value:
            raise InputError(option, "is required", "none", "neuspring make-capture --help has all options.")
    if intake.topics and not intake.bag:
        raise InputError("--topics", "is for --bag", "none", "Give --bag FILE.")
    require_free(intake.output, intake.force)
    film, board = opened(intake), Board.of(intake.board) if intake.board else None
    views = film.views
    if not views:
        return _of_points(intake)
    require_consistent(intake, film)
    late = shifts(intake.shift, views)
    views = [replace(view, late=late.get(f"{view.name}.depth", 0)) for view in views]
    film = replace(film, views=views)
    choice = choose(views, intake.frames, late)
    findings = looked_at(views, choice)
    refuse_errors(findings)
    film.require_masks({name: [choice.numbers[frame] for frame in places] for name, places in choice.places.items()})
    known = [view.rate([*choice.places[view.name].values()]) for view in views]
    rate, rate_text = find_rate(film.rate if intake.rate is None else intake.rate, known, choice.step)
    _require_rate(intake.brought, rate)
    names = [view.name for view in views]
    listed = read_lenses(intake.intrinsics, names) if intake.intrinsics else {}
    takes = Takes.read(intake.take, names)
    seen, unit = look(intake, views, choice, listed, takes)
    watched = watch(views, choice, unit)
    findings += in_step(views, watched, late)
    refuse_errors(findings)
    for name, view in seen.items():
        beside = examine("edges", view.path, list(zip(view.colors, view.depths, strict=False)))
        findings += [replace(one, title=f"camera {name}: {one.name}") for one in beside]
        findings += examine("models", view.path, name, next(iter(view.flat)), view.flat) if view.flat else []
    findings += examine("category", intake.output, intake.category)
    placed = place(intake, film, board, seen, unit, takes)
    cameras = {name: view.camera(placed.poses[name]) for name, view in seen.items()}
    findings += cameras_in_step(views, choice, in_space(watched, cameras), late)
    refuse_errors(findings)
    made = _describe(intake, film, choice, rate, unit, seen, placed)
    tracks = None if film.tracks is None else film.tracks[choice.numbers] @ placed.motion[:3, :3].T + placed.motion[:3, 3]
    with _begun(intake, made, {name: view.lens for name, view in seen.items()}, tracks) as (writer, begun, _):
        _write(writer, begun, film, choice, unit, seen, takes)
    sizes = ", ".join(f"{name} {view.size[0]} x {view.size[1]}" for name, view in seen.items())
    depth = "none, color alone" if unit is None else unit.text()
    thin = "thin: no volume is made of it" if intake.category in capture.THIN else "a volume is made of what is seen"
    lines = [f"category: {intake.category}, {thin}", f"cameras: {sizes}"]
    lines += dict.fromkeys(f"intrinsics: {told}" for lens in listed.values() for told in lens.told)
    lines += [view.straight.text(name) for name, view in seen.items() if view.lens.distortion.any()]
    lines += [f"frames: {choice.text()}; {rate_text}", f"depth: {depth}", f"poses: {placed.how}, up {placed.up}"]
    training = made.train_end or int(0.7 * made.frame_count)
    if "; the source says" in rate_text:
        lines.append(f"warning: --rate: {rate_text}. Leave it out, unless the names or the film are wrong")
    lines += [*placed.lines, *map(in_report, findings)]
    lines.append(f"training frames: 0 to {training - 1}; future frames: {training} to {made.frame_count - 1}")
    return Capture.load(intake.output), lines


def require_consistent(intake: Intake, film: Recorded) -> None:
    """Raise InputError for options that contradict each other or the film, and for those that it needs."""
    for option, name in (("--name", intake.called), *(("--cameras", view.name) for view in film.views)):
        if not NAME_FORM.fullmatch(name):
            raise InputError(option, "letters, digits, '.', '_' and '-' are required, a letter or digit first", repr(name))
    many, alone = len(film.views), all(view.depth is None for view in film.views)
    posed, given = [view.name for view in film.views if view.pose is not None], intake.poses or intake.board
    own, level = "--tracks" if intake.tracks else "--teach", "needs depth: with color alone the table is z = 0 as the poses say"
    world = "points in space need the world of the cameras: --poses or --board, without --level"
    # fmt: off
    refused = (
        (intake.no_table, "--no-table", "is for points in space alone: cameras are placed by the table", "a film",
         "Leave it out, and write ground: false in capture.json."),
        *((alone and getattr(intake, option), f"--{option.replace('_', '-')}", level, "no --depth", "")
          for option in ("level", "top_down", "table_at", "depth_unit")),
        (alone and not intake.intrinsics, "--intrinsics", "color alone needs the intrinsics of the camera", "none",
         "Give a JSON file with fx, fy, cx, cy. If depth was forgotten, add --depth."),
        (alone and not given, "--poses", "color alone needs the pose of the camera, in a world with the table at z = 0", "none",
         "Give --poses FILE, or --board with a ChArUco board on the table. If depth was forgotten, add --depth."),
        (intake.pose and not alone, "--pose", "is for color alone: depth shows how the object is", intake.pose, "Leave it out."),
        (film.tracks is not None and (intake.tracks or intake.teach), own,
         "a case in PhysTwin's raw layout brings annotated points of its own", "both",
         "Leave it out. To learn from the case's own, write tracks: train in capture.json then."),
        (intake.poses and intake.board, "--poses, --board", "one of the two is required", "both", ""),
        (intake.table_at and (many > 1 or given or posed), "--table-at",
         "is for one camera without poses: others have their world", f"{many} cameras", ""),
        (intake.board_images and not intake.board, "--board", "the board of --board-images must be described", "none", ""),
        (many > 1 and not given and len(posed) < many, "--poses", f"the poses of {many} cameras are required", "none",
         "Give --poses FILE, or --board with an image of a ChArUco board for each camera."),
        (intake.brought and (intake.level or not given), f"--{next(iter(intake.brought), '')}", world, "the table gives the world",
         "Write the points in that world."),
    )
    # fmt: on
    for wrong, option, rule, received, remedy in refused:
        if wrong:
            raise InputError(option, rule, received, remedy)


SHIFT_FORM = re.compile(r"(.+)=([+-]?\d{1,5})")


def shifts(given: Sequence[str], views: Sequence[Paired]) -> dict[str, int]:
    """Pictures that streams are late, by name, of options such as `0.depth=1`. Raises InputError."""
    names = [view.name for view in views]
    known = [*(f"{view.name}.depth" for view in views if view.depth is not None), *names[1:]]
    late = {}
    for text in given:
        match = SHIFT_FORM.fullmatch(text)
        if not match or match[1] not in known:
            raise InputError("--shift", f"STREAM=PICTURES is required, with a stream of {' '.join(known) or 'none'}", text)
        late[match[1]] = int(match[2])
    return late


def _describe(
    intake: Intake, film: Recorded, choice: FrameChoice, rate: float, unit: Unit | None, seen: Seen, placed: Placed
) -> Description:
    """capture.json. Raises InputError."""
    entries = [replace(view.camera(placed.poses[name]).entry(), missing=choice.missing(name)) for name, view in seen.items()]
    cameras = tuple(map(TypeAdapter(CameraEntry).dump_python, entries))
    is_counted = next(iter(seen.values())).unit is not None
    digest = hashlib.sha256()
    used = {view.name: [place for _, place in sorted(choice.places[view.name].items())] for view in film.views}
    for path in dict.fromkeys(path for view in film.views for path in view.files(used[view.name])):
        digest.update(f"{path.name} {digest_file(path)}\n".encode())
    provenance = {"source": "make-capture", "files": f"sha256:{digest.hexdigest()}", "frames": choice.text()}
    if unit is not None:
        provenance["depth unit"] = unit.text()
    provenance |= {"poses": placed.how, "table": placed.table} | ({"taken as": " ".join(intake.take)} if intake.take else {})
    brought = {"intrinsics": intake.intrinsics, "poses file": intake.poses} | intake.brought
    return _parsed(
        {
            "format": 1,
            "name": intake.called,
            "category": intake.category,
            "frame_count": len(choice.numbers),
            "frame_rate": rate,
            "cameras": cameras,
            "tracks": "train" if intake.teach else "score",
            "depth": "none" if unit is None else "measured",
            "depth_unit": unit.meters if unit is not None and is_counted else 0.001,
            "depth_format": "png" if unit is None or is_counted else "npy",
            "pose": intake.pose,
            "up": placed.up,
            "train_end": film.train_end if intake.train_end is None and not intake.frames else intake.train_end,
            "masks": film.labels is not None,
            "mass": intake.mass,
            "provenance": provenance | digests(brought),
        }
    )


def _parsed(entries: dict[str, Any]) -> Description:
    made = parse(Description, entries, "make-capture")
    refuse(description_findings(Path("make-capture"), made))
    return made


@contextmanager
def _begun(
    intake: Intake, made: Description, lenses: Mapping[str, Lens], tracks: np.ndarray | None = None
) -> Iterator[tuple[Writer, bool, points.InSpace]]:
    """A writer of the images, True where the folder holds a part of them already, and what a user brings, which follows them.

    Raises InputError, before anything is written, for points of which no twin can be made.
    """
    folder = intake.output
    space, findings = points.look(Capture(folder, made), intake.brought)
    refuse(findings)
    recipe = TypeAdapter(Description).dump_python(made, mode="json")
    if lenses:
        recipe["distortion"] = {name: [lens.model, *lens.distortion.tolist()] for name, lens in lenses.items()}
    begun = prepare(folder, recipe, intake.force)
    writer = Writer(folder, made)
    yield writer, begun, space
    points.write(folder, space.hands, space.nodes)
    writer.finish(writer.capture.tracks(intake.tracks) if intake.tracks else tracks)
    (folder / capture.RECIPE).unlink()


def _write(writer: Writer, begun: bool, film: Recorded, choice: FrameChoice, unit: Unit | None, seen: Seen, takes: Takes) -> None:
    """The images that are not there yet."""
    made, done = writer.capture.description, 0
    kinds: tuple[Literal["color", "depth"], ...] = ("color",) if unit is None else ("color", "depth")
    progress = Progress(f"make-capture {made.name}", sum(len(places) for places in choice.places.values()))
    for view in film.views:
        straight, matrix = seen[view.name].straight, seen[view.name].lens.matrix
        places = dict(sorted(choice.places[view.name].items()))
        if begun:
            there = [f for f in places if all(writer.capture.path(kind, view.name, f).is_file() for kind in kinds)]
            done += len(there[:-1])  # the last may be half written
            places = {frame: place for frame, place in places.items() if frame not in there[:-1]}
        for frame, (color, depth) in zip(places, view.read(list(places.values())), strict=True):
            stored = None
            if depth is not None and unit is not None:
                kind = stored_as(depth)
                if kind != made.depth_format:
                    raise InputError(view.path, f"depth of camera {view.name} must be of one kind", f"another in frame {frame}")
                stored = takes.depth(view.name, straight.depth(plain(depth)), matrix)
                stored = stored if kind == "png" else meters_of(stored, unit)
            mask = film.labels(view.name, choice.numbers[frame]) if film.labels is not None else None
            writer.frame(view.name, frame, straight.color(color), stored, mask)
            done += 1
            progress.update(done)


def _of_points(intake: Intake) -> tuple[Capture, list[str]]:
    """A capture of points in space alone."""
    brought = intake.brought
    if missing := [f"--{name}" for name in SPACE_OPTIONS if name not in brought]:
        rule = "without --color, --bag and --phystwin-raw, --controllers, --nodes and --tracks are required"
        raise InputError("make-capture", rule, f"no {' '.join(missing)}")
    for option in OF_FILM.split():
        if value := getattr(intake, option):
            rule = "is for film, and there is none"
            remedy = "Leave it out. Cut or resample the files themselves: a row is a frame."
            raise InputError(f"--{option.replace('_', '-')}", rule, str(value), remedy)
    told = [Markers.read(path).rate for path in brought.values() if is_c3d(path)]
    rate, rate_text = find_rate(intake.rate, told, 1, *([MARKERS_FASTEST] if told else []))
    _require_rate(brought, rate)
    frames = len(points.read_hands(brought["controllers"]).points)
    if is_c3d(brought["tracks"]):
        rows = {len(Markers.read(brought["tracks"]).points)}
    else:
        marked = load_json(brought["tracks"])
        rows = {len(track) for track in marked if isinstance(track, list)} if isinstance(marked, list) else set()
    if rows and rows != {frames}:
        value = f"{frames} rows of --controllers, {', '.join(map(str, sorted(rows)))} of --tracks"
        raise InputError("make-capture", "a row per frame is required in both files", value, "Cut or resample one of them.")
    named = {"format": 1, "name": intake.called, "category": intake.category, "frame_count": frames, "frame_rate": rate}
    alone = {"cameras": (), "depth": "none", "tracks": "train", "up": intake.up, "train_end": intake.train_end}
    made = _parsed(named | alone | {"ground": not intake.no_table, "mass": intake.mass, "provenance": digests(brought)})
    with _begun(intake, made, {}) as (_, _, space):
        pass
    lost = int((~np.isfinite(space.annotated).all(axis=2)).sum())
    low, high = (space.nodes.min(axis=0), space.nodes.max(axis=0))
    sides = " x ".join(f"{100 * side:.1f}" for side in high - low)
    hands = 0 if space.hands is None else space.hands.points.shape[1]
    text = f"{hands} controllers, {len(space.nodes)} nodes, {space.tracks.shape[1]} annotated points, {made.frame_count} frames"
    body = f"body: {sides} cm, z from {100 * low[2]:.1f} to {100 * high[2]:.1f} cm; annotated points are unseen {lost} times"
    return Capture.load(intake.output), [f"points in space alone: {text}", rate_text, body]


MARKERS_FASTEST = 2000.0
"""Frames per second of motion capture, at most."""
RATE_APART = 0.005
"""Markers and frames whose rates differ by more than this part are not of the same moments."""


def _require_rate(brought: Mapping[str, Path], rate: float) -> None:
    """Raise InputError where a C3D file has another rate than the capture, frames per second."""
    for name, path in brought.items():
        if is_c3d(path) and abs((told := Markers.read(path).rate) - rate) > RATE_APART * rate:
            rule = f"{path} must have the capture's rate, a row per frame"
            remedy = "Leave --rate out, or resample the markers to the rate of the film."
            raise InputError(f"--{name}", rule, f"{told:g} Hz, not {rate:g}", remedy)


def digests(files: Mapping[str, Path | None]) -> dict[str, str]:
    """Digests of files that a user brings, for the provenance."""
    known = {f"{name} file" if name in SPACE_OPTIONS else name: path for name, path in files.items() if path is not None}
    return {name: f"sha256:{digest_file(plain_file(path))}" for name, path in known.items()}


PRECIOUS = ("mask", "marks.json", "annotations.json", TRACKS, POINTS, *capture.CONTROLLERS, *capture.NODES)
"""Work of people and of hours, which --force does not remove."""


def require_free(folder: Path, force: bool) -> None:
    """Raise InputError for an output folder in which nothing may be written, whatever the input is."""
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "--output must be a folder", "a file")
    made, begun = (folder / CAPTURE).exists(), (folder / capture.RECIPE).exists()
    if not folder.is_dir() or not any(folder.iterdir()) or (begun and not made):
        return
    if not (force and made):
        remedy = "Choose another folder" + (", or give --force, which replaces its images." if made else ".")
        raise InputError(folder, "--output must be a new or empty folder", "a capture" if made else "other files", remedy)
    if kept := [name for name in PRECIOUS if (folder / name).exists()]:
        rule = "--force does not remove masks, marks, clicks or tracks"
        raise InputError(folder, rule, " and ".join(kept), "Move them away first.")


def prepare(folder: Path, recipe: dict[str, Any], force: bool) -> bool:
    """Make `folder` ready for a capture made by `recipe`; returns whether it holds a part of it already.

    Raises InputError for a folder with anything else in it, unless `force` replaces the images of a capture.
    """
    path = folder / capture.RECIPE
    require_free(folder, force)
    if path.exists() and not (folder / CAPTURE).exists():
        if load_json(path) == recipe:
            return True
        if not force:
            remedy = "Choose another folder, or give --force, which replaces its images."
            raise InputError(folder, "--output must be a new or empty folder", "an unfinished capture from other input", remedy)
    if folder.is_dir() and any(folder.iterdir()):
        write_text(path, "{}\n")  # Of no input: what is interrupted here is not taken for a part of the new capture.
        (folder / CAPTURE).unlink(missing_ok=True)
        for kind in ("color", "depth"):
            if (folder / kind).is_dir():
                shutil.rmtree(folder / kind)
    write_text(path, json.dumps(recipe, indent=1) + "\n")
    return False
