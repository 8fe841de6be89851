"""A twin on another recording of the same object, where both have the same nodes in the same order.

Springs keep their ends, stiffness and dashpots. Rest lengths follow the recording's frame 0, a pose under load, or are kept
(`simulation.rest_lengths`). Up, ground and frame time are the recording's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from neuspring.config.simulation import RestLengths
from neuspring.core.artifacts import Observations, Topology, Twin
from neuspring.core.errors import InputError
from neuspring.core.text import listed
from neuspring.physics.topology import distances, unloaded
from neuspring.twin.body import body_of

LENGTH_SPREAD = 0.2
"""Bodies bent in frame 0 reach 0.02; nodes in another order lie above 0.5."""
LEAST_LENGTH = 1e-9
"""Shorter springs count as this long, m."""


def move(
    twin: Twin,
    observations: Observations,
    *,
    keep_frame_time: bool = False,
    safety: float = 0.8,
    rest_lengths: RestLengths = "recording",
) -> Twin:
    """The twin in frame 0 of another recording of its object.

    Its body decides what stays (`Body.on_recording`). Up, ground and, unless `keep_frame_time`, the frame time are the recording's.
    Substeps are added if the new distances need more. Raises InputError if the recording is of another body.
    """
    scenario, body = observations.scenario, body_of(twin)
    simulation = replace(
        twin.simulation,
        frame_time=twin.simulation.frame_time if keep_frame_time else 1.0 / scenario.frame_rate,
        up=scenario.up,
        ground=scenario.ground,
        self_collision=scenario.self_collision,
    )
    return body.stable(replace(body.on_recording(twin, observations, rest_lengths), simulation=simulation), safety)


def on_nodes(twin: Twin, observations: Observations, rest_lengths: RestLengths) -> Twin:
    """A lattice on the nodes and hands of another recording, node i on node i.

    A spring keeps its ends, stiffness and dashpot, a node its mass. With `rest_lengths: twin` a spring keeps its rest length too,
    else its ratio to the distance of the ends where they have no force: in the recorded rest shape, which always counts, or in
    frame 0. Raises InputError if the nodes do not correspond, or a spring has no length.
    """
    if corresponds(twin.topology, observations):
        return replace(twin, topology=_same_nodes(twin.topology, observations, rest_lengths))
    there = f"{len(observations.nodes)} nodes and {observations.controller_points.shape[1]} controllers"
    own = f"{len(twin.topology.nodes)} nodes and {len(twin.topology.controllers)} controllers"
    rule = f"the recording must have the twin's {own} in the same order"
    remedy = "Use recordings with corresponding nodes, or learn a twin on this recording."
    raise InputError(f"transfer to {observations.scenario.name}", rule, f"{there}, or another order", remedy)


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


def _same_nodes(topology: Topology, observations: Observations, rest_lengths: RestLengths) -> Topology:
    """The topology with the nodes of a recording, node i on node i."""
    nodes, hands = observations.nodes, observations.controller_points[0]
    if rest_lengths == "twin" and not len(observations.rest_shape):
        return replace(topology, nodes=nodes, controllers=hands, rest_shape=topology.canonical)
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


def require_pool(here: Observations, pool: Sequence[Observations]) -> None:
    """Raise InputError unless a lattice can be judged on the pool: recordings with as many nodes and controllers, i on i.

    Rings around a line that is recorded from its other end are others; all such recordings are named.
    """
    recordings = [here, *pool]
    require_alike(recordings, "nodes and controllers", lambda each: (len(each.nodes), each.controller_points.shape[1]))


def require_alike(recordings: Sequence[Observations], counted: str, counts: Callable[[Observations], tuple[int, ...]]) -> None:
    """Raise InputError, naming all that differ, unless recordings of a pool have as many of what is `counted`."""
    here, others = counts(recordings[0]), {each.scenario.name: counts(each) for each in recordings[1:]}
    if wrong := [f"{received} in {name}" for name, received in others.items() if received != here]:
        rule = f"recordings of a pool must have as many {counted}: {here}"
        raise InputError(f"pool of {recordings[0].scenario.name}", rule, listed(wrong), "Sample all alike, or shorten the pool.")
