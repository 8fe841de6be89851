"""An unloaded shape that is estimated: X + u(X), X the canonical shape of nodes and controllers, u a smooth displacement.

A few points p_k are handles. Each has a displacement t_k and a displacement gradient A_k; weights w_k blend them:

    u(x) = h sum_k w_k(x) (t_k + A_k (x - p_k) / s),      w_k(x) ~ exp(-|x - p_k|^2 / 2 s^2),   sum_k w_k = 1

with h the node spacing and s the median distance of a handle to the nearest other one. So t and A have no unit, every affine map of
the body can be met exactly, and a cable can curve without shear. Rest lengths follow:

    l0' = l0 |(x + u)_i - (x + u)_j| / |x_i - x_j|

Controllers move with u as the nodes around them do: a grip holds material points, and a rigid part of u must change no length.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from neuspring.core.artifacts import Topology
from neuspring.core.geometry import farthest
from neuspring.twin.topology import node_spacing


def topology_spacing(topology: Topology) -> float:
    """Distance between neighboring nodes in the rest shape, m (spacing.py); of one node alone, the median rest length."""
    nodes = topology.canonical[: len(topology.nodes)]
    return node_spacing(nodes) if len(nodes) > 1 else float(np.median(topology.rest_lengths.astype(np.float64)))


def blending(points: np.ndarray, count: int) -> np.ndarray:
    """Matrix [P, 4 H] that takes (t_k, columns of A_k) of H = min(count, P) handles to u / h at points [P, 3], m."""
    from scipy.spatial import cKDTree

    centers = points[farthest(points, count)]
    away = points[:, None] - centers  # [P, H, 3]
    gaps = cKDTree(centers).query(centers, k=2)[0][:, 1]
    scale = float(np.median(gaps))
    exponent = -(away**2).sum(axis=2) / (2 * scale**2)
    # The largest exponent is taken out first, so that a point far from all handles has weights too.
    weights = np.exp(exponent - exponent.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    parts = np.concatenate([np.ones_like(away[..., :1]), away / scale], axis=2) * weights[..., None]
    matrix: np.ndarray = parts.reshape(len(points), -1)
    return matrix


class UnloadedShape(nn.Module):
    """u of a topology, zero at the start: forward() gives the factors l0' / l0 [S] of the rest lengths."""

    matrix: torch.Tensor
    apart: torch.Tensor
    change: torch.Tensor

    def __init__(self, topology: Topology, handles: int) -> None:
        super().__init__()
        points = topology.canonical.astype(np.float64)
        matrix = topology_spacing(topology) * blending(points, handles)
        first, second = topology.springs.T
        for name, values in (
            ("matrix", matrix),
            ("apart", points[first] - points[second]),
            ("change", matrix[first] - matrix[second]),
        ):
            self.register_buffer(name, torch.from_numpy(values.astype(np.float32)), persistent=False)
        self.handles = nn.Parameter(torch.zeros(matrix.shape[1], 3))

    def forward(self) -> torch.Tensor:
        """l0' / l0 [S], 1 where u changes no length."""
        ratio: torch.Tensor = (self.apart + self.change @ self.handles).norm(dim=1) / self.apart.norm(dim=1)
        return ratio

    def displacement(self) -> torch.Tensor:
        """u [N + C, 3], m, of nodes, then controllers."""
        return self.matrix @ self.handles
