"""Hands, nodes and annotated points in space, which a capture may bring beside film or without any.

    controllers.npz    points [T, C, 3]; optional: holds [T, C] bool (all hold), hand [C] int (not grouped); or
                       poses [T, H, 4, 4], hands to world; optional: jaws [H, C, 3], points that each carries, holds [T, H]
    controllers.csv    points as rows, header frame,point,x,y,z[,holds][,hand]; frames from 0, holds 0 or 1
    nodes.npz | .ply   points [N, 3]; or vertices: the body of frame 0
    rest.npz           points [K + N + C, 3], optional, without cameras: annotated points, nodes, controllers of the unloaded shape
    tracks.json        annotated points (capture.py); with `tracks: train` those of training frames teach the twin

Meters, in the capture's world. Files of another form, in other units or axes are refused with what they look like.
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
"""Columns of controllers.csv; the last two may be left out."""
JAWS = 0.03 * np.concatenate([np.zeros((1, 3)), np.eye(3)])
"""Points that a hand with a pose carries where the file gives none, m in its frame: its origin, and one along each of its axes."""
RIGID = 1e-4
"""Allowed deviation from R^T R = 1 of a pose."""
UNSEEN_ROW = (
    "Write null in place of [x, y, z] in the frames in which a point is not seen",
    "Fill these frames from those before and after, or say in `holds` that nothing is held there",
)
"""Remedies for entries of tracks.json and of controllers that are no places."""
LEAST_NODES = 3
"""Points that say how a body is turned."""


@dataclass(frozen=True, eq=False)
class Hands:
    """Points that move the object."""

    points: np.ndarray
    """[T, C, 3], m."""
    holds: np.ndarray
    """[T, C] bool: when each holds the object; empty: all do in all frames."""
    hand: np.ndarray
    """[C] int: the hand of each; empty: not grouped."""


@dataclass(frozen=True, eq=False)
class InSpace:
    """Points in space that a capture brings."""

    hands: Hands | None
    nodes: np.ndarray
    """[N, 3], m; none: not given."""
    tracks: np.ndarray
    """[T, K, 3], m, NaN where not annotated: those that teach the twin; K = 0 where they are for scoring only."""
    annotated: np.ndarray
    """[T, K, 3], m, NaN where not annotated: all of them."""
    rest: np.ndarray
    """[K + N + C, 3], m: annotated points, nodes and controllers of the unloaded shape; none: frame 0 has no load."""

    def turned(self, rotation: np.ndarray) -> InSpace:
        """All points after a rotation [3, 3] about the origin."""
        hands = replace(self.hands, points=self.hands.points @ rotation.T) if self.hands else None
        return InSpace(hands, *(points @ rotation.T for points in (self.nodes, self.tracks, self.annotated, self.rest)))


def given(folder: Path, names: tuple[str, ...]) -> Path | None:
    """The file of a capture's folder with one of `names`; None without any. Raises InputError for two."""
    found = [folder / name for name in names if (folder / name).exists()]
    if len(found) > 1:
        raise InputError(folder, f"one of {' and '.join(names)} may be there", "both", "Remove one of them.")
    return found[0] if found else None


def read(capture: Capture) -> InSpace:
    """Hands, nodes and points of a capture. Raises InputError, naming file and key, for what no twin can be made of."""
    space, findings = look(capture)
    refuse(findings)
    return space


