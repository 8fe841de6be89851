"""A frame of simulation as a differentiable function of torch tensors, of one twin or of several at once.

`FrameSolver` is a frame forward and backward: a launch on a CPU, a captured graph on CUDA. Its memory is substeps x nodes x twins.
`simulate_frame` is the same for autograd. Chained frames give gradients over any horizon: only the states between frames are kept,
and a frame whose substeps are no longer in a solver's buffers is simulated again from its start before its backward pass. A
`FrameWindow` has buffers for the last frames, as many as its memory takes.

Several twins may have nodes, controllers and springs of their own (union.py). The springs of a node are summed in the order of its
partners, so that a twin moves, bit for bit, as in a solver of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import torch

from neuspring.core.artifacts import Simulation, Twin
from neuspring.core.device import load
from neuspring.core.errors import InputError
from neuspring.physics import collision, frame, springs
from neuspring.physics.arrays import Buffers, Graphs
from neuspring.physics.controllers import ControllerSprings, begins, begun
from neuspring.physics.lanes import ALONE, LANE_WIDTH
from neuspring.physics.parameters import PARAMETERS, Parameters, packed
from neuspring.physics.union import Union

FRAME_WINDOW_BYTES = 1 << 30
"""Bytes that a `FrameWindow` may take."""
WORTH_NARROWING = 0.9
"""Part of the largest number of substeps, below which the others' largest makes it worth while to go on in fewer lanes."""
PER_TWIN = ("frame_time", "substeps", "initial_velocity")
"""Fields that may differ between the simulations of one solver; it does not read the last."""


IN_COMMON = tuple(field.name for field in fields(Simulation) if field.name not in PER_TWIN)


def physics_of(simulation: Simulation) -> tuple[Any, ...]:
    """Values that must be the same for all twins of a solver."""
    return tuple(getattr(simulation, name) for name in IN_COMMON)


def _check(simulations: Sequence[Simulation]) -> None:
    """One physics for all twins of a solver."""
    for name in IN_COMMON:
        if len(values := {getattr(simulation, name) for simulation in simulations}) != 1:
            rule = "must be the same for all twins of a solver, of which there is at least one"
            raise InputError(f"simulation.{name}", rule, sorted(values), "Make a solver for each.")


