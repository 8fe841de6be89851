"""Motion capture of cables (DLO data of DEFORM, arXiv 2406.05931) -> Observations.

One pickle is one recording: positions [T, 3, n], float64, as nested lists or as an array. DEFORM's data are in meters, at 100 Hz,
with z up; `mocap.unit`, `mocap.rate` and `mocap.up` set other values. Markers are in order along the cable. Robots hold two
markers at each end: these are the controllers, each with a ring of points around it. The other markers are observed. The data
have no surface, so nodes are rings around a smooth center line through the markers of frame 0.

Points on one line leave the roll about it free, but a gripper does not. So each held marker m gets a ring of points

    m(t) + r (cos a_k n(t) + sin a_k d(t) x n(t)),    a_k = 2 pi (k + 1/2) / count.

d(t) is the unit direction between the end's two markers. n(t) is normal to d(t) and parallel-transported: the smallest rotation
from frame to frame that maps d also rotates n. So the ring follows every rotation of the end and never spins about it; the data
do not contain a spin of the gripper. Half an angular step keeps the points away from the nodes' ring around the first and last
marker.

In frame 0 the roll of both ends is the projection of y, because DEFORM's cables are along x. So ring node i is the same node in
every recording of a cable.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from neuspring.config import Config, ScenarioRow
from neuspring.core.artifacts import Observations, Scenario
from neuspring.core.errors import InputError
from neuspring.core.findings import refuse
from neuspring.core.records import digest_file
from neuspring.data.unpickle import load_pickle
from neuspring.extensions.rods.checks import MIN_DISTANCE, MIN_FRAMES, in_space, look
from neuspring.extensions.rods.rod import arc_of, pieces
from neuspring.extensions.rods.settings import Mocap
from neuspring.intake.points import in_both

X, Y, Z = np.eye(3)


def clamps(held: np.ndarray, normals: np.ndarray, radius: float, count: int, where: str) -> np.ndarray:
    """Points [T, 4 * count, 3], m, of rings around held markers [T, 4, 3] (two at each end, in the order along the cable).

    `normals` [2, 3] give the roll of each end in frame 0: those of the first and last ring of nodes. Raises InputError, with the
    name `where`, if the two markers of an end are nearer than `MIN_DISTANCE`, which leaves their direction undefined.
    """
    parts = []
    for normal, end in zip(normals, (held[:, :2], held[:, 2:]), strict=True):
        along = end[:, 1] - end[:, 0]
        length = np.linalg.norm(along, axis=1, keepdims=True)
        if length.min() < MIN_DISTANCE:
            rule = f"the two held markers of an end must be {MIN_DISTANCE} m apart"
            raise InputError(where, rule, f"{length.min():.2g} m in sample {int(length.argmin())}")
        directions = along / length
        transported = transport(directions, normal)
        across = np.cross(directions, transported)
        parts += [end[:, [k]] + circle(transported, across, radius, count, 0.5) for k in (0, 1)]
    return np.concatenate(parts, axis=1)


def circle(normal: np.ndarray, across: np.ndarray, radius: float, count: int, turn: float = 0.0) -> np.ndarray:
    """Offsets [..., count, 3], m, from the center of a circle, with unit vectors [..., 3] normal to the cable.

    The first offset is along `normal`, rotated by `turn` angular steps.
    """
    angle = (2 * np.pi * (np.arange(count) + turn) / count)[:, None]
    offsets: np.ndarray = radius * (np.cos(angle) * normal[..., None, :] + np.sin(angle) * across[..., None, :])
    return offsets


def transport(directions: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Unit normals [T, 3] to unit directions [T, 3], by the smallest rotation from each direction to the next.

    The first is the projection of `normal` [3]. A vector n normal to d becomes n - (d' n) / (1 + d d') (d + d').
    """
    first = normal - (normal @ directions[0]) * directions[0]
    normals = np.empty_like(directions)
    normals[0] = first / np.linalg.norm(first)
    for t, (before, after) in enumerate(pairwise(directions)):
        turned = normals[t] - (after @ normals[t]) / (1.0 + before @ after) * (before + after)
        # Rounding errors would accumulate over thousands of samples.
        turned -= (turned @ after) * after
        normals[t + 1] = turned / np.linalg.norm(turned)
    return normals


RING = 3
"""Nodes per ring."""
RING_RADIUS = 0.006
"""Radius of rings, m."""
OVERSAMPLING = 64
"""Evaluations of the spline per marker interval, for its arc length."""


def observe(row: ScenarioRow, path: Path, config: Config, output: Path) -> Observations:
    """See `neuspring.scenes.sources`."""
    return read(row, path, config.section(Mocap))


