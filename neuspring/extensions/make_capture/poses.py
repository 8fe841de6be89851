"""Before anything is written: which frames are kept, what cameras saw in a few of them (sizes, kinds, intrinsics, unit of depth),
and where the cameras are, by given poses, a ChArUco board or the table alone.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias

import numpy as np

from neuspring.checks import examine
from neuspring.checks.rig import CameraAlone, Judged, Rig, common_plane, flat_share, levelling
from neuspring.checks.things import sampled
from neuspring.core.artifacts import up_sign
from neuspring.core.errors import InputError
from neuspring.core.findings import Finding, refuse_errors
from neuspring.data.camera import Camera, Lens
from neuspring.data.capture import FEWEST_FRAMES
from neuspring.data.planes import cloud
from neuspring.extensions.make_capture.feeds import Pair, Paired, Recorded
from neuspring.extensions.make_capture.formats import open_images
from neuspring.extensions.make_capture.forms import read_poses
from neuspring.extensions.make_capture.lenses import (
    COEFFICIENT_COUNTS,
    MODELS,
    Board,
    Straightener,
    depth_ratio,
    require_lens,
    sight,
)
from neuspring.extensions.make_capture.moments import MISSING_GAP, Match, matched
from neuspring.extensions.make_capture.options import Intake
from neuspring.extensions.make_capture.table import Unit, find_table, find_unit, pose_on
from neuspring.extensions.make_capture.takes import Takes

RANGE_FORM = re.compile(r"(\d+)(?:(-)(\d*))?(?:/(\d+))?")


@dataclass(frozen=True)
class FrameChoice:
    """The frames of a capture."""

    numbers: list[int]
    """Number in the source, per frame of the capture."""
    places: dict[str, dict[int, int]]
    """Camera -> frame of the capture -> place in its view; a frame that the camera lacks is absent."""
    step: int
    """Every so many frames of the source are kept; the rate falls by it."""
    jumps: list[int]
    """Numbers after which more are left out than elsewhere: there time jumps."""
    pairing: dict[str, Match]
    """Camera -> by what its frames belong to those of the first."""

    def missing(self, camera: str) -> tuple[int, ...]:
        """Frames that the camera lacks."""
        return tuple(frame for frame in range(len(self.numbers)) if frame not in self.places[camera])

    def text(self) -> str:
        """The kept frames, in one line."""
        stride = f", one in {self.step}" if self.step > 1 else ""
        return f"{len(self.numbers)} frames, numbers {self.numbers[0]} to {self.numbers[-1]} of the source{stride}"


def chosen(wanted: str, numbers: Sequence[int]) -> list[int]:
    """The members of ascending `numbers` that `wanted` names: `250-335`, `0-`, `0-300/2`, `1,5,9-20`; both ends count.

    Raises InputError for another syntax, or where nothing is left.
    """
    if not wanted:
        return list(numbers)
    kept: set[int] = set()
    for part in wanted.split(","):
        match = RANGE_FORM.fullmatch(part.strip())
        if not match or (match[4] and int(match[4]) < 1) or (match[4] and not match[2]):
            raise InputError("--frames", "ranges like 250-335, 0-, 0-300/2 or 1,5,9-20 are required", repr(part))
        first = int(match[1])
        last = first if not match[2] else int(match[3]) if match[3] else max(numbers, default=first)
        kept |= {number for number in numbers if first <= number <= last and (number - first) % int(match[4] or 1) == 0}
    return sorted(kept)


def choose(views: Sequence[Paired], wanted: str = "", late: Mapping[str, int] | None = None) -> FrameChoice:
    """The frames of all cameras that are kept, numbered as those of the first; with cameras moved that are `late`, in frames.

    See `moments.matched` for which frames of others belong to them. A number that one camera has and another lacks is a missing
    frame of that one. Raises InputError for too few frames, or where cameras have no moments in common.
    """
    first = views[0]
    where, pairing = {first.name: {number: place for place, number in enumerate(first.series.numbers)}}, dict[str, Match]()
    for view in views[1:]:
        names = f"camera {first.name}", f"camera {view.name}"
        found = matched(view.path, names, first.series, view.series, view.numbered)
        pairing[view.name] = found.moved((late or {}).get(view.name, 0), len(view.series.numbers))
        where[view.name] = pairing[view.name].places
    numbers = sorted({number for of in where.values() for number in of})
    kept = chosen(wanted, numbers)
    received = f"{len(kept)} of the numbers {numbers[0]} to {numbers[-1]}" if numbers else "none"
    if len(kept) < FEWEST_FRAMES:
        raise InputError("--frames", f"a capture needs at least {FEWEST_FRAMES} frames", received)
    places = {name: {frame: of[number] for frame, number in enumerate(kept) if number in of} for name, of in where.items()}
    start = next((number for number in kept if all(number in of for of in where.values())), None)
    for view in views:
        if len(places[view.name]) < len(kept) / 2 or 0 not in places[view.name]:
            rule = f"camera {view.name} must have the first of the chosen frames, number {kept[0]}, and half of the others"
            remedy = "Name the images of all cameras by the same frame numbers"
            remedy += f"; the first that all have is {start}." if start not in (None, kept[0]) else "."
            raise InputError(view.path, rule, f"{len(places[view.name])} of {len(kept)}", remedy)
    # The rate is that of the files that are there; a number that is not there is a moment that is missing.
    step = int(np.diff(np.searchsorted(numbers, kept)).min())
    gaps = [after - before for before, after in pairwise(kept)]
    jumps = [number for number, gap in zip(kept, gaps, strict=False) if gap > MISSING_GAP * min(gaps)]
    return FrameChoice(kept, places, step, jumps, pairing)


@dataclass(frozen=True, eq=False)
class SampledCamera:
    """A few frames of a camera."""

    name: str
    path: Path
    size: tuple[int, int]
    """(width, height)."""
    lens: Lens
    straight: Straightener
    colors: list[np.ndarray]
    """[H, W, 3] uint8 RGB, without distortion."""
    depths: list[np.ndarray]
    """[H, W], m, without distortion; none with color alone."""
    unit: float | None
    """m per count of its images; None where they are floating point, or there are none."""
    flat: dict[str, float]
    """Model of the distortion, its own first -> share of the pixels with depth that are then on one plane; none without any."""

    def camera(self, pose: np.ndarray) -> Camera:
        """The camera at a pose, camera to world [4, 4], m."""
        return Camera(self.name, *self.size, self.lens.matrix, pose)


Seen: TypeAlias = Mapping[str, SampledCamera]
Poses: TypeAlias = Mapping[str, np.ndarray]


def look(
    intake: Intake, views: Sequence[Paired], choice: FrameChoice, listed: Mapping[str, Lens], takes: Takes
) -> tuple[dict[str, SampledCamera], Unit | None]:
    """A few of the chosen frames of every camera, with intrinsics, and the unit of depth, which is one for all; None without any.

    `listed` are the intrinsics of --intrinsics; those of the source count where there are none. Raises InputError.
    """
    samples, lenses, file, given_unit = dict[str, list[Pair]](), dict[str, Lens](), intake.intrinsics, intake.depth_unit
    for view in views:
        frames = sorted(choice.places[view.name])
        picked = [choice.places[view.name][frames[k]] for k in sorted(sampled(len(frames)))]
        samples[view.name] = list(view.read(picked))
        lens = listed.get(view.name) or view.lens
        if lens is None:
            remedy = "Give a JSON file with fx, fy, cx, cy."
            raise InputError("--intrinsics", f"intrinsics of camera {view.name} are required", "none", remedy)
        size = _size_of(samples[view.name])
        lenses[view.name] = takes.lens(view.name, lens, size)
        require_lens(file or view.path, view.name, lenses[view.name], size)
    depths = [depth for pairs in samples.values() for _, depth in pairs if depth is not None]
    if len({stored_as(depth) for depth in depths}) > 1:
        raise InputError("--depth", "all depth images must be of one kind, 16-bit integers or another", "both")
    known = {view.unit for view in views}
    if len(known) > 1 and given_unit is None:
        raise InputError("--depth-unit", "all cameras must have one unit of depth", " and ".join(sorted(map(str, known))))
    stated, source = next((lens.unit for lens in listed.values()), None), known.pop() if len(known) == 1 else None
    for other, value in (("--depth-unit", given_unit), (views[0].path, source)):
        if depths and stated and value and not np.isclose(value, stated, rtol=0.01):
            rule = f"its unit of depth must be that of {other}, {value:g} m per count"
            raise InputError(file, rule, f"{stated:g} m per count", "Correct the one that is wrong, or leave it out.")
    where = views[0].path if file is None or stated is None else file
    unit = find_unit(where, depths, given_unit, stated or source) if depths else None
    return {view.name: straightened(view, samples[view.name], lenses[view.name], unit, takes) for view in views}, unit


def straightened(view: Paired, pairs: Sequence[Pair], lens: Lens, unit: Unit | None, takes: Takes) -> SampledCamera:
    """Pairs of one camera, without distortion and in meters; `unit` is None with color alone."""
    straight = Straightener(lens, _size_of(pairs))
    colors, depths = [straight.color(color) for color, _ in pairs], [depth for _, depth in pairs if depth is not None]
    meters = [meters_of(takes.depth(view.name, straight.depth(plain(one)), lens.matrix), unit) for one in depths if unit]
    flat = {}
    if unit is not None and lens.distortion.any():
        models = (MODELS[lens.model], *(model for model, counts in COEFFICIENT_COUNTS.items() if len(lens.distortion) in counts))
        for model in dict.fromkeys(models):
            other = Straightener(replace(lens, model=model), _size_of(pairs))
            flat[model] = flat_share([meters_of(other.depth(plain(one)), unit) for one in depths], lens.matrix)
    counted = unit.meters if unit is not None and stored_as(depths[0]) == "png" else None
    return SampledCamera(view.name, view.path, _size_of(pairs), lens, straight, colors, meters, counted, flat)


def _size_of(pairs: Sequence[Pair]) -> tuple[int, int]:
    """(width, height)."""
    return pairs[0][0].shape[1], pairs[0][0].shape[0]


def stored_as(depth: np.ndarray) -> str:
    """The form in which the capture stores it: 16-bit counts as png, anything else as npy in meters."""
    return "png" if depth.dtype == np.uint16 else "npy"


def plain(depth: np.ndarray) -> np.ndarray:
    """Counts, or floating point without what is no depth."""
    return depth if depth.dtype == np.uint16 else np.nan_to_num(depth.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0).clip(0)


def meters_of(depth: np.ndarray, unit: Unit) -> np.ndarray:
    """Depth in meters, of counts."""
    return (depth * unit.meters).astype(np.float32)


BOARD_FRAMES = 5
"""Frames of the source, from its beginning, in which a board is looked for where it has no images of its own."""
RATIO = 0.04
"""Depth may differ by this part from the distance of the board by its printed size."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """Poses of the cameras."""

    poses: Poses
    """Camera to world [4, 4], m."""
    up: str = "+z"
    how: str = "by the table's plane"
    """Origin of the poses, in words."""
    motion: np.ndarray = field(default_factory=lambda: np.eye(4))
    """[4, 4]: from the world of the given poses to this one."""
    table: str = "not found"
    """Fit of its plane, in words."""
    lines: tuple[str, ...] = ()
    """Lines of the report."""


def place(intake: Intake, film: Recorded, board: Board | None, seen: Seen, unit: Unit | None, takes: Takes) -> Placed:
    """Poses of all cameras: by a file, a board, the source, or the table alone. Raises InputError."""
    poses: Poses = {view.name: view.pose for view in film.views if view.pose is not None}
    how, where, up, lines = "of the source", film.views[0].path, film.up, list[str]()
    if intake.poses is not None:
        poses, told = read_poses(intake.poses, list(seen))
        how, where, up = f"of {intake.poses.name}{told}", intake.poses, None
    elif board is not None:
        shown = dict(seen)
        for view in () if intake.board_images else film.views:
            first = list(view.read(range(min(BOARD_FRAMES, len(view.series.numbers)))))
            shown[view.name] = straightened(view, first, seen[view.name].lens, unit, takes)
        poses, lines = by_board(board, shown, intake.board_images)
        how, up = f"by a ChArUco board of {intake.board}", "+z"
    if len(poses) < len(seen):
        return by_table(next(iter(seen.values())), intake.top_down, intake.table_at, takes.with_more)
    poses = poses if board is not None else takes.poses(poses)
    if unit is None:
        placed = given_alone(poses, seen, where)
    else:
        placed = stand(poses, seen, where, intake.level, intake.top_down, up, takes.with_more)
    return replace(placed, lines=(*lines, *placed.lines), how=how)


def by_table(seen: SampledCamera, top_down: bool, at: tuple[float, float] | None, taken: Callable[[str], str]) -> Placed:
    """The pose of the only camera: the table is z = 0. Raises InputError where it is not found; see `table.find_table`."""
    points = cloud(seen.depths, seen.lens.matrix)
    table, remarks = find_table(seen.path, points, top_down=top_down, at=None if at is None else _point(seen, at))
    poses = {seen.name: pose_on(table, points, seen.size, seen.lens.matrix)}
    rig = rig_of({seen.name: seen}, poses, posed=False)
    judged = _judged("rig", seen.path, Judged(rig, {seen.name: seen.unit}, taken=taken))
    lines = (f"table: {table.text()}", *(f"warning: {remark}" for remark in remarks), *judged)
    return Placed(poses=poses, table=table.text(), lines=lines)


def _judged(kind: str, where: Path, subject: object) -> list[str]:
    """Lines of the report. Raises InputError with the first finding that is an error."""
    found = examine(kind, where, subject)
    refuse_errors(found)
    return [in_report(one) for one in found]


def rig_of(seen: Seen, poses: Poses, posed: bool = True) -> Rig:
    """The cameras together."""
    depths = {name: view.depths for name, view in seen.items()}
    first = {name: listed[0] for name, listed in depths.items()}
    return Rig({name: view.camera(poses[name]) for name, view in seen.items()}, depths, first, posed=posed)


def by_board(board: Board, seen: Seen, images: Sequence[Path]) -> tuple[Poses, list[str]]:
    """Poses by a board that lies still: in `images`, an image or a folder of them per camera, else in the frames themselves.

    Returns them with lines of the report. Raises InputError where the board is not seen, or depth contradicts its size.
    """
    if images and len(images) != len(seen):
        raise InputError("--board-images", f"one image or folder per camera is required: {len(seen)}", len(images))
    poses, lines = {}, []
    for index, (name, view) in enumerate(seen.items()):
        path = images[index] if images else view.path
        pictures = _pictures(path, view) if images else view.colors
        sighting = sight(path, board, pictures, view.lens.matrix)
        poses[name] = sighting.camera_to_world
        line = f"board, camera {name}: {len(sighting.pixels)} corners, {sighting.error:.2f} pixels rms"
        if view.depths and not images:
            ratios = [ratio for depth in view.depths if (ratio := depth_ratio(sighting, depth))]
            ratio = float(np.median(ratios)) if ratios else 1.0
            if abs(ratio - 1) > RATIO:
                wrong = f"the square is {ratio:.3g} times as long as --board says, or --depth-unit is off by {1 / ratio:.3g}"
                rule = f"depth must place the board where its size does, within {RATIO:.0%}"
                raise InputError(path, rule, f"{ratio:.3f} times as far", f"Either {wrong}.")
            line += f", depth {ratio:.3f} of its distance" if ratios else "; too little depth on it to check its size"
        lines.append(line)
    return poses, lines


def stand(poses: Poses, seen: Seen, file: Path, level: bool, top_down: bool, up: str | None, taken: Callable[[str], str]) -> Placed:
    """Given poses, of `file`, against the table that the cameras see; with `level` the world is moved so that it is z = 0.

    `up` is that of the source; None: +z where the world is moved, else the side on which the cameras are. Raises InputError where
    the table is elsewhere, with what explains it; see `checks.rig`.
    """
    moved, motion, lines = poses, np.eye(4), list[str]()
    if level:
        # A world that is to be moved may have any axes: up is then that of the image.
        clouds = {name: cloud(view.depths, view.lens.matrix) for name, view in seen.items()}
        tables = {name: find_table(view.path, clouds[name], top_down=top_down)[0] for name, view in seen.items()}
        normal, point, rms = common_plane(tables, poses)
        up = up or "+z"
        motion = levelling(normal, point, up_sign(up))
        moved = {name: motion @ pose for name, pose in poses.items()}
        turn = float(np.degrees(np.arccos(np.clip((np.trace(motion[:3, :3]) - 1) / 2, -1, 1))))
        rise = f"its plane was {100 * abs(point[2]):.1f} cm from z = 0 there, {1e3 * rms:.1f} mm rms over all cameras"
        lines.append(f"leveled: the world was turned by {turn:.1f} degrees; {rise}")
    rig = rig_of(seen, moved)
    side = up or min(("+z", "-z"), key=lambda each: sum(rig.elsewhere(up=each).standing.values()))
    rig = rig.elsewhere(up=side)
    lines += _judged("rig", file, Judged(rig, {name: view.unit for name, view in seen.items()}, False, taken))
    text = "; ".join(f"camera {name}: {plane.text()}" for name, (plane, _) in rig.stands.items())
    return Placed(poses=moved, up=side, motion=motion, table=text or "not found", lines=tuple(lines))


def given_alone(poses: Poses, seen: Seen, where: Path) -> Placed:
    """A given pose without depth: the table is z = 0 as it says, and up the side of it on which the camera is.

    Raises InputError naming `where` the pose comes from, where the camera does not look at such a table; see `checks.rig`.
    """
    view, pose = next(iter(seen.values())), next(iter(poses.values()))
    up = "+z" if pose[2, 3] > 0 else "-z"
    judged = _judged("camera alone", where, CameraAlone(view.camera(pose), up))
    return Placed(poses=poses, up=up, table="z = 0 as given", lines=tuple(judged))


def in_report(one: Finding) -> str:
    """A finding as a line of the report."""
    return f"warning: {one.message}" if one.level == "warning" else one.message


def _point(seen: SampledCamera, at: tuple[float, float]) -> np.ndarray:
    """The point [3], m, in the camera's coordinates, at pixel (x, y): the median around it. Raises InputError without depth."""
    x, y = round(at[0]), round(at[1])
    if not (0 <= x < seen.size[0] and 0 <= y < seen.size[1]):
        raise InputError("--table-at", f"a pixel of the {seen.size[0]} x {seen.size[1]} image is required", f"{at[0]:g} {at[1]:g}")
    around = np.stack(seen.depths)[:, max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
    if not (around > 0).any():
        raise InputError("--table-at", "a pixel with depth is required", f"none at {x} {y}", "Name another pixel of the table.")
    return np.asarray(np.median(around[around > 0]) * (np.linalg.inv(seen.lens.matrix) @ [x, y, 1.0]))


def _pictures(path: Path, view: SampledCamera) -> list[np.ndarray]:
    """Images of a board, without distortion."""
    source = open_images(path if path.is_dir() else path.parent, "color")
    places = [k for k, file in enumerate(source.files(range(len(source.series.numbers)))) if path.is_dir() or file == path]
    if not places:
        raise InputError(path, "an image of the board, or a folder of them, is required", "nothing there")
    pictures = []
    for picture in source.read(places):
        if picture.shape[1::-1] != view.size:
            rule = f"images of the board must have the size of the camera's images, {view.size[0]} x {view.size[1]}"
            raise InputError(path, rule, f"{picture.shape[1]} x {picture.shape[0]}")
        pictures.append(view.straight.color(picture))
    return pictures
