"""Controllers, nodes and annotated points in space, with or without video.

    controllers.npz    points [T, C, 3]; optional: holds [T, C] bool (default: all hold), hand [C] int (default: not grouped); or
                       poses [T, H, 4, 4], hand to world; optional: jaws [H, C, 3], points that a hand carries, holds [T, H]
    controllers.csv    points as rows, header frame,point,x,y,z[,holds][,hand]; frames from 0, holds 0 or 1
    nodes.npz | .ply   points [N, 3], or vertices: the object in frame 0
    rest.npz           optional, without cameras: points [K + N + C, 3], annotated points, nodes, controllers of the unloaded shape
    tracks.json        annotated points (capture.py); with `tracks: train` the fit uses those of training frames

All coordinates are in meters, in the capture's world. Files in another form, unit or axis convention raise InputError, which names
the likely cause.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from neuspring.checks import examine
from neuspring.checks.moving import Moving
from neuspring.checks.space import SAME, travel
from neuspring.checks.timing import Streams, follows
from neuspring.config import Config, ScenarioRow
from neuspring.core.artifacts import Observations, Scenario
from neuspring.core.errors import InputError
from neuspring.core.files import NPZ_FAULTS, foreign, write_atomically
from neuspring.core.findings import Finding, broken, refusal, refuse
from neuspring.core.geometry import on_table
from neuspring.core.records import digest_file
from neuspring.data.c3d import Markers, is_c3d
from neuspring.data.capture import CAPTURE, CONTROLLERS, NODES, REST, TRACKS, Capture, Description

CSV_COLUMNS = ("frame", "point", "x", "y", "z", "holds", "hand")
"""Columns of controllers.csv; the last two are optional."""
JAWS = 0.03 * np.concatenate([np.zeros((1, 3)), np.eye(3)])
"""Default points of a hand with a pose, m in its frame: the origin, and one point along each axis."""
RIGID = 1e-4
"""Allowed deviation from R^T R = 1 of a pose."""
UNSEEN_ROW = (
    "Write null in place of [x, y, z] in frames in which a point is not seen",
    "Interpolate these frames, or set `holds` to 0 in them",
)
"""Next moves for invalid positions in tracks.json and in controllers."""
LEAST_NODES = 3
"""Fewest points that determine the orientation of an object."""


@dataclass(frozen=True, eq=False)
class Hands:
    """Controllers: points that move the object."""

    points: np.ndarray
    """[T, C, 3], m."""
    holds: np.ndarray
    """[T, C] bool: when each controller holds the object; empty: all always hold."""
    hand: np.ndarray
    """[C] int: the hand of each controller; empty: not grouped."""


@dataclass(frozen=True, eq=False)
class InSpace:
    """Points in space of a capture."""

    hands: Hands | None
    nodes: np.ndarray
    """[N, 3], m; N = 0: not given."""
    tracks: np.ndarray
    """[T, K, 3], m, NaN where not annotated: annotated points that the fit uses; K = 0 if they are only for scoring."""
    annotated: np.ndarray
    """[T, K, 3], m, NaN where not annotated: all annotated points."""
    rest: np.ndarray
    """[K + N + C, 3], m: annotated points, nodes and controllers of the unloaded shape; empty: frame 0 has no load."""

    def turned(self, rotation: np.ndarray) -> InSpace:
        """All points, rotated by `rotation` [3, 3] about the origin."""
        hands = replace(self.hands, points=self.hands.points @ rotation.T) if self.hands else None
        return InSpace(hands, *(points @ rotation.T for points in (self.nodes, self.tracks, self.annotated, self.rest)))


def given(folder: Path, names: tuple[str, ...]) -> Path | None:
    """The file with one of `names` in a capture's folder; None without any. Raises InputError for two."""
    files = [folder / name for name in names if (folder / name).exists()]
    if len(files) > 1:
        raise InputError(folder, f"only one of {' and '.join(names)} is allowed", "both", "Remove one of them.")
    return files[0] if files else None


