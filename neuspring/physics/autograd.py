"""A frame of simulation as a differentiable function of torch tensors.

Gradients reach stiffness, rest lengths, dashpots, drag, contact parameters and the initial state. Chained frames give
gradients over any horizon: only frame-boundary states are kept, and a frame whose substeps are no longer in the solver's
buffers is simulated again from its start before its backward pass.
"""

from __future__ import annotations

from typing import Any

import torch

from neuspring.core.artifacts import SCALARS, Twin
from neuspring.physics.solver import FrameSolver, Parameters

ELASTICITY_RANGE = (0.0, 1.0)
FRICTION_RANGE = (0.0, 2.0)


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
    result: tuple[torch.Tensor, torch.Tensor] = _Frame.apply(solver, begin, end, x, v, *parameters.tensors())  # type: ignore[no-untyped-call]
    return result


def pack(
    *,
    stiffness: torch.Tensor,
    rest_lengths: torch.Tensor,
    dashpot: torch.Tensor,
    drag: torch.Tensor,
    ground_elasticity: torch.Tensor,
    ground_friction: torch.Tensor,
    contact_elasticity: torch.Tensor,
    contact_friction: torch.Tensor,
    contact_distance: torch.Tensor,
    substep: float,
) -> Parameters:
    """Pack physical parameters, differentiably. stiffness, rest_lengths, dashpot are [S]; the rest are scalars.

    Elasticities and frictions are clamped to [0, 1] and [0, 2] on use, as in the released simulator.
    """
    return Parameters(
        springs=torch.stack([stiffness, 1.0 / rest_lengths, dashpot.expand_as(stiffness)], dim=1),
        decay=torch.exp(-substep * drag).reshape(1),
        ground=torch.stack([ground_elasticity.clamp(*ELASTICITY_RANGE), ground_friction.clamp(*FRICTION_RANGE)]),
        contact=torch.stack([contact_elasticity.clamp(*ELASTICITY_RANGE), contact_friction.clamp(*FRICTION_RANGE)]),
        distance=contact_distance.reshape(1),
    )


def twin_tensors(twin: Twin, device: str, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
    """A twin's physical parameters as tensors, with the keyword names of `pack`."""
    as_tensor = {"dtype": dtype, "device": device}
    values = {name: torch.tensor(getattr(twin.material, name), **as_tensor) for name in SCALARS}  # type: ignore[arg-type]
    values["stiffness"] = torch.tensor(twin.material.stiffness, **as_tensor)  # type: ignore[arg-type]
    values["dashpot"] = torch.tensor(twin.material.dashpot, **as_tensor)  # type: ignore[arg-type]
    values["rest_lengths"] = torch.tensor(twin.topology.rest_lengths, **as_tensor)  # type: ignore[arg-type]
    return values
