"""A frame of anchors as a differentiable function of torch tensors, on the CPU and on CUDA."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp

from neuspring.baselines.spring_gaus.graph import AnchorGraph
from neuspring.baselines.spring_gaus.kernels import kernels
from neuspring.core.device import start_warp
from neuspring.physics.arrays import Graphs
from neuspring.physics.solver import simulate_frame

PACKED = ("stiffness", "soft", "scalars")
"""Trained parameters as the kernels take them, see `AnchorParameters.tensors`."""


@dataclass(frozen=True, kw_only=True)
class AnchorPhysics:
    """Constants of the motion: they are not trained."""

    frame_time: float
    """s."""
    exponent: float = 0.5
    """p in (1 + |e|)^p."""
    link_stiffness: float = 3e4
    """N per unit strain of the controllers' links, at 1 kg."""
    gravity: float = 9.8
    """m/s^2, against up."""
    up_sign: float = 1.0
    """+1 where +z is up, -1 where -z is."""
    ground: bool = True
    """A plane at z = 0."""


@dataclass(frozen=True)
class AnchorParameters:
    """What is trained, in the form that the forces use, at 1 kg per anchor."""

    stiffness: torch.Tensor
    """[N] s_i, N: 10^kappa."""
    soft: torch.Tensor
    """[K] eta, by rank."""
    damping: torch.Tensor
    """zeta, N s: divided by a spring's rest length it is the constant of its dashpot."""
    friction: torch.Tensor
    """phi: the fraction of the velocity along the ground that remains after each substep on it."""

    def tensors(self) -> dict[str, torch.Tensor]:
        """As the kernels take them: stiffness [N], soft [K], scalars (damping, friction) [2]."""
        scalars = torch.stack([self.damping.reshape(()), self.friction.reshape(())])
        return {"stiffness": self.stiffness, "soft": self.soft, "scalars": scalars}


class AnchorSolver:
    """Advances anchors by frames of a fixed number of substeps. The forward and the backward pass are each a captured graph."""

    def __init__(
        self, graph: AnchorGraph, physics: AnchorPhysics, substeps: int, device: str = "cpu", dtype: torch.dtype = torch.float32
    ) -> None:
        start_warp()
        self.physics, self.substeps, self.device, self.dtype = physics, substeps, device, dtype
        self._real = real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
        self._kernels = kernels(real)
        vec3 = wp.types.vector(3, real)
        self.count, ranks = graph.neighbors.shape
        controllers = int(graph.links.max(initial=-1)) + 1
        self._buffers: dict[str, torch.Tensor] = {}
        self._state, self._adjoint, self._model = self._kernels.State(), self._kernels.State(), self._kernels.Model()
        for struct, prefix in ((self._state, ""), (self._adjoint, "adj_")):
            for name in ("x", "v"):
                setattr(struct, name, self._allocate(prefix + name, (substeps + 1, self.count, 3), vec3))
            for name, size in zip(PACKED, (self.count, ranks, 2), strict=True):
                setattr(struct, name, self._allocate(prefix + name, (size,), real))
        for name in ("begin", "end"):
            setattr(self._model, name, self._allocate(name, (controllers, 3), vec3))
        for name in ("neighbors", "lengths", "link_starts", "links", "link_lengths"):
            values = getattr(graph, name)
            kind = wp.int32 if values.dtype.kind == "i" else real
            setattr(self._model, name, wp.array(values, dtype=kind, device=device))
        self._model.exponent, self._model.link_stiffness = physics.exponent, physics.link_stiffness
        self._model.substep = physics.frame_time / substeps
        self._model.gravity, self._model.up = -physics.up_sign * physics.gravity, physics.up_sign
        self._model.ground = int(physics.ground)
        self._graphs = Graphs(device)
        self.frame_token = 0
        """Number of the frame whose substeps are in the buffers."""

    def _allocate(self, name: str, shape: tuple[int, ...], kind: Any) -> Any:
        self._buffers[name] = torch.zeros(shape, dtype=self.dtype, device=self.device)
        return wp.from_torch(self._buffers[name], dtype=kind)

    def frame(
        self, parameters: AnchorParameters, x: torch.Tensor, v: torch.Tensor, begin: torch.Tensor, end: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(x, v) [N, 3] one frame later, differentiable in x, v and parameters; controllers [C, 3] go from `begin` to `end`."""
        return simulate_frame(self, parameters.tensors(), x, v, begin, end)

    def run(
        self, begin: torch.Tensor, end: torch.Tensor, x: torch.Tensor, v: torch.Tensor, parameters: dict[str, torch.Tensor]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(x, v) after a frame with parameters as the kernels take them."""
        b = self._buffers
        for name in PACKED:
            b[name].copy_(parameters[name])
        # Controllers after the last that holds an anchor do not matter.
        b["begin"].copy_(begin[: len(b["begin"])])
        b["end"].copy_(end[: len(b["end"])])
        b["x"][0], b["v"][0] = x, v
        self._launch(backward=False)
        self.frame_token += 1
        return b["x"][-1].clone(), b["v"][-1].clone()

    def backward(self, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        """Adjoints of the last forward frame: of x, of v, and of parameters by name."""
        b = self._buffers
        for name in ("x", "v", *PACKED):
            b[f"adj_{name}"].zero_()
        b["adj_x"][-1], b["adj_v"][-1] = adj_x, adj_v
        self._launch(backward=True)
        return b["adj_x"][0].clone(), b["adj_v"][0].clone(), {name: b[f"adj_{name}"].clone() for name in PACKED}

    def _launch(self, *, backward: bool) -> None:
        kernel = self._kernels.adjoint if backward else self._kernels.substep
        structs = (self._state, self._model, self._adjoint) if backward else (self._state, self._model)

        def record() -> None:
            for substep in reversed(range(self.substeps)) if backward else range(self.substeps):
                fraction = self._real((substep + 1) / self.substeps)
                wp.launch(kernel, self.count, [substep, fraction, *structs], device=self.device)

        self._graphs.run("backward" if backward else "forward", [kernel], record)
