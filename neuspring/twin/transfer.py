"""A twin on another recording of the same object, or on other nodes of the same body: another sampling, another spacing.

Where the nodes are the same, springs keep their ends (`move`). Elsewhere the recording's shape is laid onto the twin's
(register.py) and new springs take the values of the nearest (`resampled`).

Nodes have unit mass, or masses with that mean, so n nodes are a body of n kg, and the same motion needs the same forces per mass at
every sampling. For a strain eps, a strain rate eps' and a displacement u of the hand against the body, with springs of length l
along d:

    elastic energy per node    (1/n) sum_e  Y_e l_e (d eps d)^2 / 2     so   sum Y l / n     is kept   (Y ~ 1 / spacing)
    dissipation per node       (1/n) sum_e  g_e l_e^2 (d eps' d)^2      so   sum g l^2 / n   is kept   (g ~ 1 / spacing^2)
    grip per held node         sum_e (Y_e / l_e) (d u)^2 / 2            so   sum Y / l and sum g per held node are kept

in one, two and three dimensions, where alike nodes have alike neighbors. Drag, gravity, friction and restitution act per mass and
stay. Lengths between nodes (object radii, contact distance) scale with the spacing. Hands have a size: their radius stays, and as
many more nodes are asked for as the body has more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from neuspring.core.artifacts import Material, Observations, Topology, Twin
from neuspring.core.errors import InputError
from neuspring.core.text import listed
from neuspring.physics.topology import (
    RADIUS_MARGIN,
    REPAIR_SPRINGS,
    distances,
    infer_controller_radius,
    piecewise_topology,
    unloaded,
)
from neuspring.twin.body import body_of
from neuspring.twin.field import midpoints

if TYPE_CHECKING:
    from neuspring.twin.register import Registration


class OutOfReach(InputError):
    """No hand of a recording is as near to the body as those of the twin, which may hold it on another."""


LENGTH_SPREAD = 0.2
"""Bodies bent in frame 0 reach 0.02; nodes in another order lie above 0.5."""
LEAST_LENGTH = 1e-9
"""Shorter springs count as this long, m."""


def move(
    twin: Twin, observations: Observations, *, keep_frame_time: bool = False, safety: float = 0.8
) -> tuple[Twin, Registration | None]:
    """The twin in frame 0 of another recording of its object, and how the shapes were registered where nodes are others.

    Its body says what of it stays (`Body.on_recording`). Up, ground and, unless `keep_frame_time`, the frame time are the
    recording's. Substeps are added if the new distances need more. Raises InputError if the recording is of another body.
    """
    scenario, body = observations.scenario, body_of(twin)
    moved, registration = body.on_recording(twin, observations)
    simulation = replace(
        twin.simulation,
        frame_time=twin.simulation.frame_time if keep_frame_time else 1.0 / scenario.frame_rate,
        up=scenario.up,
        ground=scenario.ground,
        self_collision=scenario.self_collision,
    )
    return body.stable(replace(moved, simulation=simulation), safety), registration


def on_nodes(twin: Twin, observations: Observations) -> tuple[Twin, Registration | None]:
    """A lattice on the nodes and hands of another recording, and how the shapes fitted where the nodes are others.

    The rest shape is frame 0 unless recorded. Where both recordings have the same nodes in the same order (`corresponds`), a spring
    keeps its ends, stiffness, dashpot, and the ratio of its rest length to the distance of its ends where it has no force: in the
    rest shape, or in frame 0 where the twin's controllers rest there. Nodes keep their masses. Other nodes, as of filmed objects,
    take springs and masses of their own (`resampled`). Raises InputError if the shapes do not fit, or a spring has no length.
    """
    if corresponds(twin.topology, observations):
        return replace(twin, topology=_same_nodes(twin.topology, observations)), None
    return resampled(twin, observations)


def corresponds(topology: Topology, observations: Observations) -> bool:
    """True where node i of a recording is that of a twin: as many nodes and hands, and springs that keep their length or its scale.

    The springs' lengths change by one factor, up to `LENGTH_SPREAD` (median deviation of its logarithm): points in another order
    make distances across the whole body of neighbors.
    """
    alike = len(topology.nodes) == len(observations.nodes) and len(topology.controllers) == observations.controller_points.shape[1]
    springs = topology.springs[: topology.object_spring_count]
    if not alike or not len(springs):
        return alike
    lengths = distances(observations.canonical, springs), distances(topology.canonical, springs)
    ratio = np.log(np.maximum(lengths[0], LEAST_LENGTH) / np.maximum(lengths[1], LEAST_LENGTH))
    return bool(np.median(np.abs(ratio - np.median(ratio))) < LENGTH_SPREAD)


def _same_nodes(topology: Topology, observations: Observations) -> Topology:
    """The topology with the nodes of a recording, node i on node i."""
    nodes, hands = observations.nodes, observations.controller_points[0]
    rest, springs = topology.controller_rest, topology.springs
    now = unloaded(nodes, hands, springs, observations.rest_shape, rest)
    ratio = now / unloaded(topology.nodes, topology.controllers, springs, topology.rest_shape, rest)
    lengths = topology.rest_lengths.astype(np.float64) * ratio
    if topology.pushes.size:
        # A hand that pushes touches at one distance wherever it begins.
        lengths = np.where(topology.pushes, np.minimum(topology.rest_lengths, now), lengths)
    if not (lengths > 0).all():
        pair = topology.springs[int(np.argmin(lengths))].tolist()
        rule = "the ends of a spring may not coincide in the rest shape"
        raise InputError(f"transfer to {observations.scenario.name}", rule, f"spring {pair}")
    return replace(topology, nodes=nodes, controllers=hands, rest_lengths=lengths, rest_shape=observations.rest_shape)


NEAREST_SPRINGS = 8
"""Springs that a spring's values are the mean of."""
LARGEST_RESIDUAL, LARGEST_STRETCH = 0.12, 0.2
"""Beyond these shapes do not fit: the residual of the rigid motion, as a fraction of the extent, and the stretch of the bending,
which could lay any shape onto any other. Recordings of one plush have at most 0.06 and 0.17; another animal of its size has 0.16
of the first."""


