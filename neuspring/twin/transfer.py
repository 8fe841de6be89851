"""A twin on another recording of the same object. Both recordings have the same nodes in the same order.

Springs keep their ends, stiffness and dashpots. Rest lengths follow frame 0 of the recording, which is a pose under load, or stay
(`simulation.rest_lengths`). Up, ground and frame time are those of the recording.
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
"""Largest median deviation of log length ratios. Objects bent in frame 0 reach 0.02; nodes in another order exceed 0.5."""
LEAST_LENGTH = 1e-9
"""Length of shorter springs in ratios, m."""


def move(
    twin: Twin,
    observations: Observations,
    *,
    keep_frame_time: bool = False,
    safety: float = 0.8,
    rest_lengths: RestLengths = "recording",
) -> Twin:
    """Move a twin to frame 0 of another recording of its object.

    The body determines what stays (`Body.on_recording`). Up, ground and, unless `keep_frame_time`, the frame time are those of
    the recording. Substeps are added if the new rest lengths require more. Raises InputError if the recording does not match the
    twin.
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
    """Move a lattice to the nodes and controllers of another recording, node i to node i.

    Springs keep ends, stiffness and dashpot; nodes keep their mass. With `rest_lengths: twin`, springs also keep their rest
    lengths, unless the recording has a rest shape. Otherwise they keep the ratio of the rest length to the distance of their ends
    without force: in the recorded rest shape or, if there is none, in frame 0. Raises InputError if the nodes do not correspond,
    or if a spring has no length.
    """
    if corresponds(twin.topology, observations):
        return replace(twin, topology=_same_nodes(twin.topology, observations, rest_lengths))
    received = f"{len(observations.nodes)} nodes and {observations.controller_points.shape[1]} controllers"
    required = f"{len(twin.topology.nodes)} nodes and {len(twin.topology.controllers)} controllers"
    rule = f"the recording must have the twin's {required} in the same order"
    raise InputError(
        f"transfer to {observations.scenario.name}", rule, f"{received}, or another order", "Fit a twin to this recording."
    )


def corresponds(topology: Topology, observations: Observations) -> bool:
    """True if node i of a recording is node i of a twin.

    Nodes and controllers have the same numbers, and the lengths of all springs change by one factor, up to `LENGTH_SPREAD`
    (median deviation of the log ratio). With another order of the nodes, springs would span the object.
    """
    equal = len(topology.nodes) == len(observations.nodes) and len(topology.controllers) == observations.controller_points.shape[1]
    springs = topology.springs[: topology.object_spring_count]
    if not equal or not len(springs):
        return equal
    lengths = distances(observations.canonical, springs), distances(topology.canonical, springs)
    ratio = np.log(np.maximum(lengths[0], LEAST_LENGTH) / np.maximum(lengths[1], LEAST_LENGTH))
    return bool(np.median(np.abs(ratio - np.median(ratio))) < LENGTH_SPREAD)


def _same_nodes(topology: Topology, observations: Observations, rest_lengths: RestLengths) -> Topology:
    """Move a topology to the nodes of a recording, node i to node i."""
    nodes, hands = observations.nodes, observations.controller_points[0]
    if rest_lengths == "twin" and not len(observations.rest_shape):
        return replace(topology, nodes=nodes, controllers=hands, rest_shape=topology.canonical)
    rest, springs = topology.controller_rest, topology.springs
    now = unloaded(nodes, hands, springs, observations.rest_shape, rest)
    ratio = now / unloaded(topology.nodes, topology.controllers, springs, topology.rest_shape, rest)
    lengths = topology.rest_lengths.astype(np.float64) * ratio
    if topology.pushes.size:
        # A controller that pushes touches at the same distance in every recording.
        lengths = np.where(topology.pushes, np.minimum(topology.rest_lengths, now), lengths)
    if not (lengths > 0).all():
        pair = topology.springs[int(np.argmin(lengths))].tolist()
        rule = "the ends of a spring may not coincide in the rest shape"
        raise InputError(f"transfer to {observations.scenario.name}", rule, f"spring {pair}", "Separate these points.")
    return replace(topology, nodes=nodes, controllers=hands, rest_lengths=lengths, rest_shape=observations.rest_shape)


def require_pool(here: Observations, pool: Sequence[Observations]) -> None:
    """Raise InputError, naming all recordings that differ, unless all have as many nodes and controllers as `here`."""
    recordings = [here, *pool]
    require_alike(recordings, "nodes and controllers", lambda seen: (len(seen.nodes), seen.controller_points.shape[1]))


def require_alike(recordings: Sequence[Observations], counted: str, counts: Callable[[Observations], tuple[int, ...]]) -> None:
    """Raise InputError, naming all recordings that differ, unless all recordings of a pool have equal `counts` of `counted`."""
    here, pool = counts(recordings[0]), {seen.scenario.name: counts(seen) for seen in recordings[1:]}
    if wrong := [f"{received} in {name}" for name, received in pool.items() if received != here]:
        rule = f"all recordings of a pool must have equal numbers of {counted}: {here}"
        raise InputError(f"pool of {recordings[0].scenario.name}", rule, listed(wrong), "Remove these, or resample all recordings.")
