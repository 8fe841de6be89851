"""A table (CSV) of the pose of a hand that holds a long thin object, and of markers on the object -> Observations.

Controllers move with the hand: two points on the object's line, one outside and one at the clamp, and a ring around each. The two
points and the markers are the observed line. The rings give a rod its roll and hold a lattice. Nodes are rings around the object:
without load around its straight line, in frame 0 around a smooth line through clamp and markers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from neuspring.config import Config, ScenarioRow
from neuspring.core.artifacts import Observations, Scenario
from neuspring.core.errors import InputError
from neuspring.core.records import digest_file
from neuspring.core.text import listed
from neuspring.extensions.rods.mocap import RING, centerline, circle, rings, transport
from neuspring.extensions.rods.settings import Posed
from neuspring.intake.points import carried, in_both, taught_by

TIME = "t"
"""Column of the time."""
RINGS = 24
"""Rings of nodes along the object, for lattices."""
HAND_GRIP = 0.05
"""Distance of the two points of a hand on the line, m."""
UNEVEN = 0.01
"""Maximum relative deviation of a time step from the median."""
FEWEST_SAMPLES = 5


def observe(row: ScenarioRow, path: Path, config: Config, output: Path) -> Observations:
    """See `neuspring.scenes.sources`. Raises InputError with the file and column."""
    settings = config.section(Posed)
    poses, tracks, rate = _table(Path(path), settings)
    clamp, unloaded = np.array(settings.clamp), np.array(settings.unloaded)
    along = (unloaded[0] - clamp) / np.linalg.norm(unloaded[0] - clamp)
    side = np.eye(3)[np.abs(along).argmin()]
    normal = transport(along[None], side)[0]
    ends = np.stack([clamp - HAND_GRIP * along, clamp])
    around = circle(normal, np.cross(along, normal), settings.radius, RING, 0.5)
    jaws = np.concatenate([ends, *(end + around for end in ends)])
    controllers = carried(poses[:, None], jaws[None])
    points, visible = taught_by(tracks)
    first = poses[0]

    def in_world(points: np.ndarray) -> np.ndarray:
        return np.asarray(points @ first[:3, :3].T + first[:3, 3])

    straight, seen = in_world(np.concatenate([ends, unloaded])), np.concatenate([controllers[0, :2], points[0]])
    body, rest = (_body(line, first[:3, :3] @ normal, settings) for line in (seen, straight))
    nodes = len(unloaded) + len(body)
    return Observations(
        scenario=Scenario(
            name=row.scenario,
            source=row.source,
            category=row.category,
            frame_count=len(points),
            train_end=len(points),
            frame_rate=rate,
            up="+z",
            self_collision=row.self_collision,
            ground=row.ground,
            provenance={path.name: f"sha256:{digest_file(path)}", "options": str(settings)},
        ),
        object_points=points,
        object_visibility=visible,
        object_motion_valid=in_both(visible),
        controller_points=controllers,
        controller_hand=np.zeros(len(jaws), np.int32),
        surface_points=body,
        interior_points=np.zeros((0, 3)),
        tracks=tracks,
        rest_shape=np.concatenate([straight[2:], rest, controllers[0]]),
        line=np.array([nodes, nodes + 1, *range(len(unloaded))]),
    )


def _body(line: np.ndarray, normal: np.ndarray, settings: Posed) -> np.ndarray:
    """Nodes [n, 3], m, of rings along a line [M, 3] from the clamp on."""
    centers, tangents = centerline(line[1:], RINGS)
    return rings(centers, tangents, transport(tangents, normal), settings.radius, RING)


def _table(path: Path, settings: Posed) -> tuple[np.ndarray, np.ndarray, float]:
    """Poses of the hand [T, 4, 4], markers [T, M, 3], m, NaN where invisible, and the sampling rate, Hz. Raises InputError."""
    import pandas as pd

    if not settings.markers or len(settings.markers) != len(settings.unloaded):
        rule = "one unloaded position per marker, and at least one marker, are required"
        raise InputError("configuration, posed.unloaded", rule, f"{len(settings.unloaded)} and {len(settings.markers)}")
    if len(settings.rotation) != (3 if settings.angles else 4):
        rule = "four columns of a quaternion, or three with posed.angles, are required"
        raise InputError("configuration, posed.rotation", rule, list(settings.rotation))
    try:
        table = pd.read_csv(path)
    except (OSError, ValueError) as error:
        raise InputError(path, "must be a table with one header line", str(error), "Correct its path in scenarios.tsv.") from error
    known = [TIME, *settings.position, *settings.rotation]
    marked = [name for columns in settings.markers for name in columns]
    if missing := [name for name in (*known, *marked) if name not in table]:
        remedy = f"Set columns in the section posed; the table has {listed(table.columns)}."
        raise InputError(path, "must have columns of time, position, rotation and markers", f"no {', '.join(missing)}", remedy)
    table = table[[*known, *marked]].apply(pd.to_numeric, errors="coerce").iloc[:: settings.stride]
    if len(table) < FEWEST_SAMPLES:
        raise InputError(path, f"at least {FEWEST_SAMPLES} samples must remain after posed.stride", len(table))
    for name in known:
        if len(bad := np.flatnonzero(~np.isfinite(table[name]))):
            raise InputError(path, f"{name}: every entry must be a number", f"none in sample {bad[0]} ({len(bad)} in total)")
    steps = np.diff(table[TIME])
    step = float(np.median(steps))
    if not (step > 0 and np.abs(steps / step - 1).max() < UNEVEN):
        where = int(np.abs(steps - step).argmax())
        rule = f"{TIME}: time steps must be equal within {UNEVEN:.0%}"
        raise InputError(path, rule, f"{steps[where]:.4g} s after sample {where}, {step:.4g} s elsewhere", "Resample the table.")
    turns, tracks = table[list(settings.rotation)].to_numpy(), table[marked].to_numpy().reshape(len(table), -1, 3)
    lengths = np.linalg.norm(turns, axis=1)
    if not settings.angles and np.abs(lengths - 1).max() > UNEVEN:
        remedy = "Normalize them, or set the order of three angles in posed.angles."
        raise InputError(path, "quaternions must have length 1", f"{lengths.min():.3g} to {lengths.max():.3g}", remedy)
    if len(lost := np.flatnonzero(~np.isfinite(tracks[0]).all(axis=1))):
        remedy = "Start the table at a sample with all markers."
        raise InputError(path, "every marker must be visible in the first sample", f"no marker {lost[0]}", remedy)
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    rotation = Rotation.from_euler(settings.angles, turns) if settings.angles else Rotation.from_quat(turns)
    poses[:, :3, :3], poses[:, :3, 3] = rotation.as_matrix(), table[list(settings.position)].to_numpy()
    return poses, tracks, 1 / step