def read(capture: Capture) -> InSpace:
    """Read controllers, nodes and points of a capture. Raises InputError with file and key if they cannot make a twin."""
    space, findings = look(capture)
    refuse(findings)
    return space


def look(capture: Capture, brought: Mapping[str, Path] | None = None) -> tuple[InSpace, list[Finding]]:
    """Read the controllers, nodes and points of a capture that are readable, and return every finding about them.

    `brought` maps `controllers`, `nodes` and `tracks` to files that are not in the capture's folder yet.
    """
    folder, description, findings = capture.folder, capture.description, list[Finding]()

    def attempt(reader: Callable[..., Any], *values: Any) -> Any:
        try:
            return reader(*values)
        except InputError as error:
            findings.append(refusal(error))

    files: dict[str, Path | None] = dict(brought or {})
    if brought is None:
        files = {"controllers": attempt(given, folder, CONTROLLERS), "nodes": attempt(given, folder, NODES)}
    for what, names in (("controllers", CONTROLLERS), ("nodes", NODES)):
        if not files.get(what) and not findings and not description.cameras:
            findings.append(broken(folder / names[0], "", f"a capture without cameras needs {' or '.join(names)}", "no such file"))
    tracks_file, none = files.get("tracks") or folder / TRACKS, np.zeros((capture.frame_count, 0, 3))
    hands = attempt(read_hands, file, capture.frame_count) if (file := files.get("controllers")) else None
    nodes: Any = attempt(read_nodes, files["nodes"]) if files.get("nodes") else None
    annotated = attempt(capture.tracks, tracks_file)
    nodes, annotated = none[0] if nodes is None else nodes, none if annotated is None else annotated
    # Controllers may be anywhere while they hold nothing.
    held_at = none if hands is None else np.where(hands.holds[..., None] if hands.holds.size else True, hands.points, np.nan)
    moving = [Moving(points, description.frame_rate) for points in (annotated, held_at)]
    for where, one, remedy in zip((tracks_file, file), moving, UNSEEN_ROW, strict=True):
        findings += examine("moving", where, one, remedy) if one.given.size else []
    # Invalid positions must not affect the checks of unit and table.
    seen, places = (one.points for one in moving)
    rest, shape = None, folder / REST
    # Without the required controllers, the expected number of points is unknown.
    if shape.exists() and (hands or description.cameras):
        rest = attempt(read_rest, shape, seen.shape[1] + len(nodes) + places.shape[1], description)
    taught = seen if description.tracks == "train" else none
    space = InSpace(hands, nodes, taught, seen, none[0] if rest is None else rest)
    first = seen[0][np.isfinite(seen[0]).all(axis=1)]
    if description.tracks == "train" and len(first) < LEAST_NODES:
        rule = f"with tracks: train, at least {LEAST_NODES} points must be annotated in frame 0, where the twin starts"
        findings.append(broken(tracks_file, "", rule, f"{len(first)} of {seen.shape[1]}"))
    ground, moved = description.up_sign if description.ground else None, travel(np.concatenate([seen, places], axis=1))
    for where, points in ((files.get("nodes"), nodes), (tracks_file, seen), (file, places)):
        known = points[np.isfinite(points).all(axis=-1)]
        findings += examine("points", where, known, ground, moved) if where is not None and len(known) else []
    if len(nodes) and not any(one.level == "error" for one in findings):
        findings += examine("points on nodes", tracks_file, seen[0], nodes)
        findings += _holding(capture, space, places, first, file) if hands is not None and file is not None else []
    return space, findings


