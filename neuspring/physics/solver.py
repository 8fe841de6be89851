"""One frame of simulation, forward and backward, of one twin or of several at once: a launch on a CPU, a captured graph on CUDA.

Memory is substeps x nodes x twins and does not grow with the number of frames: longer gradients run each frame again from its
stored start (see `autograd.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
import torch

from neuspring.core.artifacts import Simulation
from neuspring.core.device import load
from neuspring.core.errors import InputError
from neuspring.physics import collision, contact, frame, obstacles, position, springs, velocity
from neuspring.physics.arrays import Buffers, Graphs
from neuspring.physics.controllers import Grips, begins

PER_TWIN = ("frame_time", "substeps", "initial_velocity")
"""What may differ between the simulations of one solver; it does not read the last."""


class Parameters(NamedTuple):
    """Physical parameters as the kernels take them, tensors of the solver's dtype and device. Made by `pack`.

    Several twins have a leading axis [B].
    """

    springs: torch.Tensor
    """[S, 3]: stiffness [N], 1 / rest length [1/m], dashpot [N s/m]. A spring with neither stiffness nor dashpot is absent."""
    decay: torch.Tensor
    """[1]: exp(-substep * drag)."""
    ground: torch.Tensor
    """[2]: elasticity in [0, 1], friction in [0, 2]."""
    contact: torch.Tensor
    """[2]: the same between nodes."""
    distance: torch.Tensor
    """[1]: contact distance, m. No gradient: it only selects pairs."""
    inverse_mass: torch.Tensor
    """[N], 1/kg, or [1] for all nodes. No gradient: masses are not trained."""


def _check(simulations: Sequence[Simulation]) -> None:
    """One physics for all twins of a solver."""
    for field in fields(Simulation):
        values = {getattr(simulation, field.name) for simulation in simulations}
        if field.name not in PER_TWIN and len(values) != 1:
            rule = "must be the same for all twins of a solver, of which there is at least one"
            raise InputError(f"simulation.{field.name}", rule, sorted(values), "Make a solver for each.")


class FrameSolver:
    """Simulates frames of one spring graph.

    spring_pairs [S, 2] index nodes; i >= nodes means controller i - nodes. All tensors that go in and out have `dtype` and
    live on `device`. Float32 is the working precision, float64 serves verification.

    A sequence of simulations makes a solver of as many twins, which may differ in parameters and state, and in `PER_TWIN` of their
    simulations (else InputError); then every tensor has a leading axis [B]. A twin's numbers are the same, bit for bit, alone and
    in company.

    `threads` chooses how a frame is computed (frame.py): by a thread per node, as on CUDA, or by one thread, as on a CPU.
    """

    def __init__(
        self,
        spring_pairs: np.ndarray,
        nodes: int,
        controllers: int,
        simulation: Simulation | Sequence[Simulation],
        *,
        device: str = "cpu",
        dtype: torch.dtype = torch.float32,
        differentiable: bool = True,
        threads: bool | None = None,
    ) -> None:
        self.together = not isinstance(simulation, Simulation)
        simulations = [simulation] if isinstance(simulation, Simulation) else list(simulation)
        _check(simulations)
        self.nodes, self.simulation, self.device, self.dtype = nodes, simulations[0], device, dtype
        threads = device != "cpu" if threads is None else threads
        self.buffers = Buffers(nodes, controllers, simulations, device, dtype, differentiable=differentiable, threads=threads)
        springs.allocate(self.buffers, spring_pairs)
        for term in (velocity, collision, position, obstacles):
            term.allocate(self.buffers)
        self._kernels = frame.kernels(self.buffers.real, self.buffers.width, bool(self.simulation.obstacles))
        self._graphs = Graphs(device)
        self.grips = Grips(spring_pairs, nodes, device)
        self._held: torch.Tensor | None = None
        """Rest lengths of grips that began since the parameters were set [B, L] (controllers.py)."""
        self._plain: torch.Tensor | None = None
        """Springs as they were set [B, S, 3]."""
        self._factor: torch.Tensor | None = None
        """What springs are multiplied with in this frame [B, S, 3], where some controller does not hold."""
        self._reach = 0.0
        self.frame_token = 0
        """Number of frames simulated: tells whether the buffers still hold a given one."""

    def set_parameters(self, parameters: Parameters) -> None:
        """Copy packed parameters into the solver's buffers."""
        b, values = self.buffers, Parameters(*map(self._stacked, parameters))
        springs.fill(b, values.springs)
        self._plain, self._factor, self._held = values.springs.detach(), None, None
        velocity.fill(b, values.decay)
        for kind in ("ground", "contact"):
            contact.fill(b, kind, getattr(values, kind))
        b.set_numbers("distance", values.distance[:, 0])
        velocity.fill_masses(b, values.inverse_mass)
        if self.simulation.self_collision:
            self._reach = float(values.distance.max())

    def forward(
        self, x: torch.Tensor, v: torch.Tensor, begin: torch.Tensor, end: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """State (x [N, 3] m, v [N, 3] m/s) one frame later; controllers move from begin to end [C, 3] (`controllers.waypoints`)."""
        self.start(x, v)
        self.advance(begin, end)
        return self._one(self.buffers.get_vectors("x", self.last, self.nodes)), self._one(
            self.buffers.get_vectors("v", self.last, self.nodes)
        )

    def start(self, x: torch.Tensor, v: torch.Tensor) -> None:
        """Put the state at the start of a frame into the buffers."""
        for name, values in (("x", x), ("v", v)):
            self.buffers.set_vectors(name, self._stacked(values), slot=0)

    def advance(self, begin: torch.Tensor, end: torch.Tensor) -> None:
        """Simulate a frame from the state in slot 0; it ends in slot `last`."""
        b = self.buffers
        self._lead(self._stacked(begin), self._stacked(end))
        if self.simulation.self_collision:
            collision.find_candidates(b, self._reach)
        self._run("forward", self.launch_forward)
        self.frame_token += 1

    def _lead(self, begin: torch.Tensor, end: torch.Tensor) -> None:
        """Take where controllers are at the begin and the end of a frame: rows of `controllers.waypoints` [B, C, 3 or 4]."""
        if begin.shape[-1] == end.shape[-1] == 4:
            if bool(begins(begin).any()):
                self._held = self.grips.taken(self._held, self.buffers.get_vectors("x", 0, self.nodes), begin)
            self._hold(begin[..., 3] * end[..., 3] > 0)
        elif {begin.shape[-1], end.shape[-1]} != {3}:
            rule = "3 numbers per controller are required, or 4 where some do not hold"
            raise InputError("controllers", rule, [begin.shape[-1], end.shape[-1]], "Make them with controllers.waypoints.")
        elif self._factor is not None:
            self._hold(None)
        for name, places in (("begin", begin), ("end", end)):
            self.buffers.set_vectors(name, places[..., :3])

    def _hold(self, holds: torch.Tensor | None) -> None:
        """Let the springs of controllers act that hold [B, C], and not those of others; None: all act."""
        assert self._plain is not None, "set_parameters comes first"
        self._factor = None
        if holds is not None:
            self._factor = torch.ones_like(self._plain)
            acting = holds.to(self.dtype)[:, self.grips.leaders]
            self._factor[:, self.grips.springs, 0] = acting  # Y
            self._factor[:, self.grips.springs, 2] = acting  # gamma
        own = self.grips.applied(self._plain, self._held)
        springs.fill(self.buffers, own if self._factor is None else own * self._factor)

    def resume(self, rows: torch.Tensor, positions: Sequence[np.ndarray]) -> None:
        """Hold what was held after the frames of `rows` [T, C, K] of waypoints, in which the nodes were at `positions` [N, 3], m.

        For a rollout that does not begin in frame 0; more positions than rows may be given. It makes no difference where all hold.
        """
        known = torch.nonzero(begins(rows).any(dim=-1)).flatten().tolist()
        states = [torch.tensor(positions[number], dtype=self.dtype, device=self.device) for number in known]
        lengths = self.grips.taken_before([rows[number] for number in known], states)
        self._held = None if lengths is None else lengths.expand(self.buffers.twins, -1)

    def go_on(self) -> None:
        """Take the end of the last frame for the start of the next."""
        if self.last:
            for name in ("x", "v"):
                self.buffers.tensors[name][0].copy_(self.buffers.tensors[name][self.last])

    @property
    def last(self) -> int:
        """The slot that holds the end of a frame."""
        return self.buffers.slot(self.buffers.substeps)

    def run(
        self, begin: torch.Tensor, end: torch.Tensor, x: torch.Tensor, v: torch.Tensor, *packed: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """`forward` with these `Parameters`."""
        self.set_parameters(Parameters(*packed))
        return self.forward(x, v, begin, end)

    def backward(self, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Adjoints of the last forward frame: of x, v and each of `Parameters`; None for contact distance and masses."""
        assert self._held is None, "gradients of a grip need its rest lengths among the parameters: autograd.simulate_frame"
        b = self.buffers
        self.clear_adjoints()
        b.set_vectors("adj_x", self._stacked(adj_x))
        b.set_vectors("adj_v", self._stacked(adj_v))
        self._run("backward", self.launch_backward)
        state = (b.get_vectors("adj_x", count=self.nodes), b.get_vectors("adj_v", count=self.nodes))
        of_springs = springs.gradient(b)
        if self._factor is not None:
            of_springs = of_springs * self._factor
        own = (of_springs, velocity.gradient(b), *(contact.gradient(b, kind) for kind in ("ground", "contact")))
        return *map(self._one, (*state, *own)), None, None

    def clear_adjoints(self) -> None:
        """Set all adjoints to zero."""
        for name, tensor in self.buffers.tensors.items():
            if name.startswith("adj_"):
                tensor.zero_()

    @property
    def overflows(self) -> list[int]:
        """Collision candidates that did not fit the lists, summed over nodes and frames so far, of each twin."""
        return [int(count) for count in collision.overflow(self.buffers)]

    @property
    def collision_overflow(self) -> int:
        """The same of all twins."""
        return sum(self.overflows)

    def _stacked(self, values: torch.Tensor) -> torch.Tensor:
        """With a leading axis [B]."""
        return values if self.together else values[None]

    def _one(self, values: torch.Tensor) -> torch.Tensor:
        return values if self.together else values[0]

    def _run(self, name: str, launch: Callable[[], None]) -> None:
        if self.buffers.threads:
            self._graphs.run(name, self._needed(name), launch)
            return
        # One launch needs no graph. Warp would record it with whatever other threads of the process launch meanwhile.
        for kernel in self._needed(name):
            load(kernel, self.device)
        launch()

    def _needed(self, name: str) -> Iterator[Any]:
        """The kernels of a frame forward or backward."""
        k, b = self._kernels, self.buffers
        if not b.threads:
            return iter([k.forward if name == "forward" else k.backward])
        if name == "forward":
            return iter([k.begin, k.substep, *([k.collide] if self.simulation.self_collision else [])])
        return iter([k.settle, k.pull, *([k.hit, k.slow] if self.simulation.self_collision else [])])

    def launch_forward(self) -> None:
        """A frame (`frame.py`)."""
        b, k = self.buffers, self._kernels
        model, state, _ = b.arguments()
        if not b.threads:
            b.launch(k.forward, b.groups, model, state)
            return
        b.launch(k.begin, (b.controllers, b.groups), model, state)
        for step in range(b.substeps):
            b.launch(k.substep, (b.nodes + b.controllers, b.groups), model, state, step)
            if self.simulation.self_collision:
                b.launch(k.collide, (b.nodes, b.groups), model, state, step)

    def launch_backward(self) -> None:
        """The adjoint of a frame."""
        b, k = self.buffers, self._kernels
        arguments, size = b.arguments(), (b.nodes, b.groups)
        if not b.threads:
            b.launch(k.backward, b.groups, *arguments)
            return
        for step in reversed(range(b.substeps)):
            if self.simulation.self_collision:
                for kernel in (k.settle, k.hit, k.slow):
                    b.launch(kernel, size, *arguments, step)
            elif step == b.substeps - 1:
                b.launch(k.settle, size, *arguments, step)
            b.launch(k.pull, size, *arguments, step)
