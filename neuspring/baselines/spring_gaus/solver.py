"""A frame of anchors as a differentiable function of torch tensors, on the CPU and on CUDA."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from neuspring.baselines.spring_gaus.graph import AnchorGraph
from neuspring.baselines.spring_gaus.kernels import substep_kernels
from neuspring.core.device import load, start_warp


@dataclass(frozen=True)
class AnchorPhysics:
    """What does not change while a model is trained."""

    frame_time: float
    """s."""
    exponent: float = 0.5
    """p in (1 + |e|)^p."""
    link_stiffness: float = 3e4
    """Of the controllers' links, N per unit strain at 1 kg."""
    gravity: float = 9.8
    """m/s^2, against up."""
    up_sign: float = 1.0
    """+1 where +z is up, -1 where -z is."""
    ground: bool = True
    """A plane at z = 0."""


@dataclass(frozen=True)
class AnchorParameters:
    """What is trained, as the forces take it (at 1 kg per anchor)."""

    stiffness: torch.Tensor
    """[N] s_i, N: 10^kappa."""
    soft: torch.Tensor
    """[K] eta, by rank."""
    damping: torch.Tensor
    """zeta, N s: divided by the rest length, then as a dashpot."""
    friction: torch.Tensor
    """phi: what is left of the velocity along the ground after each substep on it."""

    def tensors(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """As the kernel takes them: stiffness [N], soft [K], (damping, friction) [2]."""
        return self.stiffness, self.soft, torch.stack([self.damping.reshape(()), self.friction.reshape(())])


class AnchorSolver:
    """Advances anchors by frames of a fixed number of substeps, forward and backward, each a captured graph."""

    def __init__(
        self, graph: AnchorGraph, physics: AnchorPhysics, substeps: int, device: str = "cpu", dtype: torch.dtype = torch.float32
    ) -> None:
        start_warp()
        self.physics, self.substeps, self.device, self.dtype = physics, substeps, device, dtype
        self._real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
        self._vec3 = wp.types.vector(3, self._real)
        self.count, ranks = graph.neighbours.shape
        controllers = int(graph.links.max(initial=-1)) + 1
        tables = (graph.neighbours, graph.lengths, graph.link_starts, graph.links, graph.link_lengths)
        self._tables = [self._table(values) for values in tables]
        self._buffers: dict[str, torch.Tensor] = {}
        self._views: dict[str, Any] = {}
        vectors = {"x": (substeps + 1, self.count), "v": (substeps + 1, self.count), "begin": (controllers,), "end": (controllers,)}
        scalars = {"stiffness": self.count, "soft": ranks, "scalars": 2}
        adjoint = ("x", "v", *scalars)
        for name, vector in vectors.items():
            for each in (name, f"adj_{name}") if name in adjoint else (name,):
                self._buffer(each, (*vector, 3), self._vec3)
        for name, size in scalars.items():
            for each in (name, f"adj_{name}"):
                self._buffer(each, (size,), self._real)
        self._graphs: dict[bool, Any] = {}
        self.frame_token = 0

    def _table(self, values: np.ndarray) -> Any:
        kind = wp.int32 if values.dtype.kind == "i" else self._real
        return wp.array(values, dtype=kind, device=self.device)

    def _buffer(self, name: str, shape: tuple[int, ...], kind: Any) -> None:
        tensor = torch.zeros(shape, dtype=self.dtype, device=self.device)
        self._buffers[name] = tensor
        self._views[name] = wp.from_torch(tensor, dtype=kind)

    def frame(
        self, parameters: AnchorParameters, x: torch.Tensor, v: torch.Tensor, begin: torch.Tensor, end: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(x, v) [N, 3] one frame later, differentiable in x, v and parameters; controllers [C, 3] go from `begin` to `end`."""
        result: tuple[torch.Tensor, torch.Tensor] = _Frame.apply(self, begin, end, x, v, *parameters.tensors())  # type: ignore[no-untyped-call]
        return result

    def forward(self, state: tuple[torch.Tensor, ...], packed: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        """State after a frame, from (begin, end, x, v) and the kernel's (stiffness, soft, scalars)."""
        b, (begin, end, x, v) = self._buffers, state
        for name, value in zip(("stiffness", "soft", "scalars"), packed, strict=True):
            b[name].copy_(value)
        # Controllers after the last that holds an anchor do not matter.
        b["begin"].copy_(begin[: len(b["begin"])])
        b["end"].copy_(end[: len(b["end"])])
        b["x"][0], b["v"][0] = x, v
        self._launch(backward=False)
        self.frame_token += 1
        return b["x"][-1].clone(), b["v"][-1].clone()

    def backward(self, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Adjoints of the last forward frame: dL/d(x, v, stiffness, soft, scalars)."""
        b = self._buffers
        for name in [name for name in b if name.startswith("adj_")]:
            b[name].zero_()
        b["adj_x"][-1], b["adj_v"][-1] = adj_x, adj_v
        self._launch(backward=True)
        own = (b[f"adj_{name}"].clone() for name in ("stiffness", "soft", "scalars"))
        return b["adj_x"][0].clone(), b["adj_v"][0].clone(), *own

    def _launch(self, *, backward: bool) -> None:
        if backward not in self._graphs:
            kernel = load(substep_kernels(self._real)[backward], self.device)
            with wp.ScopedCapture(device=self.device) as capture:
                for substep in reversed(range(self.substeps)) if backward else range(self.substeps):
                    wp.launch(kernel, self.count, self._arguments(substep, backward), device=self.device)
            self._graphs[backward] = capture.graph
        # Torch orders its own work on its current stream, so the graph must run there too.
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device)) if self.device != "cpu" else None
        wp.capture_launch(self._graphs[backward], stream=stream)

    def _arguments(self, substep: int, backward: bool) -> list[Any]:
        w, real, physics = self._views, self._real, self.physics
        neighbours, lengths, starts, links, link_lengths = self._tables
        forward = [
            *(w["x"], w["v"], substep),
            *(w["begin"], w["end"], real((substep + 1) / self.substeps)),
            *(neighbours, lengths),
            *(w["stiffness"], w["soft"], w["scalars"]),
            real(physics.exponent),
            *(starts, links, link_lengths),
            real(physics.link_stiffness),
            real(physics.frame_time / self.substeps),
            real(-physics.up_sign * physics.gravity),
            real(physics.up_sign),
            int(physics.ground),
        ]
        return forward + [w[f"adj_{name}"] for name in ("x", "v", "stiffness", "soft", "scalars") if backward]


class _Frame(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        solver: AnchorSolver,
        begin: torch.Tensor,
        end: torch.Tensor,
        x: torch.Tensor,
        v: torch.Tensor,
        *packed: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        result = solver.forward((begin, end, x, v), packed)
        ctx.solver, ctx.token = solver, solver.frame_token
        ctx.save_for_backward(begin, end, x, v, *packed)
        return result

    @staticmethod
    def backward(ctx: Any, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[torch.Tensor | None, ...]:  # type: ignore[override]
        solver: AnchorSolver = ctx.solver
        if solver.frame_token != ctx.token:
            begin, end, x, v, *packed = ctx.saved_tensors
            solver.forward((begin, end, x, v), tuple(packed))
        return (None, None, None, *solver.backward(adj_x, adj_v))
