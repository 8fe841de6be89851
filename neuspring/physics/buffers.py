"""The arrays of one solver, the launch of a kernel on them, and sequences of launches captured as graphs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
import warp as wp

from neuspring.core.artifacts import Simulation
from neuspring.core.device import load, start_warp


def array_types(real: Any) -> tuple[Any, Any, Any, Any]:
    """Types of kernel arguments for a scalar type: a 3-vector; arrays of numbers, of vectors, of vectors [slots, points]."""
    vec3 = wp.types.vector(3, real)
    return vec3, wp.array(dtype=real), wp.array(dtype=vec3), wp.array2d(dtype=vec3)


class Buffers:
    """Torch tensors by name, each with a Warp view of the same name as an attribute.

    State: x, v [slots, N + C], nodes first, then controllers; force [N + C]; velocities [history, N] `after` the forces, and
    those that nodes are `moving` with; begin and end [C] of the controllers' path. Every term adds its own arrays.

    A differentiable solver keeps all substeps of the last frame, slot k before substep k. Otherwise two slots take turns.
    """

    def __init__(
        self, nodes: int, controllers: int, simulation: Simulation, device: str, dtype: torch.dtype, differentiable: bool
    ) -> None:
        start_warp()
        self.nodes, self.controllers, self.simulation = nodes, controllers, simulation
        self.device, self.dtype, self.differentiable = device, dtype, differentiable
        self.real = wp.float32 if dtype == torch.float32 else wp.float64
        self.vec3 = wp.types.vector(3, self.real)
        self.tensors: dict[str, torch.Tensor] = {}
        self.views: dict[str, Any] = {}
        self.history = simulation.substeps if differentiable else 1
        slots, total = self.history + 1, nodes + controllers
        self.add(x=(slots, total, 3), v=(slots, total, 3), after=(self.history, nodes, 3), force=(total, 3))
        self.add(begin=(controllers, 3), end=(controllers, 3), adj_x=(total, 3), adj_v=(total, 3), adj_force=(total, 3))
        # Without self-collision nothing changes velocities between the forces and the motion.
        self.views |= {"moving": self.after} | ({"adj_after": self.adj_v} if differentiable else {})

    def add(self, **shapes: tuple[int, ...]) -> None:
        """Add arrays of numbers [n] or of 3-vectors [.., 3], zero at first. Only a differentiable solver has adjoints (adj_...)."""
        for name, shape in shapes.items():
            if self.differentiable or not name.startswith("adj_"):
                self.tensors[name] = torch.zeros(shape, dtype=self.dtype, device=self.device)
                self.views[name] = wp.from_torch(self.tensors[name], dtype=self.vec3 if len(shape) > 1 else self.real)

    def add_integers(self, **shapes: tuple[int, ...]) -> None:
        """Add arrays of integers, which torch does not see."""
        for name, shape in shapes.items():
            self.views[name] = wp.zeros(shape, dtype=int, device=self.device)

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["views"][name]
        except KeyError:
            raise AttributeError(name) from None

    def slot(self, step: int) -> int:
        """Where x and v before substep `step` lie."""
        return step if self.differentiable else step % 2

    def inner_slot(self, step: int) -> int:
        """Where the velocities within substep `step` lie."""
        return step if self.differentiable else 0

    def launch(self, kernel: Any, size: int, *arguments: Any) -> None:
        """Run a kernel on `size` threads."""
        wp.launch(kernel, size, [*arguments], device=self.device)


class Graphs:
    """Sequences of launches by name; each is recorded at its first run and replayed afterwards."""

    def __init__(self, device: str) -> None:
        self.device = device
        self._graphs: dict[str, Any] = {}

    def run(self, name: str, kernels: Iterable[Any], record: Callable[[], None]) -> None:
        """Replay what `record` launches. All of its kernels are loaded before the capture, which must not load any."""
        if name not in self._graphs:
            for kernel in kernels:
                load(kernel, self.device)
            with wp.ScopedCapture(device=self.device) as capture:
                record()
            self._graphs[name] = capture.graph
        # Torch orders its own work on its current stream, so the graph must run there too.
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device)) if self.device != "cpu" else None
        wp.capture_launch(self._graphs[name], stream=stream)