def look(capture: Capture, brought: Mapping[str, Path] | None = None) -> tuple[InSpace, list[Finding]]:
    """Hands, nodes and points of a capture as far as they can be read, and every finding about them.

    `brought` are files of `controllers`, `nodes` and `tracks` that are not in its folder yet.
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
    marked, none = files.get("tracks") or folder / TRACKS, np.zeros((capture.frame_count, 0, 3))
    hands = attempt(read_hands, file, capture.frame_count) if (file := files.get("controllers")) else None
    nodes: Any = attempt(read_nodes, files["nodes"]) if files.get("nodes") else None
    annotated = attempt(capture.tracks, marked)
    nodes, annotated = none[0] if nodes is None else nodes, none if annotated is None else annotated
    # A hand may be anywhere while it holds nothing.
    held_at = none if hands is None else np.where(hands.holds[..., None] if hands.holds.size else True, hands.points, np.nan)
    moving = [Moving(points, description.frame_rate) for points in (annotated, held_at)]
    for where, one, remedy in zip((marked, file), moving, UNSEEN_ROW, strict=True):
        findings += examine("moving", where, one, remedy) if one.given.size else []
    # An entry that is no position says nothing about unit and table.
    seen, places = (one.points for one in moving)
    rest, shape = None, folder / REST
    # Without hands, which are required then, nothing is known of the count.
    if shape.exists() and (hands or description.cameras):
        rest = attempt(read_rest, shape, seen.shape[1] + len(nodes) + places.shape[1], description)
    taught = seen if description.tracks == "train" else none
    space = InSpace(hands, nodes, taught, seen, none[0] if rest is None else rest)
    first = seen[0][np.isfinite(seen[0]).all(axis=1)]
    if description.tracks == "train" and len(first) < LEAST_NODES:
        rule = f"with tracks: train at least {LEAST_NODES} points must be annotated in frame 0, where the twin starts"
        findings.append(broken(marked, "", rule, f"{len(first)} of {seen.shape[1]}"))
    ground, moved = description.up_sign if description.ground else None, travel(np.concatenate([seen, places], axis=1))
    for where, points in ((files.get("nodes"), nodes), (marked, seen), (file, places)):
        known = points[np.isfinite(points).all(axis=-1)]
        findings += examine("points", where, known, ground, moved) if where is not None and len(known) else []
    if len(nodes) and not any(one.level == "error" for one in findings):
        findings += examine("points on nodes", marked, seen[0], nodes)
        findings += _holding(capture, space, places, first, file) if hands is not None and file is not None else []
    return space, findings


def _holding(capture: Capture, space: InSpace, places: np.ndarray, first: np.ndarray, file: Path) -> list[Finding]:
    """Findings about hands [T, C, 3], NaN while they hold nothing, and the object, with annotated points of frame 0 [n, 3]."""
    assert space.hands is not None
    taught = places[: capture.train_end]
    holding = taught[np.isfinite(taught).all(axis=2)]
    if not len(holding):
        rule = "some controller must hold in some training frame, from which a twin learns"
        return [broken(file, "holds", rule, f"none before frame {capture.train_end}")]
    findings = examine("holding", file, holding, space.nodes)
    near = cKDTree(np.concatenate([space.nodes, first])).query(held(space.hands, space.annotated, capture.train_end)[0])[0]
    if (near < SAME).any():
        rule = f"controllers must be {1e3 * SAME:g} mm from nodes and annotated points in frame 0: a spring needs a length"
        findings.append(broken(file, "points", rule, f"controller {near.argmin()}, {(near < SAME).sum()} in all"))
    if (shift := follows(space.hands.points, space.annotated)) and shift.wrong:
        rows = "Shift the rows of the annotated points by {frames}."
        findings += examine("streams", file, [Streams("the hands", "the annotated points", shift, rows)])
    return findings


def read_hands(path: Path, frames: int | None = None) -> Hands:
    """controllers.npz, controllers.csv or markers of a C3D file, of so many frames, if given. Raises InputError."""
    if is_c3d(path):
        arrays = {"points": Markers.read(path).whole(path)}
    else:
        arrays = _rows(path) if path.suffix == ".csv" else _arrays(path, ("points", "holds", "hand"), ("poses", "jaws", "holds"))
        if "poses" in arrays:
            arrays = _of_poses(path, arrays)
    points = _places(path, arrays["points"], 3)
    count, number = points.shape[:2]
    if frames is not None and count != frames:
        rule = f"{frames} frames are required, as frame_count of {CAPTURE} says"
        raise InputError(path, rule, count, "Cut or resample the file: a row per frame of the capture.")
    if not number:
        raise InputError(path, "at least one controller is required", "none")
    holds, hand = arrays.get("holds", np.zeros((0, 0), bool)), arrays.get("hand", np.zeros(0, int))
    for key, value, shape, kinds in (("holds", holds, (count, number), "b"), ("hand", hand, (number,), "iu")):
        if value.size and (value.shape != shape or value.dtype.kind not in kinds):
            wanted = f"{list(shape)} {'bool' if kinds == 'b' else 'int'}"
            raise InputError(path, f"{key}: must be {wanted}", f"{list(value.shape)} {value.dtype}")
    if holds.size and not holds.any():
        raise InputError(path, "holds: some controller must hold in some frame", "none", "Without it all hold always.")
    return Hands(points, holds if holds.size and not holds.all() else np.zeros((0, 0), bool), hand)


def read_nodes(path: Path) -> np.ndarray:
    """The nodes [N, 3], m, of nodes.npz or the vertices of nodes.ply. Raises InputError."""
    if path.suffix == ".npz":
        nodes = _arrays(path, ("points",))["points"]
    else:
        import trimesh

        try:
            body: Any = trimesh.load(path, process=False)
            nodes = np.array(body.vertices)
        except Exception as error:  # trimesh raises whatever a damaged file leads it to
            name, remedy = foreign(path)
            received = name or f"{type(error).__name__}: {error}"
            raise InputError(path, "vertices of a PLY file are required", received, remedy) from error
    nodes = _places(path, nodes, 2)
    if len(nodes) < LEAST_NODES:
        raise InputError(path, f"at least {LEAST_NODES} nodes are required", len(nodes))
    pairs = cKDTree(nodes).query_pairs(SAME, output_type="ndarray")
    if len(pairs):
        rule = f"nodes must lie {1e3 * SAME:g} mm apart: a spring between two needs a length"
        value = f"{len(pairs)} pairs, first nodes {pairs[0][0]} and {pairs[0][1]}"
        raise InputError(path, rule, value, "Remove the doubled nodes, np.unique(points, axis=0).")
    return nodes


def read_rest(path: Path, count: int, description: Description) -> np.ndarray:
    """The unloaded shape [count, 3], m. Raises InputError."""
    if description.cameras:
        raise InputError(path, "an unloaded shape is for captures without cameras", "cameras", "Remove the file.")
    points = _places(path, _arrays(path, ("points",))["points"], 2)
    if len(points) != count:
        rule = f"points: the annotated points, the nodes and the controllers are required, {count} in this order"
        raise InputError(path, rule, len(points))
    return points


def _of_poses(path: Path, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Points, when they hold and their hands, of hands with poses [T, H, 4, 4], or [T, 4, 4] of one. Raises InputError."""
    poses, jaws = arrays["poses"], arrays.get("jaws", JAWS)
    poses = poses[:, None] if poses.ndim == 3 else poses
    if poses.ndim != 4 or poses.shape[2:] != (4, 4) or poses.dtype.kind not in "fiu" or not np.isfinite(poses).all():
        rule = "poses: finite numbers [T, 4, 4], or [T, H, 4, 4] of H hands, are required"
        raise InputError(
            path, rule, f"{list(arrays['poses'].shape)} {poses.dtype}", "Fill frames without a pose from their neighbors."
        )
    hands, turns = poses.shape[1], poses[..., :3, :3]
    off = np.abs(np.swapaxes(turns, -1, -2) @ turns - np.eye(3)).max(axis=(-1, -2)) + (np.linalg.det(turns) < 0)
    off = np.maximum(off, np.abs(poses[..., 3, :] - [0, 0, 0, 1]).max(axis=-1))
    if len(bad := np.argwhere(off > RIGID)):
        rule = f"poses: the upper left 3 x 3 block must be a rotation within {RIGID:g}, the last row 0, 0, 0, 1"
        remedy = "Write hand to world, columns the hand's axes, right-handed; of quaternions normalize them first."
        raise InputError(path, rule, f"a deviation of {off[tuple(bad[0])]:.3g} in frame {bad[0][0]}, hand {bad[0][1]}", remedy)
    jaws = np.broadcast_to(jaws, (hands, *jaws.shape)) if jaws.ndim == 2 else jaws
    if jaws.shape[::2] != (hands, 3) or jaws.dtype.kind not in "fiu" or not np.isfinite(jaws).all():
        rule = f"jaws: finite numbers [C, 3], or [{hands}, C, 3], are required"
        raise InputError(path, rule, f"{list(arrays['jaws'].shape)} {jaws.dtype}", "Give points of a jaw in the hand's frame, m.")
    found = {"points": carried(poses, jaws), "hand": np.repeat(np.arange(hands), jaws.shape[1])}
    if "holds" in arrays:
        found["holds"] = np.repeat(arrays["holds"].reshape(len(poses), -1), jaws.shape[1], axis=1)
    return found


