"""A frame of simulation as a differentiable function of torch tensors.

Gradients reach stiffness, rest lengths, dashpots, drag, contact parameters and the initial state. Chained frames give
gradients over any horizon: only frame-boundary states are kept, and a frame whose substeps are no longer in the solver's
buffers is simulated again from its start before its backward pass.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import torch

from neuspring.core.artifacts import Twin
from neuspring.physics import collision, ground, integrate, springs
from neuspring.physics.solver import FrameSolver, Parameters


class _Frame(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        solver: FrameSolver,
        begin: torch.Tensor,
        end: torch.Tensor,
        x: torch.Tensor,
        v: torch.Tensor,
        *packed: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        solver.set_parameters(Parameters(*packed))
        result = solver.forward(x, v, begin, end)
        ctx.solver, ctx.token = solver, solver.frame_token
        ctx.save_for_backward(begin, end, x, v, *packed)
        return result

    @staticmethod
    def backward(ctx: Any, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[torch.Tensor | None, ...]:  # type: ignore[override]
        solver: FrameSolver = ctx.solver
        if solver.frame_token != ctx.token:
            begin, end, x, v, *packed = ctx.saved_tensors
            solver.set_parameters(Parameters(*packed))
            solver.forward(x, v, begin, end)
        return (None, None, None, *solver.backward(adj_x, adj_v), None)


def simulate_frame(
    solver: FrameSolver, parameters: Parameters, x: torch.Tensor, v: torch.Tensor, begin: torch.Tensor, end: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """(x, v) one frame later, differentiable in x, v and parameters. Shapes as in `FrameSolver.forward`."""
    result: tuple[torch.Tensor, torch.Tensor] = _Frame.apply(solver, begin, end, x, v, *parameters)  # type: ignore[no-untyped-call]
    return result


def pack(*, substep: float, **values: torch.Tensor) -> Parameters:
    """Pack physical parameters, differentiably, for a substep in s.

    `values` are the fields of `Material` and rest_lengths [S], m; dashpot may be one number for all springs.
    """
    return Parameters(
        springs=springs.pack(values),
        decay=integrate.pack(values, substep),
        ground=ground.pack(values),
        contact=collision.pack(values),
        distance=values["contact_distance"].reshape(1),
    )


def twin_tensors(twin: Twin, device: str, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
    """A twin's physical parameters as tensors, with the keyword names of `pack`."""
    values = {f.name: getattr(twin.material, f.name) for f in fields(twin.material)} | {"rest_lengths": twin.topology.rest_lengths}
    return {name: torch.tensor(value, dtype=dtype, device=device) for name, value in values.items()}
