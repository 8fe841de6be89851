"""A twin fitted on one recording, moved to another recording of the same object."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neuspring.core.artifacts import Observations, Topology, Twin
from neuspring.core.errors import InputError
from neuspring.physics import stability
from neuspring.twin.register import Registration
from neuspring.twin.resample import resampled
from neuspring.twin.topology import distances, unloaded

SPREAD = 0.2
"""Cables bent in frame 0 reach 0.02; nodes in another order lie above 0.5."""
SHORTEST = 1e-9
"""Shorter springs count as this long, m."""


@dataclass(frozen=True)
class Moved:
    """A twin on another recording, and how the shapes fitted where the nodes are others."""

    twin: Twin
    registration: Registration | None

    @property
    def facts(self) -> dict[str, float]:
        """Residuals, m, stretch, and the extent, m, of the registration; empty where the nodes are the same."""
        r = self.registration
        names = ("rigid_residual", "residual", "stretch", "extent")
        return {name: getattr(r, name) for name in names} if r else {}


def rebase(
    twin: Twin, observations: Observations, *, keep_lengths: bool = False, keep_frame_time: bool = False, safety: float = 0.8
) -> Twin:
    """The twin of `move`, without the registration."""
    return move(twin, observations, keep_lengths=keep_lengths, keep_frame_time=keep_frame_time, safety=safety).twin


def move(
    twin: Twin, observations: Observations, *, keep_lengths: bool = False, keep_frame_time: bool = False, safety: float = 0.8
) -> Moved:
    """The twin on the nodes and hands of another recording. The rest shape is frame 0 unless recorded.

    Where both recordings have the same nodes in the same order (`corresponds`), a spring keeps its ends, stiffness, dashpot, and
    the ratio of its rest length to the distance of its ends where it has no force: in the rest shape, or in frame 0 where the
    twin's controllers rest there. With `keep_lengths` it keeps the rest length itself: trained lengths belong to the body. Those of
    controllers that rest in frame 0 belong to the grip, and follow the new one. Nodes keep their masses. Other nodes, as of filmed
    objects, take springs and masses of their own (`resample`), and always keep the ratio. Up, ground and, unless
    `keep_frame_time`, the frame time are the recording's. Substeps are added if the new distances need more. Raises InputError if
    the shapes do not fit, or a spring would have no length.
    """
    scenario, registration = observations.scenario, None
    if corresponds(twin.topology, observations):
        moved = replace(twin, topology=_same_nodes(twin.topology, observations, keep_lengths))
    else:
        moved, registration = resampled(twin, observations)
    simulation = replace(
        twin.simulation,
        frame_time=twin.simulation.frame_time if keep_frame_time else 1.0 / scenario.frame_rate,
        up=scenario.up,
        ground=scenario.ground,
        obstacles=scenario.obstacles,
        self_collision=scenario.self_collision,
    )
    moved = replace(moved, simulation=simulation)
    count = stability.smallest_safe_substeps(stability.twin_spectrum(moved), simulation.frame_time, safety)
    return Moved(replace(moved, simulation=replace(simulation, substeps=max(count, simulation.substeps))), registration)


def corresponds(topology: Topology, observations: Observations) -> bool:
    """Whether node i of a recording is node i of a twin: as many nodes and hands, and springs that keep their length or its scale.

    The springs' lengths change by one factor, up to `SPREAD` (median deviation of its logarithm): points in another order make
    distances across the whole body of neighbors.
    """
    alike = len(topology.nodes) == len(observations.nodes) and len(topology.controllers) == observations.controller_points.shape[1]
    springs = topology.springs[: topology.object_spring_count]
    if not alike or not len(springs):
        return alike
    lengths = distances(observations.canonical, springs), distances(topology.canonical, springs)
    ratio = np.log(np.maximum(lengths[0], SHORTEST) / np.maximum(lengths[1], SHORTEST))
    return bool(np.median(np.abs(ratio - np.median(ratio))) < SPREAD)


def _same_nodes(topology: Topology, observations: Observations, keep_lengths: bool) -> Topology:
    """The topology with the nodes of a recording, node i on node i."""
    nodes, hands = observations.nodes, observations.controller_points[0]
    rest, springs = topology.controller_rest, topology.springs
    ratio = unloaded(nodes, hands, springs, observations.rest_shape, rest)
    ratio /= unloaded(topology.nodes, topology.controllers, springs, topology.rest_shape, rest)
    if keep_lengths:
        calibrated = rest == "first_frame"
        ratio[: topology.object_spring_count if calibrated else None] = 1.0
    lengths = topology.rest_lengths.astype(np.float64) * ratio
    if not (lengths > 0).all():
        pair = topology.springs[int(np.argmin(lengths))].tolist()
        rule = "the ends of a spring may not coincide in the rest shape"
        raise InputError(f"transfer to {observations.scenario.name}", rule, f"spring {pair}")
    return replace(topology, nodes=nodes, controllers=hands, rest_lengths=lengths, rest_shape=observations.rest_shape)
