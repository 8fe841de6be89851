"""From what cameras gave to a capture folder; never over another one, and from where it was interrupted."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Mapping, Sequence
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
from neuspring.data.camera import Camera, CameraEntry, Lens
from neuspring.data.capture import CAPTURE, POINTS, TRACKS, Capture, Description, Writer, description_findings
from neuspring.extensions.make_capture.feeds import Paired, Recorded
from neuspring.extensions.make_capture.film import cameras_in_step, in_step, looked_at, watch
from neuspring.extensions.make_capture.formats import open_recording, pairs
from neuspring.extensions.make_capture.formats.bag import open_bags
from neuspring.extensions.make_capture.forms import read_lenses, read_poses
from neuspring.extensions.make_capture.lenses import Board, Straightener
from neuspring.extensions.make_capture.options import FILM_OPTIONS, SPACE_OPTIONS, Intake
from neuspring.extensions.make_capture.poses import (
    FrameChoice,
    Placed,
    SampledCamera,
    by_board,
    by_table,
    choose,
    given_alone,
    in_report,
    look,
    meters_of,
    plain,
    stand,
    stored_as,
    straightened,
)
from neuspring.extensions.make_capture.table import Unit, find_rate
from neuspring.extensions.make_capture.takes import Takes
from neuspring.intake import points

NAME_FORM = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,79}")
BOARD_FRAMES = 5
"""Frames of the source, from its beginning, in which a board is looked for where it has no images of its own."""


def opened(intake: Intake) -> Recorded:
    """The film of the cameras; no views of points in space alone. Raises InputError."""
    given = [f"--{name.replace('_', '-')}" for name in FILM_OPTIONS if getattr(intake, name)]
    if len(given) != 1 and (given or not intake.controllers):
        rule = "one of --color with --depth, --recording, --bag, --phystwin-raw is required, or --controllers with --nodes and "
        rule += "--tracks"
        raise InputError("make-capture", rule, " ".join(given) or "none")
    if intake.bag:
        return open_bags(intake.bag, intake.cameras, intake.topics)
    if intake.phystwin_raw:
        return open_recording((intake.phystwin_raw,), "phystwin_raw", intake.cameras)
    if intake.recording:
        return open_recording(intake.recording, intake.format, intake.cameras)
    return Recorded(views=pairs(intake.color, intake.depth, intake.cameras) if intake.color else ())


OF_FILM = (
    "frames",
    "shift",
    "take",
    "depth_unit",
    "intrinsics",
    "poses",
    "board",
    "board_images",
    "level",
    "top_down",
    "table_at",
    "pose",
)
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
    film, board = opened(intake), Board.of(intake.board) if intake.board else None
    views = film.views
    if not views:
        return _of_points(intake)
    if intake.no_table:
        rule = "is for points in space alone: cameras are placed by the table"
        raise InputError("--no-table", rule, "a film", "Leave it out, and write ground: false in capture.json.")
    for option, name in (("--name", intake.called), *(("--cameras", view.name) for view in views)):
        if not NAME_FORM.fullmatch(name):
            raise InputError(option, "letters, digits, '.', '_' and '-' are required, a letter or digit first", repr(name))
    if all(view.depth is None for view in views):
        _require_for_color_alone(intake)
    elif intake.pose:
        raise InputError("--pose", "is for color alone: depth shows how the object is", intake.pose, "Leave it out.")
    if film.tracks is not None and (intake.tracks or intake.teach):
        option = "--tracks" if intake.tracks else "--teach"
        remedy = "Leave it out. To learn from the case's own, write tracks: train in capture.json then."
        raise InputError(option, "a case in PhysTwin's raw layout brings annotated points of its own", "both", remedy)
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
    seen, unit = look(views, choice, listed, intake.intrinsics, intake.depth_unit, takes)
    watched = watch(views, choice, unit)
    findings += in_step(views, watched, late)
    refuse_errors(findings)
    for name, view in seen.items():
        beside = examine("edges", view.path, list(zip(view.colors, view.depths, strict=False)))
        findings += [replace(one, title=f"camera {name}: {one.name}") for one in beside]
    findings += examine("category", intake.output, intake.category)
    placed, how = _place(intake, film, board, seen, unit, takes)
    cameras = {name: Camera(name, *view.size, view.lens.matrix, placed.poses[name]) for name, view in seen.items()}
    findings += cameras_in_step(views, choice, in_space(watched, cameras), late)
    refuse_errors(findings)
    made = _describe(intake, film, choice, rate, unit, seen, placed, how)
    if intake.brought and (intake.level or not (intake.poses or intake.board)):
        rule = "points in space need the world of the cameras: --poses or --board, without --level"
        raise InputError(f"--{next(iter(intake.brought))}", rule, "the table gives the world", "Write the points in that world.")
    made = replace(made, tracks="train" if intake.teach else "score")
    space = brought_by(intake.output, intake.brought, made)
    writer, begun = _begin(intake.output, made, intake.force, {name: view.lens for name, view in seen.items()})
    _write(writer, begun, film, choice, unit, seen, takes)
    tracks = _bring(writer, space, intake.tracks)
    if film.tracks is not None:
        tracks = film.tracks[choice.numbers] @ placed.motion[:3, :3].T + placed.motion[:3, 3]
    writer.finish(tracks)
    (intake.output / capture.RECIPE).unlink()
    sizes = ", ".join(f"{name} {view.size[0]} x {view.size[1]}" for name, view in seen.items())
    depth = "none, color alone" if unit is None else unit.text()
    thin = "thin: no volume is made of it" if intake.category in capture.THIN else "a volume is made of what is seen"
    lines = [f"category: {intake.category}, {thin}", f"cameras: {sizes}"]
    lines += dict.fromkeys(f"intrinsics: {told}" for lens in listed.values() for told in lens.told)
    lines += [Straightener(view.lens, view.size).text(name) for name, view in seen.items() if view.lens.distortion.any()]
    lines += [f"frames: {choice.text()}; {rate_text}", f"depth: {depth}", f"poses: {how}, up {placed.up}"]
    training = made.train_end or int(0.7 * made.frame_count)
    lines += [
        *placed.lines,
        *map(in_report, findings),
        f"training frames: 0 to {training - 1}; future frames: {training} to {made.frame_count - 1}",
    ]
    return Capture.load(intake.output), lines


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


def _require_for_color_alone(intake: Intake) -> None:
    """Raise InputError for options that need depth, and without those that must stand in for it."""
    for option in ("--level", "--top-down", "--table-at", "--depth-unit"):
        if getattr(intake, option[2:].replace("-", "_")):
            raise InputError(option, "needs depth: with color alone the table is z = 0 as the poses say", "no --depth")
    if intake.intrinsics is None:
        remedy = "Give a JSON file with fx, fy, cx, cy. If depth was forgotten, add --depth."
        raise InputError("--intrinsics", "color alone needs the intrinsics of the camera", "none", remedy)
    if intake.poses is None and intake.board is None:
        remedy = "Give --poses FILE, or --board with a ChArUco board on the table. If depth was forgotten, add --depth."
        raise InputError("--poses", "color alone needs the pose of the camera, in a world with the table at z = 0", "none", remedy)


def _place(
    intake: Intake, film: Recorded, board: Board | None, seen: Mapping[str, SampledCamera], unit: Unit | None, takes: Takes
) -> tuple[Placed, str]:
    """Poses of all cameras, and where they come from. Raises InputError."""
    names, level, top_down = list(seen), intake.level, intake.top_down
    given = {view.name: view.pose for view in film.views if view.pose is not None}
    given = takes.poses(given) if len(given) == len(names) else given
    if intake.poses is not None and intake.board is not None:
        raise InputError("--poses, --board", "one of the two is required", "both")
    if intake.table_at is not None and (len(names) > 1 or intake.poses or intake.board or given):
        raise InputError("--table-at", "is for one camera without poses: others have their world", f"{len(names)} cameras")
    if intake.board_images and intake.board is None:
        raise InputError("--board", "the board of --board-images must be described", "none")
    if intake.poses is not None:
        poses, told = read_poses(intake.poses, names)
        poses = takes.poses(poses)
        if unit is None:
            return given_alone(poses, seen, intake.poses), f"of {intake.poses.name}{told}"
        return stand(poses, seen, level=level, top_down=top_down, file=intake.poses), f"of {intake.poses.name}{told}"
    if board is not None:
        shown = dict(seen)
        if not intake.board_images:
            for view in film.views:
                first = list(view.read(range(min(BOARD_FRAMES, len(view.series.numbers)))))
                shown[view.name] = straightened(view, first, seen[view.name].lens, unit, takes)
        poses, lines = by_board(board, shown, intake.board_images)
        if unit is None:
            placed = given_alone(poses, seen, film.views[0].path)
        else:
            placed = stand(poses, seen, level=level, top_down=top_down, up="+z")
        return replace(placed, lines=(*lines, *placed.lines)), f"by a ChArUco board of {intake.board}"
    if len(given) == len(names):
        return stand(given, seen, level=level, top_down=top_down, up=film.up), "of the source"
    if len(names) > 1:
        remedy = "Give --poses FILE, or --board with an image of a ChArUco board for each camera."
        raise InputError("--poses", f"the poses of {len(names)} cameras are required", "none", remedy)
    return by_table(names[0], seen[names[0]], top_down=top_down, at=intake.table_at), "by the table's plane"


def _describe(
    intake: Intake,
    film: Recorded,
    choice: FrameChoice,
    rate: float,
    unit: Unit | None,
    seen: Mapping[str, SampledCamera],
    placed: Placed,
    how: str,
) -> Description:
    """capture.json. Raises InputError."""
    cameras = []
    for name, view in seen.items():
        entry = replace(Camera(name, *view.size, view.lens.matrix, placed.poses[name]).entry(), missing=choice.missing(name))
        cameras.append(TypeAdapter(CameraEntry).dump_python(entry))
    is_counted = next(iter(seen.values())).unit is not None
    digest = hashlib.sha256()
    used = {view.name: [place for _, place in sorted(choice.places[view.name].items())] for view in film.views}
    for path in dict.fromkeys(path for view in film.views for path in view.files(used[view.name])):
        digest.update(f"{path.name} {digest_file(path)}\n".encode())
    provenance = {"source": "make-capture", "files": f"sha256:{digest.hexdigest()}", "frames": choice.text()}
    if unit is not None:
        provenance["depth unit"] = unit.text()
    provenance |= {"poses": how, "table": placed.table} | ({"taken as": " ".join(intake.take)} if intake.take else {})
    files = {"intrinsics": intake.intrinsics, "poses file": intake.poses}
    provenance |= digests({option: path for option, path in files.items() if path is not None}, "")
    entries = {
        "format": 1,
        "name": intake.called,
        "category": intake.category,
        "frame_count": len(choice.numbers),
        "frame_rate": rate,
        "cameras": tuple(cameras),
        "depth": "none" if unit is None else "measured",
        "depth_unit": unit.meters if unit is not None and is_counted else 0.001,
        "depth_format": "png" if unit is None or is_counted else "npy",
        "pose": intake.pose,
        "up": placed.up,
        "train_end": film.train_end if intake.train_end is None and not intake.frames else intake.train_end,
        "masks": film.labels is not None,
        "mass": intake.mass,
        "provenance": provenance | digests(intake.brought),
    }
    return _parsed(entries)


def _parsed(entries: dict[str, Any]) -> Description:
    made = parse(Description, entries, "make-capture")
    refuse(description_findings(Path("make-capture"), made))
    return made


def _begin(folder: Path, made: Description, force: bool, lenses: Mapping[str, Lens]) -> tuple[Writer, bool]:
    """A writer of the capture, and whether the folder holds a part of it already."""
    recipe = TypeAdapter(Description).dump_python(made, mode="json")
    if lenses:
        recipe["distortion"] = {name: [lens.model, *lens.distortion.tolist()] for name, lens in lenses.items()}
    begun = prepare(folder, recipe, force)
    return Writer(folder, made), begun


def _write(
    writer: Writer,
    begun: bool,
    film: Recorded,
    choice: FrameChoice,
    unit: Unit | None,
    seen: Mapping[str, SampledCamera],
    takes: Takes,
) -> None:
    """The images that are not there yet."""
    made, done = writer.capture.description, 0
    kinds: tuple[Literal["color", "depth"], ...] = ("color",) if unit is None else ("color", "depth")
    progress = Progress(f"make-capture {made.name}", sum(len(places) for places in choice.places.values()))
    for view in film.views:
        straight = Straightener(seen[view.name].lens, seen[view.name].size)
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
                stored = takes.depth(view.name, straight.depth(plain(depth)), seen[view.name].lens.matrix)
                stored = stored if kind == "png" else meters_of(stored, unit)
            mask = film.labels(view.name, choice.numbers[frame]) if film.labels is not None else None
            writer.frame(view.name, frame, straight.color(color), stored, mask)
            done += 1
            progress.update(done)


def _of_points(intake: Intake) -> tuple[Capture, list[str]]:
    """A capture of points in space alone."""
    brought, folder = intake.brought, intake.output
    if missing := [f"--{name}" for name in SPACE_OPTIONS if name not in brought]:
        rule = "without --color, --bag and --phystwin-raw, --controllers, --nodes and --tracks are required"
        raise InputError("make-capture", rule, f"no {' '.join(missing)}")
    for option in OF_FILM:
        if value := getattr(intake, option):
            rule = "is for film, and there is none"
            remedy = "Leave it out. Cut or resample the files themselves: a row is a frame."
            raise InputError(f"--{option.replace('_', '-')}", rule, str(value), remedy)
    rate, _ = find_rate(intake.rate, [Markers.read(path).rate for path in brought.values() if is_c3d(path)], 1)
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
    space = brought_by(folder, brought, made)
    writer, _ = _begin(folder, made, intake.force, {})
    writer.finish(_bring(writer, space, intake.tracks))
    (folder / capture.RECIPE).unlink()
    hands = 0 if space.hands is None else space.hands.points.shape[1]
    text = f"{hands} controllers, {len(space.nodes)} nodes, {space.tracks.shape[1]} annotated points, {made.frame_count} frames"
    return Capture.load(folder), [f"points in space alone: {text}"]


RATE_APART = 0.005
"""Markers and frames whose rates differ by more than this part are not of the same moments."""


def _require_rate(brought: Mapping[str, Path], rate: float) -> None:
    """Raise InputError where a C3D file has another rate than the capture, frames per second."""
    for name, path in brought.items():
        if is_c3d(path) and abs((told := Markers.read(path).rate) - rate) > RATE_APART * rate:
            remedy = "Leave --rate out, or resample the markers to the rate of the film."
            raise InputError(
                f"--{name}", f"{path} must have the capture's rate, a row per frame", f"{told:g} Hz, not {rate:g}", remedy
            )


def brought_by(folder: Path, brought: Mapping[str, Path], made: Description) -> points.InSpace:
    """Hands, nodes and points that a user brings, before anything is written. Raises InputError for what no twin can be made of."""
    space, findings = points.look(Capture(folder, made), brought)
    refuse(findings)
    return space


def _bring(writer: Writer, space: points.InSpace, tracks: Path | None) -> np.ndarray | None:
    """Write hands and nodes into the folder; returns the tracks."""
    points.write(writer.capture.folder, space.hands, space.nodes)
    return writer.capture.tracks(tracks) if tracks else None


def digests(files: Mapping[str, Path], what: str = " file") -> dict[str, str]:
    """Digests of files that a user brings, for the provenance."""
    return {f"{name}{what}": f"sha256:{digest_file(plain_file(path))}" for name, path in files.items()}


PRECIOUS = ("mask", "marks.json", "annotations.json", TRACKS, POINTS, *capture.CONTROLLERS, *capture.NODES)
"""Work of people and of hours, which --force does not remove."""


def prepare(folder: Path, recipe: dict[str, Any], force: bool) -> bool:
    """Make `folder` ready for a capture made by `recipe`; returns whether it holds a part of it already.

    Raises InputError for a folder with anything else in it, unless `force` replaces the images of a capture.
    """
    path = folder / capture.RECIPE
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "--output must be a folder", "a file")
    if path.exists() and not (folder / CAPTURE).exists() and load_json(path) == recipe:
        return True
    if folder.is_dir() and any(folder.iterdir()):
        ours = (folder / CAPTURE).exists() or path.exists()
        what = "a capture" if (folder / CAPTURE).exists() else "an unfinished capture from other input" if ours else "other files"
        if not (force and ours):
            remedy = "Choose another folder" + (", or give --force, which replaces its images." if ours else ".")
            raise InputError(folder, "--output must be a new or empty folder", what, remedy)
        if kept := [name for name in PRECIOUS if (folder / name).exists()]:
            rule = "--force does not remove masks, marks, clicks or tracks"
            raise InputError(folder, rule, " and ".join(kept), "Move them away first.")
        write_text(path, "{}\n")  # Of no input: what is interrupted here is not taken for a part of the new capture.
        (folder / CAPTURE).unlink(missing_ok=True)
        for kind in ("color", "depth"):
            if (folder / kind).is_dir():
                shutil.rmtree(folder / kind)
    write_text(path, json.dumps(recipe, indent=1) + "\n")
    return False