def carried(poses: np.ndarray, jaws: np.ndarray) -> np.ndarray:
    """Points [T, H * C, 3], m, that hands with poses [T, H, 4, 4], to the world, carry at jaws [H, C, 3], m in their frames."""
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
        rule = f"{'; or '.join(dict.fromkeys(optional))}: is required"
        raise InputError(path, rule, ", ".join(arrays) or "none")
    return arrays


def _rows(path: Path) -> dict[str, np.ndarray]:
    import pandas as pd

    try:
        table = pd.read_csv(path)
    except (OSError, ValueError) as error:
        raise InputError(path, "rows of numbers with one header line are required", str(error)) from error
    if not set(CSV_COLUMNS[:5]) <= set(table) <= set(CSV_COLUMNS):
        rule = f"the header must be {','.join(CSV_COLUMNS[:5])}, and may have holds and hand; poses are in an .npz file"
        raise InputError(path, rule, ",".join(map(str, table)))
    for name, column in (table := table.apply(pd.to_numeric, errors="coerce")).items():
        if len(bad := np.flatnonzero(~np.isfinite(column))):
            raise InputError(path, f"{name}: every entry must be a number", f"another in row {bad[0] + 1} ({len(bad)} in all)")
    sizes = table["frame"].nunique(), table["point"].nunique()
    if table.duplicated(["frame", "point"]).any() or len(table) != np.prod(sizes) or table["frame"].max() != sizes[0] - 1:
        rule = "each point needs one row in each frame, and frames are 0, 1, 2, ..."
        raise InputError(path, rule, f"{len(table)} rows, {sizes[0]} frames up to {table['frame'].max():g}, {sizes[1]} points")
    grid = {name: column.to_numpy().reshape(sizes) for name, column in table.sort_values(["frame", "point"]).items()}
    arrays = {"points": np.stack([grid[name] for name in "xyz"], axis=-1)}
    if "holds" in grid:
        if not set(np.unique(grid["holds"])) <= {0, 1}:
            raise InputError(path, "holds: must be 0 or 1", f"{np.unique(grid['holds'])[:4]}")
        arrays["holds"] = grid["holds"] > 0
    if "hand" in grid:
        if (grid["hand"] != grid["hand"][0]).any() or (grid["hand"] % 1).any():
            raise InputError(path, "hand: must be one whole number for each point", "numbers that change")
        arrays["hand"] = grid["hand"][0].astype(int)
    return arrays


