"""Which points become particles, and who feels whom. Batched: windows of a batch are parts of one graph without edges between."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from neuspring.baselines.gs_dynamics.rules import Rules


@dataclass(frozen=True, eq=False)
class Graph:
    """Edges among nodes 0..N-1, of which the first are particles, the others tools."""

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
    """Of B windows: points [B, K, 3] m, of which those with used [B, K] are particles, and tools [B, C, 3] m.

    A particle receives from those of its k nearest particles, itself included, that are within the radius. Particle and tool feel
    each other within the radius, or always with `connect_all`. Tools do not feel tools. Nodes: the used points of window 0, of
    window 1, ..., then the tools of window 0, of window 1, ...
    """
    count = int(used.sum())
    number = (used.flatten().cumsum(0) - 1).view(used.shape)
    # Not by products of matrices: a particle's distance from itself must be 0.
    apart = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
    apart = apart.masked_fill(~used[:, None, :], torch.inf)
    distance, near = apart.topk(min(rules.neighbours, points.shape[1]), dim=2, largest=False)
    window, receiver, slot = ((distance < rules.radius) & used[:, :, None]).nonzero(as_tuple=True)
    receivers, senders = number[window, receiver], number[window, near[window, receiver, slot]]
    reach = torch.cdist(points, tools, compute_mode="donot_use_mm_for_euclid_dist")
    touching = (torch.ones_like(reach, dtype=torch.bool) if rules.connect_all else reach < rules.radius) & used[:, :, None]
    window, receiver, tool = touching.nonzero(as_tuple=True)
    felt, feeling = number[window, receiver], count + window * tools.shape[1] + tool
    return Graph(torch.cat([receivers, felt, feeling]), torch.cat([senders, feeling, felt]), count)


def sample(
    points: torch.Tensor, usable: torch.Tensor, most: int, coverage: float, first: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Farthest points of B clouds at once: indices [B, K] into points [B, M, 3], and which entries are used [B, K].

    Starts at point first [B], adds the usable [B, M] point that is farthest from those chosen, up to `most`, and stops when all lie
    within `coverage`, m. The same as the public code's two passes: to `most` points, then among these until they are covered.
    """
    rows = torch.arange(len(points), device=points.device)
    distance = torch.where(usable, torch.inf, -torch.inf).to(points.dtype)
    chosen, used = [first], [torch.ones_like(first, dtype=torch.bool)]
    while len(chosen) < most:
        distance = torch.minimum(distance, (points - points[rows, chosen[-1]][:, None]).norm(dim=2))
        farthest, index = distance.max(dim=1)
        open_ = used[-1] & (farthest > coverage)
        if not bool(open_.any()):
            break
        chosen.append(index)
        used.append(open_)
    return torch.stack(chosen, dim=1), torch.stack(used, dim=1)