class FrameSolver:
    """Simulates frames of one spring graph.

    spring_pairs [S, 2] index nodes; i >= nodes means controller i - nodes. All tensors that go in and out have `dtype` and
    live on `device`. Float32 is the working precision, float64 serves verification.

    A sequence of simulations makes a solver of as many twins, which may differ in parameters and state, and in `PER_TWIN` of their
    simulations (else InputError); then every tensor has a leading axis [B]. A twin's numbers are the same, bit for bit, alone and
    in company. They may have `tables` of springs: `spring_pairs` are then several, and `sizes` the nodes of each twin (`Union`).

    `threads` chooses how a frame is computed (frame.py): by a thread per node, as on CUDA, or by one thread, as on a CPU.
    """

    def __init__(
        self,
        spring_pairs: np.ndarray | Sequence[np.ndarray],
        nodes: int,
        controllers: int,
        simulation: Simulation | Sequence[Simulation],
        *,
        device: str = "cpu",
        dtype: torch.dtype = torch.float32,
        differentiable: bool = True,
        threads: bool | None = None,
        tables: Sequence[int] = (),
        sizes: Sequence[int] = (),
    ) -> None:
        each = [spring_pairs] if isinstance(spring_pairs, np.ndarray) else list(spring_pairs)
        self.together = not isinstance(simulation, Simulation)
        simulations = [simulation] if isinstance(simulation, Simulation) else list(simulation)
        _check(simulations)
        self.nodes, self.simulation, self.device, self.dtype = nodes, simulations[0], device, dtype
        threads = device != "cpu" if threads is None else threads
        options: dict[str, Any] = {"differentiable": differentiable, "threads": threads, "tables": tables, "sizes": sizes}
        self.buffers = Buffers(nodes, controllers, simulations, device, dtype, **options)
        self.buffers.add_parameters(max(map(len, each)))
        springs.allocate(self.buffers, each)
        collision.allocate(self.buffers)
        self._kernels, self._graphs = frame.kernels(self.buffers.real, self.buffers.width), Graphs(device)
        self.grips = ControllerSprings(each[0], nodes, device) if len(each) == 1 else None
        self._held: torch.Tensor | None = None
        """Rest lengths of grips that began since the parameters were set [B, L] (controllers.py)."""
        self._plain: torch.Tensor | None = None
        """Springs as they were set [B, S, 3]."""
        self._factor: torch.Tensor | None = None
        """Factors on the springs in this frame [B, S, 3], where some controller does not hold."""
        self._reach = 0.0
        self.narrower: FrameSolver | None = None
        """A solver of the first twins, in which they end their frames."""
        self.frame_token = 0
        """Number of frames simulated: tells whether the buffers still hold a given one."""

    def holding(self, token: int) -> FrameSolver | None:
        """The solver whose buffers hold the frame that ended with this `frame_token`; None if it is no longer held."""
        return self if token == self.frame_token else None

    @property
    def nbytes(self) -> int:
        """Memory of the buffers, bytes."""
        return sum(tensor.nbytes for tensor in (*self.buffers.tensors.values(), *self.buffers.indices.values()))

    def set_parameters(self, parameters: Parameters) -> None:
        """Copy packed parameters into the solver's buffers."""
        values = {name: self._stacked(parameters[name]) for name in PARAMETERS}
        if self.buffers.width > 1:
            pushes = bool((values["springs"][..., 1] < 0).any())
            self._kernels = frame.kernels(self.buffers.real, self.buffers.width, pushes)
        for name, value in values.items():
            self.buffers.set_parameter(name, value)
        self._plain, self._factor, self._held = values["springs"].detach(), None, None
        if self.simulation.self_collision:
            self._reach = float(values["distance"].max())
            mass = values["inverse_mass"]
            self.buffers.alike = bool((mass == mass[:, :1]).all())
            self.buffers.arguments[0].alike = int(self.buffers.alike)

    def forward(
        self, x: torch.Tensor, v: torch.Tensor, begin: torch.Tensor, end: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """State (x [N, 3] m, v [N, 3] m/s) one frame later; controllers move from begin to end [C, 3] (`controllers.waypoints`)."""
        self.start(x, v)
        self.advance(begin, end)
        x, v = (self.buffers.get_vectors(name, self.last, self.nodes) for name in ("x", "v"))
        return self._one(x), self._one(v)

    def start(self, x: torch.Tensor, v: torch.Tensor) -> None:
        """Put the state at the start of a frame into the buffers."""
        for name, values in (("x", x), ("v", v)):
            self.buffers.set_vectors(name, self._stacked(values), slot=0)

    def advance(self, begin: torch.Tensor, end: torch.Tensor) -> None:
        """Simulate a frame from the state in slot 0; it ends in slot `last`."""
        self._prepare(self._stacked(begin), self._stacked(end))
        self._simulate()
        self.frame_token += 1

    def _prepare(self, begin: torch.Tensor, end: torch.Tensor) -> None:
        """Take grips, and partners for self-collision, from the start of a frame."""
        self._lead(begin, end)
        if self.simulation.self_collision:
            collision.find_candidates(self.buffers, self._reach)
        if self.narrower:
            if self.simulation.self_collision or begin.shape[-1] == 4:
                self._hand_over(self.narrower)
            count = self.narrower.buffers.twins
            self.narrower._prepare(begin[:count], end[:count])

    def _simulate(self) -> None:
        self._run("forward", self.launch_forward)
        if self.narrower:
            self._hand_over(self.narrower)
            self.narrower._simulate()
            self._hand_over(self.narrower, back=True)

    def narrow(self, other: FrameSolver) -> None:
        """Let the first twins end their frames in `other`, a solver of them, from where all others have ended theirs."""
        self.narrower, until = other, self.buffers.counts[other.buffers.twins]
        self.buffers.set_span(self.buffers.first, until)
        other.buffers.set_span(until, other.buffers.substeps)

    def _hand_over(self, other: FrameSolver, *, back: bool = False) -> None:
        """Copy the state of the other's twins there, or back."""
        count = other.buffers.twins
        for name in ("x", "v"):
            values = self.buffers.get_vectors(name, 0)
            if back:
                values[:count] = other.buffers.get_vectors(name, 0)
            (self if back else other).buffers.set_vectors(name, values if back else values[:count], 0)

    def _lead(self, begin: torch.Tensor, end: torch.Tensor) -> None:
        """Take where controllers are at the begin and the end of a frame: rows of `controllers.waypoints` [B, C, 3 or 4]."""
        if begin.shape[-1] == end.shape[-1] == 4:
            if self.grips is None:
                rule = "those of several scenes at once must hold in all frames"
                raise InputError("controllers", rule, "4 numbers per controller", "Make a solver for each.")
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
        assert self.grips is not None
        self._factor = None
        if holds is not None:
            self._factor = torch.ones_like(self._plain)
            acting = holds.to(self.dtype)[:, self.grips.leaders]
            self._factor[:, self.grips.springs, 0] = acting  # Y
            self._factor[:, self.grips.springs, 2] = acting  # gamma
        own = self.grips.applied(self._plain, self._held)
        self.buffers.set_parameter("springs", own if self._factor is None else own * self._factor)

    def follow(self, other: FrameSolver) -> None:
        """Take the state of another solver: none, since a frame is given it."""

    def go_on(self) -> None:
        """Take the end of the last frame for the start of the next."""
        if self.last:
            for name in ("x", "v"):
                self.buffers.tensors[name][0].copy_(self.buffers.tensors[name][self.last])

    @property
    def last(self) -> int:
        """The slot that holds the end of a frame."""
        return self.buffers.substeps % self.buffers.slots

    def run(
        self, begin: torch.Tensor, end: torch.Tensor, x: torch.Tensor, v: torch.Tensor, parameters: Parameters
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """`forward` with these parameters."""
        self.set_parameters(parameters)
        return self.forward(x, v, begin, end)

    def backward(self, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, Parameters]:
        """Adjoints of the last forward frame: of x, of v, and of each parameter that is trained, by name."""
        assert self._held is None, "gradients of a grip need its rest lengths among the parameters: simulate_frame"
        b = self.buffers
        for name, tensor in b.tensors.items():
            if name.startswith("adj_"):
                tensor.zero_()
        b.set_vectors("adj_x", self._stacked(adj_x))
        b.set_vectors("adj_v", self._stacked(adj_v))
        self._run("backward", self.launch_backward)
        gradients = b.gradients()
        if self._factor is not None:
            gradients["springs"] *= self._factor
        x, v = (self._one(b.get_vectors(name, count=self.nodes)) for name in ("adj_x", "adj_v"))
        return x, v, {name: self._one(gradient) for name, gradient in gradients.items()}

    @property
    def overflows(self) -> list[int]:
        """Collision candidates that did not fit the lists, summed over nodes and frames so far, of each twin."""
        return [int(count) for count in collision.overflow(self.buffers)]

    @property
    def collision_overflow(self) -> int:
        """The same of all twins."""
        return sum(self.overflows)

    def _stacked(self, values: torch.Tensor) -> torch.Tensor:
        """The values of all twins with a leading axis [B]."""
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
        model, state, _ = b.arguments
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
        arguments, size = b.arguments, (b.nodes, b.groups)
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


class FrameWindow:
    """The last frames of a spring graph, as a solver of their own each, so that a gradient through them simulates none again.

    `make` makes a solver of the graph; there will be `frames` of them, or as many as fit into `FRAME_WINDOW_BYTES`, one at least.
    """

    def __init__(self, make: Callable[[], FrameSolver], frames: int) -> None:
        self._make, self._solvers = make, [make()]
        self._room = max(1, min(frames, FRAME_WINDOW_BYTES // self._solvers[0].nbytes))
        self.frame_token = 0

    def turn(self) -> FrameSolver:
        """The solver that takes the next frame: that of the oldest."""
        place = self.frame_token % self._room
        if place == len(self._solvers):
            self._solvers.append(self._make())
        self.frame_token += 1
        return self._solvers[place]

    def run(self, *inputs: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """As `FrameSolver.run`."""
        return self.turn().run(*inputs)

    def holding(self, token: int) -> FrameSolver | None:
        """As `FrameSolver.holding`."""
        held = max(0, self.frame_token - self._room) < token <= self.frame_token
        return self._solvers[(token - 1) % self._room] if held else None

    @property
    def overflows(self) -> list[int]:
        """As `FrameSolver.overflows`."""
        return [sum(counts) for counts in zip(*(solver.overflows for solver in self._solvers), strict=True)]


class AdjointLimit:
    """Limit of one backward pass through chained frames: leaves out frames whose adjoints outgrow the losses, and counts them.

    The size of an adjoint is sqrt(|dL/dx|^2 + |dL/dv|^2 / T^2), where T is the frame's time, s. A frame is left out if that at its
    begin is more than `factor` times the sum of |dL/dx| that the losses behind it have added. What lies before it then has the
    gradient of its own losses.

    A body that rests on the ground bounces on it by micrometers. Each reflection turns a disturbance of one node around and not
    that of its neighbors, and springs answer to the difference: a disturbance grows a millionfold in a frame, though the motion is
    smooth. Such a gradient says nothing about parameters, and Adam hardly moves for hundreds of steps after it.
    """

    def __init__(self, factor: float, frame_time: float) -> None:
        self.factor, self.frame_time = factor, frame_time
        self.left_out = 0
        self._added = 0.0
        self._carried: torch.Tensor | None = None
        """dL/dx at the begin of the frame that came last."""

    def passes(self, after: Sequence[torch.Tensor], before: Sequence[torch.Tensor]) -> bool:
        """True for a frame that stays, from (dL/dx, dL/dv) at its end, `after`, and begin, `before`; frames come last first."""
        (end, _), (x, v) = after, before
        self._added += _norm(end if self._carried is None else end - self._carried)
        stays = math.hypot(_norm(x), _norm(v) / self.frame_time) <= self.factor * self._added
        self._carried = x if stays else None
        self.left_out += not stays
        return stays


def _norm(values: torch.Tensor) -> float:
    return float(torch.linalg.vector_norm(values, dtype=torch.float64))


class Frame(torch.autograd.Function):
    """A frame of any solver that has the three members used here.

    `run(begin, end, x, v, parameters)` simulates a frame and returns (x, v); `frame_token` counts the frames. `holding(token)` has
    that frame still, or is None: its `backward(adj_x, adj_v)` returns the adjoints of x and v, and those of parameters by name. A
    frame that does not pass its limit has no gradient.
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, solver: Any, limit: AdjointLimit | None, names: Sequence[str], *inputs: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(x, v) after the frame, from begin, end, x, v, and the parameters of these names."""
        ctx.solver, ctx.limit, ctx.names = solver, limit, names
        state = Frame._run(ctx, inputs)
        ctx.token = solver.frame_token
        ctx.save_for_backward(*inputs)
        return state

    @staticmethod
    def backward(ctx: Any, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[torch.Tensor | None, ...]:  # type: ignore[override]
        """Adjoints of the inputs; none of the controllers' path."""
        held = ctx.solver.holding(ctx.token)
        if held is None:
            Frame._run(ctx, ctx.saved_tensors)
            held = ctx.solver.holding(ctx.solver.frame_token)
        x, v, gradients = held.backward(adj_x, adj_v)
        if ctx.limit is not None and not ctx.limit.passes((adj_x, adj_v), (x, v)):
            return (None,) * (7 + len(ctx.names))
        return None, None, None, None, None, x, v, *(gradients.get(name) for name in ctx.names)

    @staticmethod
    def _run(ctx: Any, inputs: Sequence[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        state: tuple[torch.Tensor, torch.Tensor] = ctx.solver.run(*inputs[:4], dict(zip(ctx.names, inputs[4:], strict=True)))
        return state


def simulate_frame(
    solver: Any,
    parameters: Parameters,
    x: torch.Tensor,
    v: torch.Tensor,
    begin: torch.Tensor,
    end: torch.Tensor,
    limit: AdjointLimit | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """(x, v) one frame later, differentiable in x, v and parameters. Shapes as in `FrameSolver.forward`, solvers as in `Frame`.

    Rest lengths are those of the parameters: where grips begin later than frame 0, put theirs there first (`controllers.Grips`).
    Without a limit the gradient is exact.
    """
    inputs = begun(begin), end, x, v, *parameters.values()
    state: tuple[torch.Tensor, torch.Tensor] = Frame.apply(solver, limit, tuple(parameters), *inputs)  # type: ignore[no-untyped-call]
    return state


def solver_for(
    twins: Twin | Sequence[Twin],
    device: str = "cpu",
    dtype: torch.dtype = torch.float32,
    *,
    differentiable: bool = True,
) -> FrameSolver:
    """A solver with parameters set: of a lattice, or of several: tensors have an axis [B]."""
    options: dict[str, Any] = {"device": device, "dtype": dtype, "differentiable": differentiable}
    if isinstance(twins, Twin):
        first = twins.topology
        solver = FrameSolver(first.springs, len(first.nodes), len(first.controllers), twins.simulation, **options)
        solver.set_parameters(packed(twins, device, dtype))
        return solver
    union = Union([twin.topology for twin in twins])
    solver = solver_of(union, [twin.simulation for twin in twins], **options)
    solver.set_parameters(union.parameters([packed(twin, device, dtype) for twin in twins]))
    return solver


def solver_of(union: Union, simulations: Sequence[Simulation], **options: Any) -> FrameSolver:
    """A solver of twins side by side, with options of `FrameSolver`; without parameters."""
    pairs = union.tables[0] if len(union.tables) == 1 else union.tables
    options |= {"tables": union.table, "sizes": [nodes for nodes, _ in union.sizes]}
    return FrameSolver(pairs, union.nodes, union.controllers, simulations, **options)


def narrowing_solver(twins: Sequence[Twin], device: str) -> FrameSolver:
    """A solver without gradients of several twins; on a CPU the first, if they come slowest first, end frames out of lanes.

    Lanes cost the same whoever still moves in them, and few candidates of a search need several times the substeps of the others.
    Twins of several scenes do not narrow.
    """
    simulations = [twin.simulation for twin in twins]
    union, counts = Union([twin.topology for twin in twins]), [simulation.substeps for simulation in simulations]
    if len(union.tables) > 1:
        return solver_for(twins, device, differentiable=False)
    every, pairs = union.parameters([packed(twin, device) for twin in twins]), union.tables[0]

    def made(count: int) -> FrameSolver:
        own = {name: values[:count] for name, values in every.items()}
        kept = (own["springs"][..., 1] != 0).any(dim=0)
        own["springs"] = own["springs"][:, kept]
        springs = pairs[kept.cpu().numpy()]
        solver = FrameSolver(springs, union.nodes, union.controllers, simulations[:count], device=device, differentiable=False)
        solver.set_parameters(own)
        return solver

    solver = narrowest = made(len(twins))
    if device == "cpu" and len(twins) <= LANE_WIDTH and counts == sorted(counts, reverse=True):
        for count in range(min(ALONE, len(twins) - 1), 0, -1):
            if counts[count] < WORTH_NARROWING * counts[0]:
                wider, narrowest = narrowest, made(count)
                wider.narrow(narrowest)
    return solver
