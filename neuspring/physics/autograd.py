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
from neuspring.physics import contact, springs, velocity
from neuspring.physics.controllers import begun
from neuspring.physics.solver import FrameSolver, Parameters


class Frame(torch.autograd.Function):
    """A frame of any solver that has the three members used here.

    `run(begin, end, x, v, *packed)` simulates a frame and returns (x, v). `backward(adj_x, adj_v)` returns the adjoints of
    (x, v, *packed) in the last frame. `frame_token` counts the frames.
    """

    @staticmethod
    def forward(ctx: Any, solver: Any, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:  # type: ignore[override]
        """(x, v) after the frame, from (begin, end, x, v, *packed)."""
        state: tuple[torch.Tensor, torch.Tensor] = solver.run(*inputs)
        ctx.solver, ctx.token = solver, solver.frame_token
        ctx.save_for_backward(*inputs)
        return state

    @staticmethod
    def backward(ctx: Any, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[torch.Tensor | None, ...]:  # type: ignore[override]
        """Adjoints of the inputs; none of the controllers' path."""
        if ctx.solver.frame_token != ctx.token:
            ctx.solver.run(*ctx.saved_tensors)
        return (None, None, None, *ctx.solver.backward(adj_x, adj_v))


def simulate_frame(
    solver: Any, parameters: Parameters, x: torch.Tensor, v: torch.Tensor, begin: torch.Tensor, end: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """(x, v) one frame later, differentiable in x, v and parameters. Shapes as in `FrameSolver.forward`, solvers as in `Frame`.

    Rest lengths are those of the parameters: where grips begin later than frame 0, put theirs there first (`controllers.Grips`).
    """
    state: tuple[torch.Tensor, torch.Tensor] = Frame.apply(solver, begun(begin), end, x, v, *parameters)  # type: ignore[no-untyped-call]
    return state


def pack(*, substep: float, **values: torch.Tensor) -> Parameters:
    """Pack physical parameters, differentiably, for a substep in s.

    `values` are the fields of `Material`, of which those with a default may be left out, and rest_lengths [S], m; dashpot may be
    one number for all springs.
    """
    return Parameters(
        springs=springs.pack(values),
        decay=velocity.pack(values, substep),
        ground=contact.pack(values, "ground"),
        contact=contact.pack(values, "contact"),
        distance=values["contact_distance"].reshape(1),
        inverse_mass=velocity.pack_masses(values),
    )


def solver_for(twin: Twin, device: str = "cpu", dtype: torch.dtype = torch.float32, *, differentiable: bool = True) -> FrameSolver:
    """A solver of a twin, with its parameters set."""
    t, options = twin.topology, {"device": device, "dtype": dtype, "differentiable": differentiable}
    solver = FrameSolver(t.springs, len(t.nodes), len(t.controllers), twin.simulation, **options)  # type: ignore[arg-type]
    solver.set_parameters(packed(twin, device, dtype))
    return solver


def packed(twin: Twin, device: str = "cpu", dtype: torch.dtype = torch.float32) -> Parameters:
    """A twin's parameters, packed."""
    return pack(**twin_tensors(twin, device, dtype), substep=twin.simulation.substep)


def twin_tensors(twin: Twin, device: str, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
    """A twin's physical parameters as tensors, with the keyword names of `pack`."""
    values = {f.name: getattr(twin.material, f.name) for f in fields(twin.material)} | {"rest_lengths": twin.topology.rest_lengths}
    return {name: torch.tensor(value, dtype=dtype, device=device) for name, value in values.items()}