def resampled(twin: Twin, observations: Observations) -> tuple[Twin, Registration]:
    """The twin on the nodes and hands of another recording, and how its shape was laid onto the twin's.

    A spring takes stiffness, dashpot and strain at rest (rest length over distance without force) from the nearest springs of the
    twin, object and controller springs apart, as geometric means weighted by inverse distance, and the sums above are kept. Masses,
    where nodes have any, are those of the nearest nodes. Substeps and scenario are still the twin's. Raises InputError if the
    shapes do not fit, or no hand reaches a node.
    """
    from scipy.spatial import cKDTree

    old, name = twin.topology, f"transfer to {observations.scenario.name}"
    nodes, count = len(old.nodes), len(observations.nodes)
    there = observations.canonical
    laid = laid_onto(old.canonical[:nodes], observations)
    factor = scale_between(old, there[:count])
    _, nearest = cKDTree(old.canonical[:nodes]).query(laid.points)
    labels = old.labels[nearest]
    radii, neighbors = infer_radii(old)
    reach, held = infer_controller_radius(old)
    new = piecewise_topology(
        observations.nodes,
        observations.controller_points[0],
        labels,
        [radius * factor for radius in radii],
        neighbors,
        reach,
        max(round(held * count / nodes), 1),
        repair=True,
        rest_shape=observations.rest_shape,
        controller_rest=old.controller_rest,
    )
    if old.object_spring_count < len(old.springs) and new.object_spring_count == len(new.springs):
        rule = f"a hand must be within {reach:.3g} m of a node, as the twin's hands are"
        raise OutOfReach(name, rule, "none is", "Check the controllers of frame 0.")
    mass = twin.material.mass[nearest] if len(twin.material.mass) else twin.material.mass
    material = replace(twin.material, contact_distance=twin.material.contact_distance * factor, mass=mass)
    return _carried(twin, new, material, np.concatenate([laid.points, laid.others])), laid


