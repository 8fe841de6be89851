"""How structure points follow particles through one step.

Each particle b has the rotation R_b that best maps the offsets to its neighbors in the graph (Kabsch). Where the neighbors lie on a
line, it is the smallest rotation; where there are none, there is no rotation. A point at x follows the particles b, which move by
u_b, with weights w_b ~ 1 / max(|x - b|, 0.1 mm):

    x' = x + sum_b w_b [(R_b - 1) (x - b) + u_b].
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp

from neuspring.baselines.gs_dynamics.graph import Graph
from neuspring.baselines.gs_dynamics.rules import Rules
from neuspring.core.device import load, start_warp
from neuspring.splats.skinning_kernels import turn_nodes

CLOSE = 1e-4
"""Distances are floored here before a weight is computed from them, m."""


def neighbor_table(graph: Graph) -> np.ndarray:
    """Neighbors [P, k] int32 of each particle among particles. Empty places hold the particle itself, which adds no offset."""
    among = graph.among_particles
    receivers, senders = (ends[among].cpu().numpy() for ends in (graph.receivers, graph.senders))
    order = np.argsort(receivers, kind="stable")
    receivers, senders = receivers[order], senders[order]
    slot = np.arange(len(receivers)) - np.searchsorted(receivers, receivers)
    table = np.repeat(np.arange(graph.particles, dtype=np.int32)[:, None], int(slot.max(initial=0)) + 1, axis=1)
    table[receivers, slot] = senders
    return table


def turns(graph: Graph, before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
    """Rotations [P, 3, 3] of particles that moved from `before` to `after` [P, 3], m."""
    start_warp()
    count = graph.particles
    table: Any = wp.array(neighbor_table(graph), dtype=int, device="cpu")
    positions: list[Any] = [
        wp.array(points.cpu().numpy().astype(np.float32), dtype=wp.vec3, device="cpu") for points in (before, after)
    ]
    rotations, ranks = wp.zeros(count, dtype=wp.mat33, device="cpu"), wp.zeros(count, dtype=int, device="cpu")
    # With a hundred particles the CPU is as fast as any device.
    wp.launch(load(turn_nodes, "cpu"), count, [*positions, table, rotations, ranks], device="cpu")
    return torch.tensor(rotations.numpy(), dtype=before.dtype, device=before.device)


def carry(
    points: torch.Tensor, particles: torch.Tensor, rotations: torch.Tensor, displacements: torch.Tensor, rules: Rules
) -> torch.Tensor:
    """Points [N, 3] m after particles [P, 3] m with rotations [P, 3, 3] moved by displacements [P, 3], m."""
    weights = blend_weights(torch.cdist(points, particles, compute_mode="donot_use_mm_for_euclid_dist"), rules)
    bend = rotations - torch.eye(3, dtype=points.dtype, device=points.device)
    # sum_b w_b [B_b (x - b) + u_b] = (sum_b w_b B_b) x + sum_b w_b (u_b - B_b b), relative to a center to keep digits.
    center = particles.mean(dim=0)
    shift = displacements - torch.einsum("bij,bj->bi", bend, particles - center)
    turned = torch.einsum("nij,nj->ni", (weights @ bend.flatten(1)).view(-1, 3, 3), points - center)
    return points + turned + weights @ shift


def blend_weights(distance: torch.Tensor, rules: Rules) -> torch.Tensor:
    """Weights [N, P] for distances [N, P], m, of all particles or of the nearest; rows add up to 1."""
    weights = 1 / distance.clamp(min=CLOSE)
    if rules.propagation == "nearest":
        nearest = weights.topk(min(rules.nearest, weights.shape[1]), dim=1).indices
        weights = torch.zeros_like(weights).scatter(1, nearest, weights.gather(1, nearest))
    return weights / weights.sum(dim=1, keepdim=True)
