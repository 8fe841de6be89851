"""Several twins in one solver: indices of the points and springs of each twin among those of all.

Twins of one scene have the same nodes and share a table of the springs of all of them. A spring that a twin does not have gets
zero stiffness and dashpot. Each scene has its own table, because scenes would have hardly any spring in common. Twins with fewer
nodes are padded with free points, far away from the scene.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from neuspring.core.artifacts import Topology
from neuspring.physics.parameters import PARAMETERS, Parameters

ASIDE, ASIDE_STEP = 1e4, 1.0
"""Position of the first padding point along x, and the distance to the next, m."""


class Union:
    """The points and springs of several topologies.

    nodes, controllers    largest numbers of nodes and controllers
    sizes                 numbers of nodes and controllers of each topology
    tables, table         springs [S, 2] of each table, and the table of each topology
    places                indices of the springs of each topology in its table
    """

    def __init__(self, topologies: Sequence[Topology]) -> None:
        self.sizes = [(len(one.nodes), len(one.controllers)) for one in topologies]
        self.nodes, self.controllers = (max(numbers) for numbers in zip(*self.sizes, strict=True))
        scenes = [(size, one.nodes.tobytes()) for size, one in zip(self.sizes, topologies, strict=True)]
        known = list(dict.fromkeys(scenes))
        self.table = [known.index(scene) for scene in scenes]
        self.tables, self.places = list[np.ndarray](), [np.empty(0, np.int64)] * len(topologies)
        total = self.nodes + self.controllers
        for table in range(len(known)):
            members = [k for k, own in enumerate(self.table) if own == table]
            codes = [self._shifted(topologies[k]) @ np.array([total, 1]) for k in members]
            every = np.unique(np.concatenate(codes))
            self.tables.append(np.stack([every // total, every % total], axis=1).astype(np.int32))
            for k, own in zip(members, codes, strict=True):
                self.places[k] = np.searchsorted(every, own)

    @property
    def springs(self) -> int:
        """Number of springs of the largest table."""
        return max(map(len, self.tables))

    def _shifted(self, topology: Topology) -> np.ndarray:
        """Springs [S, 2], lower ends first, with controllers after the padded nodes."""
        ends, count = np.sort(topology.springs.astype(np.int64), axis=1), len(topology.nodes)
        return np.where(ends >= count, ends + self.nodes - count, ends)

    def of_nodes(self, values: Sequence[torch.Tensor], *, places: bool = False) -> torch.Tensor:
        """Pad values [N_k, 3] of each twin to [B, N, 3], with 0 or, with `places`, with positions of padding points."""
        rest = values[0].new_zeros((self.nodes, 3))
        if places:
            rest[:, 0] = ASIDE + ASIDE_STEP * torch.arange(self.nodes, device=rest.device)
        return torch.stack([torch.cat([one, rest[len(one) :]]) if len(one) < self.nodes else one for one in values])

    def of_controllers(self, values: Sequence[torch.Tensor]) -> torch.Tensor:
        """Pad waypoints [..., C_k, K] of each twin to [..., B, C, K], with 0."""
        padded = [torch.nn.functional.pad(one, (0, 0, 0, self.controllers - one.shape[-2])) for one in values]
        return torch.stack(padded, dim=-3)

    def parameters(self, each: Sequence[Parameters]) -> Parameters:
        """Stack the parameters of the twins with a leading axis [B], with springs in the order of their table."""
        result = {}
        for name, parameter in PARAMETERS.items():
            values = [one[name] for one in each]
            if parameter.per == "spring":
                own, values = values, [value.new_zeros((self.springs, *value.shape[1:])) for value in values]
                for target, value, place in zip(values, own, self.places, strict=True):
                    target[torch.as_tensor(place, device=target.device)] = value
            elif parameter.per == "node":
                values = [
                    torch.cat([one, one[-1:].expand(self.nodes - len(one))]) if 1 < len(one) < self.nodes else one for one in values
                ]
            # Some twins may have one mass for all nodes, others a mass per node.
            result[name] = torch.stack(torch.broadcast_tensors(*values))
        return result

    def gradients(self, gradients: Parameters, twin: int) -> Parameters:
        """Select the gradients of one twin from those of all twins."""
        index = torch.as_tensor(self.places[twin], device=gradients["springs"].device)
        return {name: each[twin][index] if PARAMETERS[name].per == "spring" else each[twin] for name, each in gradients.items()}