def _holding(capture: Capture, space: InSpace, places: np.ndarray, first: np.ndarray, file: Path) -> list[Finding]:
    """Findings about controllers and the object.

    `places` [T, C, 3] are controllers, NaN while they hold nothing; `first` [n, 3] are the annotated points of frame 0.
    """
    assert space.hands is not None
    taught = places[: capture.train_end]
    holding = taught[np.isfinite(taught).all(axis=2)]
    if not len(holding):
        rule = "at least one controller must hold the object in a training frame"
        return [broken(file, "holds", rule, f"none before frame {capture.train_end}")]
    findings = examine("holding", file, holding, space.nodes)
    near = cKDTree(np.concatenate([space.nodes, first])).query(held(space.hands, space.annotated, capture.train_end)[0])[0]
    if (near < SAME).any():
        rule = f"controllers must be at least {1e3 * SAME:g} mm from nodes and annotated points in frame 0"
        findings.append(broken(file, "points", rule, f"controller {near.argmin()}, {(near < SAME).sum()} in all"))
    if (shift := follows(space.hands.points, space.annotated)) and shift.wrong:
        rows = "Shift the rows of the annotated points by {frames}."
        findings += examine("streams", file, [Streams("the hands", "the annotated points", shift, rows)])
    return findings


def read_hands(path: Path, frames: int | None = None) -> Hands:
    """Read controllers.npz, controllers.csv or markers of a C3D file; `frames` is the required number. Raises InputError."""
    if is_c3d(path):
        arrays = {"points": Markers.read(path).whole(path)}
    else:
        arrays = _rows(path) if path.suffix == ".csv" else _arrays(path, ("points", "holds", "hand"), ("poses", "jaws", "holds"))
        if "poses" in arrays:
            arrays = _of_poses(path, arrays)
    points = _places(path, arrays["points"], 3)
    count, number = points.shape[:2]
    if frames is not None and count != frames:
        rule = f"{frames} frames are required, the frame_count of {CAPTURE}"
        raise InputError(path, rule, count, "Cut or resample the file to one row per frame of the capture.")
    if not number:
        raise InputError(path, "at least one controller is required", "none")
    holds, hand = arrays.get("holds", np.zeros((0, 0), bool)), arrays.get("hand", np.zeros(0, int))
    for key, value, shape, kinds in (("holds", holds, (count, number), "b"), ("hand", hand, (number,), "iu")):
        if value.size and (value.shape != shape or value.dtype.kind not in kinds):
            wanted = f"{list(shape)} {'bool' if kinds == 'b' else 'int'}"
            raise InputError(path, f"{key}: must be {wanted}", f"{list(value.shape)} {value.dtype}")
    if holds.size and not holds.any():
        raise InputError(
            path, "holds: some controller must hold in a frame", "none", "Remove `holds` if all controllers always hold."
        )
    return Hands(points, holds if holds.size and not holds.all() else np.zeros((0, 0), bool), hand)


def read_nodes(path: Path) -> np.ndarray:
    """Read nodes [N, 3], m, from nodes.npz or the vertices of nodes.ply. Raises InputError."""
    if path.suffix == ".npz":
        nodes = _arrays(path, ("points",))["points"]
    else:
        import trimesh

        try:
            body: Any = trimesh.load(path, process=False)
            nodes = np.array(body.vertices)
        except Exception as error:  # A damaged file can raise any exception in trimesh.
            name, remedy = foreign(path)
            received = name or f"{type(error).__name__}: {error}"
            raise InputError(path, "vertices of a PLY file are required", received, remedy) from error
    nodes = _places(path, nodes, 2)
    if len(nodes) < LEAST_NODES:
        raise InputError(path, f"at least {LEAST_NODES} nodes are required", len(nodes))
    pairs = cKDTree(nodes).query_pairs(SAME, output_type="ndarray")
    if len(pairs):
        rule = f"nodes must be at least {1e3 * SAME:g} mm apart"
        value = f"{len(pairs)} pairs, first nodes {pairs[0][0]} and {pairs[0][1]}"
        raise InputError(path, rule, value, "Remove duplicate nodes with np.unique(points, axis=0).")
    return nodes


