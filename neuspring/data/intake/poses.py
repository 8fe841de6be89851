"""Poses of the cameras, from a ChArUco board or the table alone, and how they stand on the table that the cameras see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from neuspring.core.artifacts import up_sign
from neuspring.core.errors import InputError
from neuspring.data.capture import Camera
from neuspring.data.departure import refuse
from neuspring.data.intake.charuco import Board, Sighting, depth_ratio, sight
from neuspring.data.intake.images import open_images
from neuspring.data.intake.lenses import Straightener
from neuspring.data.intake.look import Seen
from neuspring.data.intake.plane import Plane, cloud, planes
from neuspring.data.intake.world import center_of, common_plane, find_table, levelling, pose_on
from neuspring.data.plausible.alone import alone_departures
from neuspring.data.plausible.table import table_departures

RATIO = 0.04
"""Depth may differ by this part from the distance of the board by its printed size."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """Where the cameras are."""

    poses: dict[str, np.ndarray]
    """Camera to world [4, 4], m."""
    up: str = "+z"
    motion: np.ndarray = field(default_factory=lambda: np.eye(4))
    """[4, 4]: from the world of the given poses to this one."""
    table: str = "not found"
    """How well its plane fits."""
    lines: tuple[str, ...] = ()
    """Of the report."""


def by_table(name: str, seen: Seen, *, top_down: bool, at: tuple[float, float] | None) -> Placed:
    """The pose of the only camera: the table is z = 0. Raises InputError where it is not found; see `world.find_table`."""
    points = cloud(seen.depths, seen.lens.matrix)
    table = find_table(seen.path, points, top_down=top_down, at=None if at is None else _point(seen, at))
    pose = pose_on(table.plane, points, center_of(seen.size, seen.lens.matrix))
    text = table.plane.text()
    lines = (f"table: {text}", *(f"warning: {remark}" for remark in table.remarks))
    return Placed(poses={name: pose}, table=text, lines=lines)


def by_board(board: Board, seen: Mapping[str, Seen], images: Sequence[Path]) -> tuple[dict[str, np.ndarray], list[str]]:
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
        line = f"board, camera {name}: {sighting.corners} corners, {sighting.error:.2f} pixels rms"
        lines.append(line if images or not view.depths else line + _compare(path, sighting, view))
    return poses, lines


def stand(
    poses: Mapping[str, np.ndarray], seen: Mapping[str, Seen], *, level: bool, top_down: bool = False, up: str | None = None
) -> Placed:
    """Given poses against the table that the cameras see; with `level` the world is moved so that it is z = 0.

    `up` is that of the source; None: +z where the world is moved, else the side on which the cameras are. Raises InputError where
    the table is elsewhere, with what explains it; see `plausible.table`.
    """
    clouds = {name: cloud(view.depths, view.lens.matrix) for name, view in seen.items()}
    moved, motion, lines, tables = dict(poses), np.eye(4), list[str](), dict[str, Plane]()
    for name, view in seen.items():
        try:
            # A world that is to be moved may have any axes: up is then that of the image.
            upright = None if level else poses[name]
            tables[name] = find_table(view.path, clouds[name], pose=upright, top_down=top_down).plane
            lines.append(f"table, camera {name}: {tables[name].text()}")
        except InputError as error:
            if level:
                raise
            lines.append(f"warning: {error}")
    if level:
        normal, point, rms = common_plane(tables, poses)
        up = up or "+z"
        motion = levelling(normal, point, up_sign(up))
        moved = {name: motion @ pose for name, pose in poses.items()}
        turn = float(np.degrees(np.arccos(np.clip((np.trace(motion[:3, :3]) - 1) / 2, -1, 1))))
        rise = f"its plane was {100 * abs(point[2]):.1f} cm from z = 0 there, {1e3 * rms:.1f} mm rms over all cameras"
        lines.append(f"leveled: the world was turned by {turn:.1f} degrees; {rise}")
    found = {name: planes(points) for name, points in clouds.items()}
    judged = {
        side: [
            d for name, view in seen.items() for d in table_departures(view.path, name, found[name], moved[name], side, view.unit)
        ]
        for side in ([up] if up else ["+z", "-z"])
    }
    side = min(judged, key=lambda key: sum(d.level == "error" for d in judged[key]))
    refuse([d for d in judged[side] if d.level == "error"])
    lines += [f"{'warning: ' if d.level == 'warning' else ''}{d.message}" for d in judged[side]]
    text = "; ".join(f"camera {name}: {plane.text()}" for name, plane in tables.items())
    return Placed(poses=moved, up=side, motion=motion, table=text or "not found", lines=tuple(lines))


def given_alone(poses: Mapping[str, np.ndarray], seen: Mapping[str, Seen], where: Path) -> Placed:
    """A given pose without depth: the table is z = 0 as it says, and up the side of it on which the camera is.

    Raises InputError naming `where` the pose comes from, where the camera does not look at such a table; see `plausible.table`.
    """
    (name, view), pose = next(iter(seen.items())), next(iter(poses.values()))
    up = "+z" if pose[2, 3] > 0 else "-z"
    judged = alone_departures(where, Camera(name, *view.size, view.lens.matrix, pose), up)
    refuse([d for d in judged if d.level == "error"])
    lines = tuple(f"{'warning: ' if d.level == 'warning' else ''}{d.message}" for d in judged)
    return Placed(poses=dict(poses), up=up, table="z = 0 as given", lines=lines)


def _point(seen: Seen, at: tuple[float, float]) -> np.ndarray:
    """The point [3], m, in the camera's coordinates, at pixel (x, y): the median around it. Raises InputError without depth."""
    x, y = round(at[0]), round(at[1])
    if not (0 <= x < seen.size[0] and 0 <= y < seen.size[1]):
        raise InputError("--table-at", f"a pixel of the {seen.size[0]} x {seen.size[1]} image is required", f"{at[0]:g} {at[1]:g}")
    around = np.stack(seen.depths)[:, max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
    if not (around > 0).any():
        raise InputError("--table-at", "a pixel with depth is required", f"none at {x} {y}", "Name another pixel of the table.")
    return np.asarray(np.median(around[around > 0]) * (np.linalg.inv(seen.lens.matrix) @ [x, y, 1.0]))


def _pictures(path: Path, view: Seen) -> list[np.ndarray]:
    """Images of a board, without distortion."""
    source = open_images(path if path.is_dir() else path.parent, "color")
    places = [k for k, file in enumerate(source.files(range(len(source.numbers)))) if path.is_dir() or file == path]
    if not places:
        raise InputError(path, "an image of the board, or a folder of them, is required", "nothing there")
    straight, pictures = Straightener(view.lens, view.size), []
    for picture in source.read(places):
        if picture.shape[1::-1] != view.size:
            rule = f"images of the board must have the size of the camera's images, {view.size[0]} x {view.size[1]}"
            raise InputError(path, rule, f"{picture.shape[1]} x {picture.shape[0]}")
        pictures.append(straight.color(picture))
    return pictures


def _compare(path: Path, sighting: Sighting, view: Seen) -> str:
    """The board's distance by depth. Raises InputError where it contradicts the board's size."""
    ratios = [ratio for depth in view.depths if (ratio := depth_ratio(sighting, depth))]
    if not ratios:
        return "; too little depth on it to check its size"
    ratio = float(np.median(ratios))
    if abs(ratio - 1) > RATIO:
        remedy = f"Either the square is {ratio:.3g} times as long as --board says, or --depth-unit is off by {1 / ratio:.3g}."
        rule = f"depth must place the board where its size does, within {RATIO:.0%}"
        raise InputError(path, rule, f"{ratio:.3f} times as far", remedy)
    return f", depth {ratio:.3f} of its distance"