def laid_onto(nodes: np.ndarray, observations: Observations) -> Registration:
    """The shape of a recording laid onto nodes [N, 3], m, of another sampling. Raises InputError if the shapes do not fit."""
    from neuspring.twin.register import register

    there, count = observations.canonical, len(observations.nodes)
    laid = register(nodes, there[:count], there[count:])
    found = laid.rigid_residual / laid.extent
    if found > LARGEST_RESIDUAL or laid.stretch > LARGEST_STRETCH:
        rule = (
            f"other nodes ({count}, the twin has {len(nodes)}) must be of the same object: within {LARGEST_RESIDUAL:.0%} of its"
            f" size after a rigid motion, and a bending that stretches by {LARGEST_STRETCH:.0%} at most"
        )
        value = f"{found:.1%} of {laid.extent:.3g} m, and {laid.stretch:.0%}"
        remedy = "Name a recording of this object, in a like pose in frame 0, or sample both alike."
        raise InputError(f"transfer to {observations.scenario.name}", rule, value, remedy)
    return laid


def scale_between(topology: Topology, nodes: np.ndarray) -> float:
    """Spacing of other nodes over that of a topology: distances to the neighbor whose rank is the mean number of springs."""
    from neuspring.twin.register import spacing

    before = topology.canonical[: len(topology.nodes)].astype(np.float64)
    rank = max(round(2 * topology.object_spring_count / len(before)), 1)
    rank = min(rank, len(before) - 1, len(nodes) - 1)
    return spacing(nodes.astype(np.float64), rank) / spacing(before, rank)


def infer_radii(topology: Topology) -> tuple[list[float], list[int]]:
    """Radius, m, and neighbor count (self included) per region that make the object springs of a topology again.

    They are the largest that a spring within the region shows: its length, and the lower of its ends' ranks for each other. Springs
    of nodes that repair has joined show nothing; a region without springs of its own takes the values of all.
    """
    from scipy.spatial import cKDTree

    points = topology.canonical[: len(topology.nodes)].astype(np.float64)
    springs, count = topology.springs[: topology.object_spring_count], int(topology.labels.max()) + 1
    if not len(springs):
        return [0.0] * count, [2] * count
    degree = np.bincount(springs.ravel(), minlength=len(points))
    regular = (degree[springs] > REPAIR_SPRINGS).all(axis=1)
    springs = springs[regular] if regular.any() else springs
    length, tree = distances(points, springs), cKDTree(points)
    ranks = [tree.query_ball_point(points[springs[:, end]], length * RADIUS_MARGIN, return_length=True) for end in (0, 1)]
    rank = np.minimum(*ranks)
    region = topology.labels[springs]
    radii, neighbors = [], []
    for label in range(count):
        within = (region == label).all(axis=1)
        within = within if within.any() else np.ones(len(springs), dtype=bool)
        radii.append(float(length[within].max()) * RADIUS_MARGIN)
        neighbors.append(max(int(rank[within].max()), 2))
    return radii, neighbors