def _places(path: Path, points: np.ndarray, dimensions: int) -> np.ndarray:
    form = "[T, C, 3]" if dimensions == 3 else "[N, 3]"
    if points.ndim != dimensions or points.shape[-1] != 3 or points.dtype.kind not in "fiu":
        raise InputError(path, f"points: numbers {form} are required", f"{list(points.shape)} {points.dtype}")
    if len(bad := np.argwhere(~np.isfinite(points))):
        place = f"{points[tuple(bad[0])]} at index {bad[0].tolist()} ({len(bad)} in all)"
        raise InputError(path, "points: every coordinate must be finite", place, "With `holds` a hand may be anywhere.")
    return points.astype(float)


def write(folder: Path, hands: Hands | None, nodes: np.ndarray) -> None:
    """Write controllers.npz and nodes.npz of a capture's folder; nothing of what there is not."""
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
    """Controllers [T, C, 3], m. One that first holds later gets in frame 0 the place of the body that it will hold.

    That is its place when it begins to hold, less how far the annotated point nearest to it has moved until then; nothing of the
    object is read in frames from `train_end` on.
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
    """Nodes [n, 3], m, with those below the table moved up to it, and their indices; of those that meet there one stays."""
    lifted = on_table(nodes, up)
    pairs = cKDTree(lifted).query_pairs(SAME, output_type="ndarray")
    stay = np.setdiff1d(np.arange(len(nodes)), pairs.max(axis=1, initial=-1))
    return lifted[stay], stay


def observe(row: ScenarioRow, path: Path, config: Config, output: Path) -> Observations:
    """Observations of a capture of points alone, see `neuspring.scenes.sources`.

    Tracked points are the annotated points that are seen in frame 0, and the first nodes; the given nodes follow. The others are
    for scoring. Points below the table are lifted to it.
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
        marked, body, hands = np.split(rest, np.cumsum([space.tracks.shape[1], len(space.nodes)]))
        rest = np.concatenate([marked[np.isfinite(space.tracks[0]).all(axis=1)], body[stay[apart]], hands])
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
    """The scenario of a capture. Its provenance is the capture's, digests of the files that are there, and `origin`."""
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
    """Those annotated tracks [T, K, 3] that are seen in frame 0: their places, zeros where not seen, and whether they are seen.

    From frame `end` on, if it is given, none is.
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
