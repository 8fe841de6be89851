"""Several twins side by side in one solver: where the points and springs of each stand among those of all.

Twins with the same nodes, which are of one scene, have one table of all springs that any of them has. A spring that a twin lacks
has no stiffness and no dashpot in it: it adds nothing. Twins of other scenes have a table of their own, since hardly a spring would
be in both. Smaller ones have points that nothing holds, behind their own, far away, where they meet nobody.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from neuspring.core.artifacts import Topology
from neuspring.physics.parameters import PARAMETERS, Parameters

ASIDE, ASIDE_STEP = 1e4, 1.0
"""Place along x of the first point that stands for none, and from there to the next, m."""


class Union:
    """The points and springs of several topologies.

    nodes, controllers    the largest numbers of any
    sizes                 those of each
    tables, table         all springs [S, 2] of each table, and the table of each topology
    places                where each topology's own springs stand in its table
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
        """Springs of the largest table."""
        return max(map(len, self.tables))

    def _shifted(self, topology: Topology) -> np.ndarray:
        """Springs [S, 2], lower ends first; controllers come behind the nodes of all."""
        ends, count = np.sort(topology.springs.astype(np.int64), axis=1), len(topology.nodes)
        return np.where(ends >= count, ends + self.nodes - count, ends)

    def of_nodes(self, values: Sequence[torch.Tensor], *, places: bool = False) -> torch.Tensor:
        """[B, N, 3] from [N_k, 3] of each; the rest is 0, or with `places` where points stand that are none."""
        rest = values[0].new_zeros((self.nodes, 3))
        if places:
            rest[:, 0] = ASIDE + ASIDE_STEP * torch.arange(self.nodes, device=rest.device)
        return torch.stack([torch.cat([one, rest[len(one) :]]) if len(one) < self.nodes else one for one in values])

    def of_controllers(self, values: Sequence[torch.Tensor]) -> torch.Tensor:
        """[..., B, C, K] from waypoints [..., C_k, K] of each; the rest stays at 0."""
        padded = [torch.nn.functional.pad(one, (0, 0, 0, self.controllers - one.shape[-2])) for one in values]
        return torch.stack(padded, dim=-3)

    def parameters(self, each: Sequence[Parameters]) -> Parameters:
        """The parameters of the twins with a leading axis [B], their springs put where they stand in their table."""
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
            # Masses of all nodes at once and of each node may meet.
            result[name] = torch.stack(torch.broadcast_tensors(*values))
        return result

    def gradients(self, gradients: Parameters, twin: int) -> Parameters:
        """Those of one of the twins, from those of all."""
        index = torch.as_tensor(self.places[twin], device=gradients["springs"].device)
        return {name: each[twin][index] if PARAMETERS[name].per == "spring" else each[twin] for name, each in gradients.items()}