def read_rest(path: Path, count: int, description: Description) -> np.ndarray:
    """Read the unloaded shape [count, 3], m. Raises InputError."""
    if description.cameras:
        raise InputError(path, "an unloaded shape is only for captures without cameras", "cameras", "Remove the file.")
    points = _places(path, _arrays(path, ("points",))["points"], 2)
    if len(points) != count:
        rule = f"points: {count} points are required: annotated points, nodes and controllers, in this order"
        raise InputError(path, rule, len(points))
    return points


def _of_poses(path: Path, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays points, hand and holds from poses [T, H, 4, 4], or [T, 4, 4] of one hand. Raises InputError."""
    poses, jaws = arrays["poses"], arrays.get("jaws", JAWS)
    poses = poses[:, None] if poses.ndim == 3 else poses
    if poses.ndim != 4 or poses.shape[2:] != (4, 4) or poses.dtype.kind not in "fiu" or not np.isfinite(poses).all():
        rule = "poses: finite numbers [T, 4, 4], or [T, H, 4, 4] of H hands, are required"
        raise InputError(path, rule, f"{list(arrays['poses'].shape)} {poses.dtype}", "Interpolate frames without a pose.")
    hands, turns = poses.shape[1], poses[..., :3, :3]
    off = np.abs(np.swapaxes(turns, -1, -2) @ turns - np.eye(3)).max(axis=(-1, -2)) + (np.linalg.det(turns) < 0)
    off = np.maximum(off, np.abs(poses[..., 3, :] - [0, 0, 0, 1]).max(axis=-1))
    if len(bad := np.argwhere(off > RIGID)):
        rule = f"poses: the upper left 3 x 3 block must be a rotation within {RIGID:g}, the last row 0, 0, 0, 1"
        remedy = "Write right-handed hand-to-world matrices, with the hand's axes as columns; normalize quaternions first."
        raise InputError(path, rule, f"a deviation of {off[tuple(bad[0])]:.3g} in frame {bad[0][0]}, hand {bad[0][1]}", remedy)
    jaws = np.broadcast_to(jaws, (hands, *jaws.shape)) if jaws.ndim == 2 else jaws
    if jaws.shape[::2] != (hands, 3) or jaws.dtype.kind not in "fiu" or not np.isfinite(jaws).all():
        rule = f"jaws: finite numbers [C, 3], or [{hands}, C, 3], are required"
        raise InputError(
            path, rule, f"{list(arrays['jaws'].shape)} {jaws.dtype}", "Write the points of each jaw in the hand's frame, m."
        )
    result = {"points": carried(poses, jaws), "hand": np.repeat(np.arange(hands), jaws.shape[1])}
    if "holds" in arrays:
        result["holds"] = np.repeat(arrays["holds"].reshape(len(poses), -1), jaws.shape[1], axis=1)
    return result


def carried(poses: np.ndarray, jaws: np.ndarray) -> np.ndarray:
    """Points [T, H * C, 3], m, at `jaws` [H, C, 3], m in the hands' frames, of hands with hand-to-world poses [T, H, 4, 4]."""
    points = np.einsum("thij,hcj->thci", poses[..., :3, :3], jaws) + poses[:, :, None, :3, 3]
    return np.asarray(points.reshape(len(poses), -1, 3))


def _arrays(path: Path, keys: tuple[str, ...], other: tuple[str, ...] = ("points",)) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except (*NPZ_FAULTS, AttributeError) as error:
        name, remedy = foreign(path)
        received = name or f"{type(error).__name__}: {error}"
        raise InputError(path, "an .npz file without pickle is required", received, remedy) from error
    if not any(names[0] in arrays and arrays.keys() <= set(names) for names in (keys, other)):
        optional = [f"the array {names[0]}" + f", optional {' and '.join(names[1:])}" * (len(names) > 1) for names in (keys, other)]
        rule = f"{'; or '.join(dict.fromkeys(optional))} is required"
        raise InputError(path, rule, ", ".join(arrays) or "none")
    return arrays


def _rows(path: Path) -> dict[str, np.ndarray]:
    import pandas as pd

    try:
        table = pd.read_csv(path)
    except (OSError, ValueError) as error:
        raise InputError(path, "rows of numbers with one header line are required", str(error)) from error
    if not set(CSV_COLUMNS[:5]) <= set(table) <= set(CSV_COLUMNS):
        rule = f"the header must be {','.join(CSV_COLUMNS[:5])}, optionally with holds and hand; poses require an .npz file"
        raise InputError(path, rule, ",".join(map(str, table)))
    for name, column in (table := table.apply(pd.to_numeric, errors="coerce")).items():
        if len(bad := np.flatnonzero(~np.isfinite(column))):
            raise InputError(path, f"{name}: every entry must be a number", f"no number in row {bad[0] + 1} ({len(bad)} in all)")
    sizes = table["frame"].nunique(), table["point"].nunique()
    if table.duplicated(["frame", "point"]).any() or len(table) != np.prod(sizes) or table["frame"].max() != sizes[0] - 1:
        rule = "each point needs one row per frame, and frames must be 0, 1, 2, ..."
        raise InputError(path, rule, f"{len(table)} rows, {sizes[0]} frames up to {table['frame'].max():g}, {sizes[1]} points")
    grid = {name: column.to_numpy().reshape(sizes) for name, column in table.sort_values(["frame", "point"]).items()}
    arrays = {"points": np.stack([grid[name] for name in "xyz"], axis=-1)}
    if "holds" in grid:
        if not set(np.unique(grid["holds"])) <= {0, 1}:
            raise InputError(path, "holds: must be 0 or 1", f"{np.unique(grid['holds'])[:4]}")
        arrays["holds"] = grid["holds"] > 0
    if "hand" in grid:
        if (grid["hand"] != grid["hand"][0]).any() or (grid["hand"] % 1).any():
            raise InputError(path, "hand: must be one integer for each point", "changing or fractional numbers")
        arrays["hand"] = grid["hand"][0].astype(int)
    return arrays


def _places(path: Path, points: np.ndarray, dimensions: int) -> np.ndarray:
    form = "[T, C, 3]" if dimensions == 3 else "[N, 3]"
    if points.ndim != dimensions or points.shape[-1] != 3 or points.dtype.kind not in "fiu":
        raise InputError(path, f"points: numbers {form} are required", f"{list(points.shape)} {points.dtype}")
    if len(bad := np.argwhere(~np.isfinite(points))):
        first = f"{points[tuple(bad[0])]} at index {bad[0].tolist()} ({len(bad)} in all)"
        raise InputError(path, "points: every coordinate must be finite", first, "Where `holds` is 0, write any finite position.")
    return points.astype(float)


def write(folder: Path, hands: Hands | None, nodes: np.ndarray) -> None:
    """Write controllers.npz and nodes.npz into a capture's folder, each only if it is given."""
    if hands is not None:
        named = {"holds": hands.holds, "hand": hands.hand}
        arrays = {"points": hands.points} | {name: value for name, value in named.items() if value.size}
        write_atomically(folder / CONTROLLERS[0], lambda path: _save(path, arrays))
    if len(nodes):
        write_atomically(folder / NODES[0], lambda path: _save(path, {"points": nodes}))


def _save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with path.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]


