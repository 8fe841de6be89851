"""Which points become particles, and which nodes have edges. A batch of windows is one graph without edges between windows."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from neuspring.baselines.gs_dynamics.rules import Rules


@dataclass(frozen=True, eq=False)
class Graph:
    """Directed edges among nodes 0..N-1. The first nodes are particles, the others tools."""

    receivers: torch.Tensor
    """[E] int64."""
    senders: torch.Tensor
    """[E] int64."""
    particles: int

    @property
    def among_particles(self) -> torch.Tensor:
        """[E] bool: edges without a tool."""
        return (self.receivers < self.particles) & (self.senders < self.particles)


def connect(points: torch.Tensor, used: torch.Tensor, tools: torch.Tensor, rules: Rules) -> Graph:
    """The graph of B windows with points [B, K, 3] and tools [B, C, 3], m. Points with used [B, K] are particles.

    A particle receives from its k nearest particles, itself included, as far as they are within the radius. Between a particle and
    a tool within the radius, or any tool with `connect_all`, there are edges both ways. There are none between tools. The nodes are
    the particles of window 0, of window 1, ..., then the tools of window 0, of window 1, ...
    """
    count = int(used.sum())
    number = (used.flatten().cumsum(0) - 1).view(used.shape)
    # Not by products of matrices: a particle's distance from itself must be 0.
    distances = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
    distances = distances.masked_fill(~used[:, None, :], torch.inf)
    distance, near = distances.topk(min(rules.neighbors, points.shape[1]), dim=2, largest=False)
    window, receiver, slot = ((distance < rules.radius) & used[:, :, None]).nonzero(as_tuple=True)
    receivers, senders = number[window, receiver], number[window, near[window, receiver, slot]]
    tool_distances = torch.cdist(points, tools, compute_mode="donot_use_mm_for_euclid_dist")
    near_tools = torch.ones_like(tool_distances, dtype=torch.bool) if rules.connect_all else tool_distances < rules.radius
    window, point, tool = (near_tools & used[:, :, None]).nonzero(as_tuple=True)
    particle_ends, tool_ends = number[window, point], count + window * tools.shape[1] + tool
    return Graph(torch.cat([receivers, particle_ends, tool_ends]), torch.cat([senders, tool_ends, particle_ends]), count)


def sample(
    points: torch.Tensor, usable: torch.Tensor, most: int, coverage: float, first: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Farthest-point samples of B clouds at once: indices [B, K] into points [B, M, 3], and which entries are used [B, K].

    A sample starts at point first [B] and adds the usable [B, M] point that is farthest from it, up to `most` points or until all
    points lie within `coverage`, m. The public code's two passes give the same: `most` points, then as many of these as cover.
    """
    rows = torch.arange(len(points), device=points.device)
    distance = torch.where(usable, torch.inf, -torch.inf).to(points.dtype)
    indices, used = [first], [torch.ones_like(first, dtype=torch.bool)]
    while len(indices) < most:
        distance = torch.minimum(distance, (points - points[rows, indices[-1]][:, None]).norm(dim=2))
        farthest, index = distance.max(dim=1)
        uncovered = used[-1] & (farthest > coverage)
        if not bool(uncovered.any()):
            break
        indices.append(index)
        used.append(uncovered)
    return torch.stack(indices, dim=1), torch.stack(used, dim=1)