def _carried(twin: Twin, new: Topology, material: Material, laid: np.ndarray) -> Twin:
    """The twin with another topology, whose canonical points lie at `laid` [M + C, 3] in the frame of the twin's."""
    old = twin.topology
    lengths = {id(t): distances(t.canonical, t.springs) for t in (old, new)}
    values = {
        "stiffness": twin.material.stiffness.astype(np.float64),
        "dashpot": twin.material.dashpot.astype(np.float64),
        "strain": old.rest_lengths / _without_force(old),
    }
    middle, middle_laid = midpoints(old.canonical, old.springs), midpoints(laid, new.springs)
    found = {name: np.zeros(len(new.springs)) for name in values}
    for here, there in zip(_parts(old), _parts(new), strict=True):
        if not len(new.springs[there]) or not len(old.springs[here]):
            continue
        mean = _means(middle[here], middle_laid[there])
        for name, numbers in values.items():
            found[name][there] = mean(numbers[here])
    for here, there, of_hands in zip(_parts(old), _parts(new), (False, True), strict=True):
        # Powers of length in the sums of the module's text.
        for name, power in (("stiffness", 1 - 2 * of_hands), ("dashpot", 2 - 2 * of_hands)):
            before = _sum(old, here, values[name], lengths[id(old)], power, of_hands)
            after = _sum(new, there, found[name], lengths[id(new)], power, of_hands)
            found[name][there] *= before / after if after > 0 else 1.0
    found["strain"][found["strain"] == 0] = 1.0
    material = replace(material, stiffness=found["stiffness"], dashpot=found["dashpot"])
    # Hands hold or push with all of their springs.
    pushes = np.arange(len(new.springs)) >= new.object_spring_count if old.pushes.any() else old.pushes
    lengths_of_rest = _without_force(new) * found["strain"]
    if old.pushes.any():
        touching = float(old.rest_lengths[old.pushes].max())
        lengths_of_rest = np.where(pushes, np.minimum(touching, _without_force(new)), lengths_of_rest)
    return replace(twin, topology=replace(new, rest_lengths=lengths_of_rest, pushes=pushes), material=material)


def _without_force(topology: Topology) -> np.ndarray:
    """Distance of the ends of each spring [S], m, where it has no force."""
    parts = topology.nodes, topology.controllers, topology.springs, topology.rest_shape
    return unloaded(*parts, topology.controller_rest)


def _parts(topology: Topology) -> tuple[slice, slice]:
    """Object springs and controller springs."""
    return slice(0, topology.object_spring_count), slice(topology.object_spring_count, None)


def _sum(topology: Topology, part: slice, values: np.ndarray, lengths: np.ndarray, power: int, of_hands: bool) -> float:
    """Sum of value times length^power over springs, per node or per node that a hand holds."""
    held = len(np.unique(topology.springs[part].min(axis=1)))
    return float((values[part] * lengths[part] ** power).sum()) / max(held if of_hands else len(topology.nodes), 1)


def _means(places: np.ndarray, at: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Carrier of numbers [S] >= 0 from places [S, 3] to [P, 3]: geometric means of the nearest, by inverse distance."""
    from scipy.spatial import cKDTree

    k = min(NEAREST_SPRINGS, len(places))
    distance, index = cKDTree(places).query(at, k=k)
    distance, index = distance.reshape(len(at), k), index.reshape(len(at), k)
    # A spring at the same place decides alone; a millionth of a meter is the same place.
    weights = 1 / np.maximum(distance, 1e-6)
    weights /= weights.sum(axis=1, keepdims=True)

    def mean(numbers: np.ndarray) -> np.ndarray:
        result: np.ndarray = np.exp((weights * np.log(np.maximum(numbers, 1e-12))[index]).sum(axis=1))
        return np.where((numbers == 0).all(), 0.0, result)

    return mean


def require_pool(here: Observations, pool: Sequence[Observations]) -> None:
    """Raise InputError unless a lattice can be judged on the pool: along a line, recordings with as many nodes and hands, i on i.

    Another body may have other nodes in each recording; its shapes must fit onto each other (`laid_onto`).
    """
    recordings = [here, *pool]
    if not any(each.line.size for each in recordings):
        for there in pool:
            if len(there.nodes) != len(here.nodes):
                laid_onto(here.canonical[: len(here.nodes)], there)
        return
    require_alike(recordings, "nodes and controllers", lambda each: (len(each.nodes), each.controller_points.shape[1]))


def require_alike(recordings: Sequence[Observations], counted: str, counts: Callable[[Observations], tuple[int, ...]]) -> None:
    """Raise InputError, naming all that differ, unless recordings of a pool have as many of what is `counted`."""
    here, others = counts(recordings[0]), {each.scenario.name: counts(each) for each in recordings[1:]}
    if wrong := [f"{received} in {name}" for name, received in others.items() if received != here]:
        rule = f"recordings of a pool must have as many {counted}: {here}"
        raise InputError(f"pool of {recordings[0].scenario.name}", rule, listed(wrong), "Sample all alike, or shorten the pool.")