def held(hands: Hands, tracks: np.ndarray, train_end: int) -> np.ndarray:
    """Controllers [T, C, 3], m, in which a controller that grasps later starts at its future contact point.

    This is its position when it begins to hold, minus the displacement until then of the nearest annotated point. The object's
    motion is not read in frames from `train_end` on.
    """
    points = hands.points.copy()
    if not hands.holds.size:
        return points
    for number in np.flatnonzero(~hands.holds[0] & hands.holds.any(axis=0)):
        begin = int(hands.holds[:, number].argmax())
        points[0, number] = points[begin, number]
        now = tracks[min(begin, train_end - 1)]
        if len(known := np.flatnonzero(np.isfinite(now).all(axis=1) & np.isfinite(tracks[0]).all(axis=1))):
            near = known[np.linalg.norm(now[known] - points[begin, number], axis=1).argmin()]
            points[0, number] -= now[near] - tracks[0, near]
    return points


def standing(nodes: np.ndarray, up: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [n, 3], m, raised to the table if they are below it, and their indices; of nodes that coincide, one is kept."""
    lifted = on_table(nodes, up)
    pairs = cKDTree(lifted).query_pairs(SAME, output_type="ndarray")
    stay = np.setdiff1d(np.arange(len(nodes)), pairs.max(axis=1, initial=-1))
    return lifted[stay], stay


def observe(row: ScenarioRow, path: Path, config: Config, output: Path) -> Observations:
    """Observations of a capture without cameras, see `neuspring.scenes.sources`.

    Annotated points that are seen in frame 0 are the tracked points and the first nodes; the given nodes follow. Other annotated
    points are only for scoring. Points below the table are raised to it.
    """
    capture = Capture.load(path)
    description, space = capture.description, read(capture)
    assert space.hands is not None, "read has refused a capture without hands"
    points, visible = taught_by(space.tracks)
    nodes, stay = space.nodes, np.arange(len(space.nodes))
    if row.ground:
        points = on_table(points, description.up_sign)
        nodes, stay = standing(nodes, description.up_sign)
    apart = cKDTree(points[0]).query(nodes)[0] > SAME
    rest = space.rest
    if len(rest):
        annotated, object_rest, hands = np.split(rest, np.cumsum([space.tracks.shape[1], len(space.nodes)]))
        rest = np.concatenate([annotated[np.isfinite(space.tracks[0]).all(axis=1)], object_rest[stay[apart]], hands])
    return Observations(
        scenario=scenario_of(row, capture, {}),
        object_points=points,
        object_visibility=visible,
        object_motion_valid=in_both(visible),
        controller_points=held(space.hands, space.tracks, capture.train_end),
        controller_valid=space.hands.holds,
        controller_hand=space.hands.hand,
        surface_points=nodes[apart],
        interior_points=np.zeros((0, 3)),
        tracks=space.tracks,
        rest_shape=rest,
    )


def scenario_of(row: ScenarioRow, capture: Capture, origin: dict[str, str]) -> Scenario:
    """The scenario of a capture. Its provenance is that of the capture, digests of its existing files, and `origin`."""
    described, folder = capture.description, capture.folder
    files = [name for name in (CAPTURE, *CONTROLLERS, *NODES, REST) if (folder / name).exists()]
    files += [TRACKS] if described.tracks == "train" else []
    return Scenario(
        name=row.scenario,
        source=row.source,
        category=row.category,
        frame_count=capture.frame_count,
        train_end=capture.train_end,
        frame_rate=described.frame_rate,
        up=described.up,
        self_collision=row.self_collision,
        ground=row.ground,
        mass=described.mass,
        provenance=described.provenance | {name: f"sha256:{digest_file(folder / name)}" for name in files} | origin,
    )


def taught_by(tracks: np.ndarray, end: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Positions and visibility of the annotated tracks [T, K, 3] that are seen in frame 0; positions are zeros where not seen.

    From frame `end` on, if it is given, no track is visible.
    """
    seen = np.isfinite(tracks).all(axis=2)
    visible = seen[:, seen[0]]
    if end is not None:
        visible[end:] = False
    return np.where(visible[..., None], tracks[:, seen[0]], 0.0), visible


def in_both(visible: np.ndarray) -> np.ndarray:
    """[T, n] bool, row t: whether a point is visible [T, n] in t and in t + 1."""
    both = np.zeros_like(visible)
    both[:-1] = visible[:-1] & visible[1:]
    return both
