"""One frame of simulation, forward and backward, each a captured graph on the CPU and on CUDA.

Memory is substeps x nodes and does not grow with the number of frames: longer gradients run each frame again from its stored
start (see `autograd.py`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch

from neuspring.core.artifacts import Simulation
from neuspring.physics import collision, contact, position, springs, velocity
from neuspring.physics.buffers import Buffers, Graphs


class Parameters(NamedTuple):
    """Physical parameters as the kernels take them, tensors of the solver's dtype and device. Made by `pack`."""

    springs: torch.Tensor
    """[S, 3]: stiffness [N], 1 / rest length [1/m], dashpot [N s/m]."""
    decay: torch.Tensor
    """[1]: exp(-substep * drag)."""
    ground: torch.Tensor
    """[2]: elasticity in [0, 1], friction in [0, 2]."""
    contact: torch.Tensor
    """[2]: the same between nodes."""
    distance: torch.Tensor
    """[1]: contact distance, m. No gradient: it only selects pairs."""


class FrameSolver:
    """Simulates frames of one spring graph.

    spring_pairs [S, 2] index nodes; i >= nodes means controller i - nodes. All tensors that go in and out have `dtype` and
    live on `device`. Float32 is the working precision, float64 serves verification.
    """

    def __init__(
        self,
        spring_pairs: np.ndarray,
        nodes: int,
        controllers: int,
        simulation: Simulation,
        *,
        device: str = "cpu",
        dtype: torch.dtype = torch.float32,
        differentiable: bool = True,
    ) -> None:
        self.nodes, self.simulation, self.device, self.dtype = nodes, simulation, device, dtype
        self.buffers = Buffers(nodes, controllers, simulation, device, dtype, differentiable)
        springs.allocate(self.buffers, spring_pairs)
        for term in (velocity, collision, position):
            term.allocate(self.buffers)
        self._graphs = Graphs(device)
        self.frame_token = 0
        """Number of frames simulated: tells whether the buffers still hold a given one."""

    def set_parameters(self, parameters: Parameters) -> None:
        """Copy packed parameters into the solver's buffers."""
        for name, tensor in parameters._asdict().items():
            self.buffers.tensors[name].copy_(tensor.detach())

    def forward(
        self, x: torch.Tensor, v: torch.Tensor, begin: torch.Tensor, end: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """State (x [N, 3] m, v [N, 3] m/s) one frame later; controllers move linearly from begin to end [C, 3]."""
        t, n = self.buffers.tensors, self.nodes
        t["x"][0, :n].copy_(x.detach())
        t["v"][0, :n].copy_(v.detach())
        t["begin"].copy_(begin)
        t["end"].copy_(end)
        self._graphs.run("forward", self._kernels(), self.launch_forward)
        self.frame_token += 1
        last = self.buffers.slot(self.simulation.substeps)
        return t["x"][last, :n].clone(), t["v"][last, :n].clone()

    def run(
        self, begin: torch.Tensor, end: torch.Tensor, x: torch.Tensor, v: torch.Tensor, *packed: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """`forward` with these `Parameters`."""
        self.set_parameters(Parameters(*packed))
        return self.forward(x, v, begin, end)

    def backward(self, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Adjoints of the last forward frame: of x, v and each of `Parameters`; None for the contact distance."""
        t, n = self.buffers.tensors, self.nodes
        self.clear_adjoints()
        t["adj_x"][:n].copy_(adj_x)
        t["adj_v"][:n].copy_(adj_v)
        self._graphs.run("backward", self._kernels(), self.launch_backward)
        own = (springs.gradient(self.buffers), velocity.gradient(self.buffers))
        contacts = (contact.gradient(self.buffers, kind) for kind in ("ground", "contact"))
        return t["adj_x"][:n].clone(), t["adj_v"][:n].clone(), *own, *contacts, None

    def clear_adjoints(self) -> None:
        """Set all adjoints to zero."""
        for name, tensor in self.buffers.tensors.items():
            if name.startswith("adj_"):
                tensor.zero_()

    @property
    def collision_overflow(self) -> int:
        """Collision candidates that did not fit the list, summed over nodes and frames so far."""
        return int(self.buffers.overflow.numpy().sum()) if self.simulation.self_collision else 0

    def _kernels(self) -> Iterator[Any]:
        """What a graph may launch."""
        for term in (springs, velocity, position, *([collision] if self.simulation.self_collision else [])):
            yield from term.kernels(self.buffers.real)

    def launch_forward(self) -> None:
        """The substeps of a frame. Numbers in brackets are the paper's equations; n substeps, step k."""
        b, sim = self.buffers, self.simulation
        for step in range(sim.substeps):
            velocity.move_controllers(b, step)  #      x_c = begin + (end - begin) (k + 1) / n
            if sim.self_collision and step == 0:
                collision.find_candidates(b)  #        pairs with |x_j - x_i| < contact distance
            springs.add_forces(b, step)  #      (1-3)  F_i = sum over j of (Y (l / l0 - 1) + gamma (v_j - v_i) . d) d
            velocity.update_velocity(b, step)  #  (4)  v' = delta (v + dt (F + g))
            if sim.self_collision:
                collision.collide(b, step)  #          v' += mean impulse from the partners that are hit
            position.advance(b, step)  #          (4)  x' = x + dt v', reflected at the ground

    def launch_backward(self) -> None:
        """The adjoints of `launch_forward`, last line first."""
        b, sim = self.buffers, self.simulation
        for step in reversed(range(sim.substeps)):
            position.advance_adjoint(b, step)
            if sim.self_collision:
                collision.collide_adjoint(b, step)
            velocity.update_velocity_adjoint(b, step)
            springs.add_forces_adjoint(b, step)
