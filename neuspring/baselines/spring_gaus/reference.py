"""The anchors' substep in torch: the specification of the kernels. Differentiable, in any precision."""

from __future__ import annotations

import torch

from neuspring.baselines.spring_gaus.graph import AnchorGraph
from neuspring.baselines.spring_gaus.kernels import MIN_LENGTH, SLACK
from neuspring.baselines.spring_gaus.solver import AnchorParameters, AnchorPhysics


def substep(
    graph: AnchorGraph,
    physics: AnchorPhysics,
    parameters: AnchorParameters,
    x: torch.Tensor,
    v: torch.Tensor,
    controllers: torch.Tensor,
    step: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """(x, v) [N, 3] after one substep of `step` s, under controllers [C, 3] at its end. Equations as in `kernels`."""
    neighbors = torch.tensor(graph.neighbors, device=x.device).long()
    rest = torch.tensor(graph.lengths, dtype=x.dtype, device=x.device)
    offset = x[neighbors] - x[:, None]
    length = offset.norm(dim=2)
    n = offset / length.clamp(min=MIN_LENGTH)[..., None]
    stretch = length - rest
    stiff = parameters.stiffness[:, None] / rest * parameters.soft * stretch
    pull = torch.where(stretch.abs() < SLACK, 0.0, stiff * (1 + stretch.abs() / rest) ** physics.exponent)
    closing = ((v[neighbors] - v[:, None]) * n).sum(dim=2)
    force = ((pull + parameters.damping / rest * closing)[..., None] * n).sum(dim=1)
    anchor = torch.tensor(graph.link_anchors, device=x.device).long()
    reach = controllers[torch.tensor(graph.links, device=x.device).long()] - x[anchor]
    distance = reach.norm(dim=1, keepdim=True)
    strain = distance / torch.tensor(graph.link_lengths, dtype=x.dtype, device=x.device)[:, None] - 1
    force = force.index_add(0, anchor, reach / distance.clamp(min=MIN_LENGTH) * strain * physics.link_stiffness)
    force = force + x.new_tensor([0.0, 0.0, -physics.up_sign * physics.gravity])
    v = v + step * force
    x = x + step * v
    if physics.ground:
        below = (physics.up_sign * x[:, 2:] <= 0).expand(-1, 3)
        x = torch.where(below, x * x.new_tensor([1.0, 1.0, 0.0]), x)
        slowed = torch.cat([v[:, :2] * parameters.friction, torch.zeros_like(v[:, 2:])], dim=1)
        v = torch.where(below, slowed, v)
    return x, v