def read(row: ScenarioRow, file: Path, settings: Mocap) -> Observations:
    """Read one recording with the section `mocap` of the configuration. Meters, float32, +z is up.

    The frame rate is `mocap.rate` / stride, all markers are visible, and tracks are the observed markers. Raises InputError with
    the name of the file.
    """
    file = Path(file)
    raw = load_pickle(file)
    refuse(look(file, raw, settings))
    data = in_space(raw, settings)
    samples = data[settings.start :: settings.stride].transpose(0, 2, 1)
    markers = samples if settings.frames is None else samples[: settings.frames]
    frames, count, _ = markers.shape
    needed = settings.frames or MIN_FRAMES
    if frames < needed:
        rule = f"{needed} frames are required after start {settings.start} and stride {settings.stride} (mocap.frames)"
        raise InputError(file, rule, f"{frames} of {len(data)} samples", "Omit this recording, or lower these settings.")

    held = [0, 1, count - 2, count - 1]
    observed = markers[:, 2:-2]
    centers, tangents = centerline(markers[0], settings.rings)
    normals = rolled(tangents, Y)
    body = rings(centers, tangents, normals, RING_RADIUS, RING)
    points = np.concatenate([markers[0], body])
    nearest = float(cKDTree(points).query(points, k=2)[0][:, 1].min())
    if nearest < MIN_DISTANCE:
        rule = f"markers and ring nodes of frame 0 must be {MIN_DISTANCE} m apart"
        raise InputError(file, rule, f"{nearest:.2g} m", "Lower mocap.rings.")
    line, rest_body = straightened(markers[0], settings.rings, RING_RADIUS, RING)
    around = (line[held][:, None] + circle(Y, Z, RING_RADIUS, RING, 0.5)).reshape(-1, 3)
    rest_shape = np.concatenate([line[2:-2], rest_body, line[held], around])
    # Rings rotate at the full sampling rate, because fewer samples would lose rotation.
    recorded = data[settings.start :].transpose(0, 2, 1)[: (frames - 1) * settings.stride + 1, held]
    before = data[max(settings.start - 1, 0)].T
    back = np.stack([markers[0], before])[:, held]
    controllers, back = (
        np.concatenate([ends[::stride], clamps(ends, normals[[0, -1]], RING_RADIUS, RING, str(file))[::stride]], axis=1)
        for ends, stride in ((recorded, settings.stride), (back, 1))
    )
    visible = np.ones(observed.shape[:2], dtype=bool)
    first = np.concatenate([observed[0] - before[2:-2], back[0] - back[1]]) * settings.rate
    nodes = len(observed[0]) + len(body)
    options = ", ".join(f"{name}={getattr(settings, name)}" for name in Mocap.__dataclass_fields__)
    return Observations(
        scenario=Scenario(
            name=row.scenario,
            source="mocap",
            category=row.category,
            frame_count=frames,
            train_end=int(settings.train_fraction * frames),
            frame_rate=settings.rate / settings.stride,
            up="+z",
            self_collision=row.self_collision,
            ground=row.ground,
            provenance={file.name: f"sha256:{digest_file(file)}", "options": options},
        ),
        object_points=observed,
        object_visibility=visible,
        object_motion_valid=in_both(visible),
        controller_points=controllers,
        surface_points=body,
        interior_points=np.zeros((0, 3)),
        tracks=observed,
        rest_shape=rest_shape,
        line=np.array([nodes, nodes + 1, *range(count - 4), nodes + 2, nodes + 3]),
        velocity_before=first if settings.start else np.zeros((0, 3)),
    )


def rings(centers: np.ndarray, tangents: np.ndarray, normals: np.ndarray, radius: float, count: int) -> np.ndarray:
    """Nodes [R * count, 3], m, on circles around `centers` [R, 3] in the planes normal to unit `tangents` [R, 3], ring by ring.

    The first node of each ring is along its unit normal [R, 3] (`rolled`), so node k of a ring is nearest to node k of the next.
    """
    nodes: np.ndarray = centers[:, None] + circle(normals, np.cross(tangents, normals), radius, count)
    return nodes.reshape(-1, 3)


def rolled(tangents: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Unit normals [R, 3] to unit tangents [R, 3] at equal distances along the arc; at both ends the projection of `axis` [3].

    The smallest rotations transport the normals. The angle that is missing at the far end, at most a half turn, becomes a uniform
    twist along the arc.
    """
    normals, last = transport(tangents, axis), tangents[-1]
    missing = np.arctan2(np.cross(normals[-1], axis) @ last, normals[-1] @ axis)
    turns = Rotation.from_rotvec(np.linspace(0.0, missing, len(tangents))[:, None] * tangents)
    return np.asarray(turns.apply(normals))


def straightened(markers: np.ndarray, number: int, radius: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The cable straight along x without twist: its markers [n, 3] and the nodes of its `number` rings [number * count, 3], m.

    Arc lengths along the center line are kept.
    """
    _, knots, dense, arc = _arc(markers)
    line = np.zeros((len(markers), 3))
    line[:, 0] = np.interp(knots, dense, arc)
    centers = np.linspace(0.0, arc[-1], number)[:, None, None] * X
    return line, (centers + circle(Y, Z, radius, count)).reshape(-1, 3)


def centerline(markers: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit tangents [R, 3] of a natural cubic spline through `markers` [n, 3], at equal distances along its arc.

    The first and last points are the first and last markers.
    """
    spline, _, dense, arc = _arc(markers)
    at = np.interp(np.linspace(0.0, arc[-1], number), arc, dense)
    tangents = spline(at, 1)
    return spline(at), tangents / np.linalg.norm(tangents, axis=1, keepdims=True)


def _arc(markers: np.ndarray) -> tuple[CubicSpline, np.ndarray, np.ndarray, np.ndarray]:
    """Spline through the markers, its parameters at the markers, dense parameters, and the arc length, m, at dense parameters."""
    knots = arc_of(pieces(markers))
    spline = CubicSpline(knots, markers, bc_type="natural")
    dense = np.unique(np.concatenate([np.linspace(a, b, OVERSAMPLING) for a, b in pairwise(knots)]))
    arc = arc_of(pieces(spline(dense)))
    return spline, knots, dense, arc
