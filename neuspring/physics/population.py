"""Several twins of the same nodes and controllers in one solver: their topologies as one graph.

A twin's spring that another one lacks is there for both, and has no stiffness and no dashpot in the other: it adds nothing. The
springs of a node are summed in the order of its partners, so that a twin moves, bit for bit, as in a solver of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from neuspring.core.artifacts import Topology, Twin
from neuspring.physics.autograd import packed
from neuspring.physics.solver import FrameSolver, Parameters


def union(topologies: Sequence[Topology]) -> tuple[np.ndarray, list[np.ndarray]]:
    """All springs [S, 2] of several topologies, and for each topology where its own springs stand among them."""
    total = len(topologies[0].nodes) + len(topologies[0].controllers)
    codes = [np.sort(t.springs.astype(np.int64), axis=1) @ np.array([total, 1]) for t in topologies]
    every = np.unique(np.concatenate(codes))
    return np.stack([every // total, every % total], axis=1).astype(np.int32), [np.searchsorted(every, c) for c in codes]


def solver_of(
    twins: Sequence[Twin], device: str = "cpu", dtype: torch.dtype = torch.float32, *, differentiable: bool = True
) -> FrameSolver:
    """A solver of twins of the same nodes and controllers, with their parameters set. Its tensors have a leading axis [B]."""
    pairs, places = union([twin.topology for twin in twins])
    first = twins[0].topology
    simulations = [twin.simulation for twin in twins]
    solver = FrameSolver(
        pairs, len(first.nodes), len(first.controllers), simulations, device=device, dtype=dtype, differentiable=differentiable
    )
    solver.set_parameters(stacked([packed(twin, device, dtype) for twin in twins], places, len(pairs)))
    return solver


def stacked(each: Sequence[Parameters], places: Sequence[np.ndarray], springs: int) -> Parameters:
    """The parameters of several twins with a leading axis [B], their springs put where they stand among all `springs`."""
    own = [one.springs.new_zeros((springs, 3)) for one in each]
    for target, one, place in zip(own, each, places, strict=True):
        target[torch.as_tensor(place, device=target.device)] = one.springs
    # Masses of all nodes at once and of each node may meet.
    rest = (torch.stack(torch.broadcast_tensors(*values)) for values in list(zip(*each, strict=True))[1:])
    return Parameters(torch.stack(own), *rest)
