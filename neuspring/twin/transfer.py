"""A twin fitted on one recording, moved to another recording of the same object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neuspring.core.artifacts import Observations, Twin
from neuspring.core.errors import InputError
from neuspring.physics import stability
from neuspring.twin.topology import unloaded


def rebase(
    twin: Twin, observations: Observations, *, keep_lengths: bool = False, keep_frame_time: bool = False, safety: float = 0.8
) -> Twin:
    """The twin on the nodes and hands of another recording, node i on node i. The rest shape is frame 0 unless recorded.

    A spring keeps its ends, stiffness, dashpot, and the ratio of its rest length to the distance of its ends where it has no force:
    in the rest shape, or in frame 0 where the twin's controllers rest there. With `keep_lengths` it keeps the rest length itself:
    trained lengths belong to the body. Those of controllers that rest in frame 0 belong to the grip, and follow the new one. Up,
    ground and, unless `keep_frame_time`, the frame time are the recording's. Substeps are added if the new distances need more.
    Raises InputError if the numbers of nodes or controllers differ, or a spring would have no length.
    """
    topology, scenario = twin.topology, observations.scenario
    nodes, hands = observations.nodes, observations.controller_points[0]
    for name, old, new in (("nodes", topology.nodes, nodes), ("controllers", topology.controllers, hands)):
        if len(old) != len(new):
            rule = f"a twin moves only to a recording of the same object with as many {name}: {len(old)}"
            raise InputError(f"transfer to {scenario.name}", rule, len(new), "Sample both alike (mocap.rings).")
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
        raise InputError(f"transfer to {scenario.name}", rule, f"spring {pair}")
    simulation = replace(
        twin.simulation,
        frame_time=twin.simulation.frame_time if keep_frame_time else 1.0 / scenario.frame_rate,
        up=scenario.up,
        ground=scenario.ground,
        self_collision=scenario.self_collision,
    )
    topology = replace(topology, nodes=nodes, controllers=hands, rest_lengths=lengths, rest_shape=observations.rest_shape)
    result = Twin(topology=topology, material=twin.material, simulation=simulation)
    count = stability.smallest_safe_substeps(stability.twin_spectrum(result), simulation.frame_time, safety)
    return replace(result, simulation=replace(simulation, substeps=max(count, simulation.substeps)))
