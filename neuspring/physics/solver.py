"""One frame of simulation, forward and backward, each a captured graph on the CPU and on CUDA.

`FrameSolver` owns the buffers of one spring graph. In differentiable mode it keeps every substep of the last frame, so
memory is substeps x nodes and does not grow with the number of frames: longer gradients re-run each frame from its stored
start (see `autograd.py`). Without gradients two substep slots are enough.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from neuspring.core.artifacts import Simulation
from neuspring.core.device import load, start_warp
from neuspring.physics import contact, integrate, springs


@dataclass(frozen=True)
class Parameters:
    """Parameters packed for the kernels, tensors of the solver's dtype and device."""

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

    def tensors(self) -> tuple[torch.Tensor, ...]:
        """In the order of the fields."""
        return (self.springs, self.decay, self.ground, self.contact, self.distance)


class FrameSolver:
    """Buffers and graphs for one spring graph and one `Simulation`.

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
        start_warp()
        self.nodes, self.controllers, self.simulation = nodes, controllers, simulation
        self.device, self.dtype, self.differentiable = device, dtype, differentiable
        self._real = wp.float32 if dtype == torch.float32 else wp.float64
        self._vec3 = wp.types.vector(3, self._real)
        self._pairs: Any = wp.array(np.ascontiguousarray(spring_pairs, np.int32), dtype=wp.vec2i, device=device)
        self._count = len(spring_pairs)
        self._buffers: dict[str, torch.Tensor] = {}
        self._views: dict[str, Any] = {}
        self._graphs: dict[str, Any] = {}
        self._allocate()
        self.frame_token = 0

    def _allocate(self) -> None:
        total, n = self.nodes + self.controllers, self.simulation.substeps
        slots, history = (n + 1, n) if self.differentiable else (2, 1)
        vectors = {"x": (slots, total), "v": (slots, total), "force": (total,), "after": (history, self.nodes)}
        vectors |= {"begin": (self.controllers,), "end": (self.controllers,), "springs": (self._count,)}
        scalars = {"decay": 1, "ground": 2, "contact": 2, "distance": 1}
        if self.simulation.self_collision:
            vectors["collided"] = (history, self.nodes)
        if self.differentiable:
            vectors |= {"adj_x": (total,), "adj_v": (total,), "adj_force": (total,), "adj_after": (self.nodes,)}
            vectors["adj_springs"] = (self._count,)
            scalars |= {f"adj_{name}": self.nodes for name in ("decay", "ground_e", "ground_mu", "contact_e", "contact_mu")}
        for name, shape in vectors.items():
            self._buffer(name, (*shape, 3), self._vec3)
        for name, size in scalars.items():
            self._buffer(name, (size,), self._real)
        if self.simulation.self_collision:
            capacity = self.simulation.collision_capacity
            self._views["partners"] = wp.zeros((self.nodes, capacity), dtype=int, device=self.device)
            self._views["count"] = wp.zeros(self.nodes, dtype=int, device=self.device)
            self._views["overflow"] = wp.zeros(self.nodes, dtype=int, device=self.device)

    def _buffer(self, name: str, shape: tuple[int, ...], kind: Any) -> None:
        tensor = torch.zeros(shape, dtype=self.dtype, device=self.device)
        self._buffers[name] = tensor
        self._views[name] = wp.from_torch(tensor, dtype=kind)

    def set_parameters(self, parameters: Parameters) -> None:
        """Copy packed parameters into the solver's buffers."""
        for name, tensor in zip(("springs", "decay", "ground", "contact", "distance"), parameters.tensors(), strict=True):
            self._buffers[name].copy_(tensor.detach())

    def forward(
        self, x: torch.Tensor, v: torch.Tensor, begin: torch.Tensor, end: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """State (x [N, 3] m, v [N, 3] m/s) one frame later; controllers move linearly from begin to end [C, 3]."""
        b, n = self._buffers, self.nodes
        b["x"][0, :n].copy_(x.detach())
        b["v"][0, :n].copy_(v.detach())
        b["begin"].copy_(begin)
        b["end"].copy_(end)
        self._launch("forward", self._record_forward)
        self.frame_token += 1
        last = self.simulation.substeps if self.differentiable else self.simulation.substeps % 2
        return b["x"][last, :n].clone(), b["v"][last, :n].clone()

    def backward(self, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Adjoints of the last forward frame.

        Returns dL/d(x, v, springs [S, 3], decay [1], ground [2], contact [2]).
        """
        b, n = self._buffers, self.nodes
        for name in [name for name in b if name.startswith("adj_")]:
            b[name].zero_()
        b["adj_x"][:n].copy_(adj_x)
        b["adj_v"][:n].copy_(adj_v)
        self._launch("backward", self._record_backward)
        springs_ = b["adj_springs"].clone()
        springs_[:, 1] *= b["springs"][:, 0]
        ground = torch.stack([b["adj_ground_e"].sum(), b["adj_ground_mu"].sum()])
        between = torch.stack([b["adj_contact_e"].sum(), b["adj_contact_mu"].sum()])
        decay = b["adj_decay"].sum().reshape(1)
        return b["adj_x"][:n].clone(), b["adj_v"][:n].clone(), springs_, decay, ground, between

    @property
    def collision_overflow(self) -> int:
        """Collision candidates that did not fit the list, summed over nodes and frames so far."""
        return int(self._views["overflow"].numpy().sum()) if self.simulation.self_collision else 0

    def _launch(self, name: str, record: Callable[[], None]) -> None:
        if name not in self._graphs:
            for kernel in self._kernels():
                load(kernel, self.device)
            with wp.ScopedCapture(device=self.device) as capture:
                record()
            self._graphs[name] = capture.graph
        # Torch orders its own work on its current stream, so the graph must run there too.
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device)) if self.device != "cpu" else None
        wp.capture_launch(self._graphs[name], stream=stream)

    def _kernels(self) -> Iterator[Any]:
        """What a graph may launch; all are loaded before it is captured, since a capture must not load."""
        hits = contact.kernels(self._real)
        yield from springs.kernels(self._real)
        yield from integrate.kernels(self._real)
        if self.simulation.self_collision:
            yield from (hits.candidates, hits.collide, hits.collide_adjoint)
        if self.simulation.ground:
            yield from (hits.ground, hits.ground_adjoint)

    def _run(self, kernel: Any, size: int, *arguments: Any) -> None:
        wp.launch(kernel, size, list(arguments), device=self.device)

    def _record_forward(self) -> None:
        w, sim, n = self._views, self.simulation, self.nodes
        terms, hits = integrate.kernels(self._real), contact.kernels(self._real)
        force, _ = springs.kernels(self._real)
        dt = sim.substep
        gravity = self._vec3(0.0, 0.0, -sim.gravity * sim.up_sign)
        inverse_time = 1.0 / sim.frame_time if sim.controller_velocity else 0.0
        for step in range(sim.substeps):
            here, there, kept = (step, step + 1, step) if self.differentiable else (step % 2, (step + 1) % 2, 0)
            fraction = (step + 1) / sim.substeps
            self._run(
                terms.controllers,
                self.controllers,
                w["x"],
                w["v"],
                here,
                fraction,
                inverse_time,
                n,
                w["begin"],
                w["end"],
                w["force"],
            )
            if step == 0 and sim.self_collision:
                capacity = sim.collision_capacity
                self._run(hits.candidates, n, w["x"], n, w["distance"], capacity, w["partners"], w["count"], w["overflow"])
            self._run(force, self._count, w["x"], w["v"], here, self._pairs, w["springs"], w["force"])
            self._run(terms.velocity, n, w["v"], here, w["force"], gravity, dt, w["decay"], w["after"], kept)
            moving = w["after"]
            if sim.self_collision:
                moving = w["collided"]
                lists = (w["distance"], w["contact"], w["partners"], w["count"])
                self._run(hits.collide, n, w["x"], here, w["after"], kept, *lists, moving)
            if sim.ground:
                self._run(hits.ground, n, w["x"], w["v"], here, there, moving, kept, dt, sim.up_sign, w["ground"])
            else:
                self._run(terms.advance, n, w["x"], w["v"], here, there, moving, kept, dt)

    def _record_backward(self) -> None:
        w, sim, n = self._views, self.simulation, self.nodes
        terms, hits = integrate.kernels(self._real), contact.kernels(self._real)
        _, force_adjoint = springs.kernels(self._real)
        dt = sim.substep
        for step in reversed(range(sim.substeps)):
            moving = w["collided"] if sim.self_collision else w["after"]
            if sim.ground:
                ground = (w["ground"], w["adj_x"], w["adj_v"], w["adj_ground_e"], w["adj_ground_mu"])
                self._run(hits.ground_adjoint, n, w["x"], step, moving, dt, sim.up_sign, *ground)
            else:
                self._run(terms.advance_adjoint, n, w["adj_x"], w["adj_v"], dt)
            adj_after = w["adj_v"]
            if sim.self_collision:
                adj_after = w["adj_after"]
                adj_after.zero_()
                lists = (w["distance"], w["contact"], w["partners"], w["count"])
                adjoints = (w["adj_v"], adj_after, w["adj_x"], w["adj_contact_e"], w["adj_contact_mu"])
                self._run(hits.collide_adjoint, n, w["x"], step, w["after"], *lists, *adjoints)
            adjoint_state = (adj_after, w["adj_v"], w["adj_force"], w["adj_decay"])
            self._run(terms.velocity_adjoint, n, w["after"], step, dt, w["decay"], *adjoint_state)
            self._run(
                force_adjoint,
                self._count,
                *(w["x"], w["v"], step, self._pairs, w["springs"]),
                *(w["adj_force"], w["adj_x"], w["adj_v"], w["adj_springs"]),
            )
