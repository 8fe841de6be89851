"""A frame of simulation as a differentiable function of torch tensors, for one or several twins.

`FrameSolver` computes a frame forward and backward: a launch on a CPU, a captured graph on CUDA. Its memory is proportional to
substeps x nodes x twins. `simulate_frame` is the function for autograd.

Chained frames have gradients over any horizon. Only the states between frames are stored. A frame whose substeps are no longer in
a solver's buffers is simulated again before its backward pass. A `FrameWindow` has buffers for as many frames as its memory
allows.

Several twins may differ in nodes, controllers and springs (union.py). The forces on a node are summed in the order of its
partners, so a twin has the same motion, bit for bit, alone and in a union.
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
"""Largest memory of a `FrameWindow`, bytes."""
WORTH_NARROWING = 0.9
"""The slowest twins end their frames in a narrower solver if the other twins need less than this fraction of their substeps."""
PER_TWIN = ("frame_time", "substeps", "initial_velocity")
"""Fields that may differ between the simulations of one solver, which does not read the last."""


IN_COMMON = tuple(field.name for field in fields(Simulation) if field.name not in PER_TWIN)


def physics_of(simulation: Simulation) -> tuple[Any, ...]:
    """Values that must be equal for all twins of a solver."""
    return tuple(getattr(simulation, name) for name in IN_COMMON)


def _check(simulations: Sequence[Simulation]) -> None:
    """Raise InputError unless all twins of a solver have the same physics."""
    for name in IN_COMMON:
        if len(values := {getattr(simulation, name) for simulation in simulations}) != 1:
            rule = "must be the same for all twins of a solver, which has at least one twin"
            raise InputError(f"simulation.{name}", rule, sorted(values), "Create a solver for each value.")


class FrameSolver:
    """Simulates frames of one or several spring graphs.

    - spring_pairs: [S, 2], indices of nodes; i >= nodes means controller i - nodes
    - simulation: one, or a sequence for B twins. Then every tensor has a leading axis [B]
    - device, dtype: of all tensors. Float32 is the working precision, float64 is for verification
    - threads: one thread per node, as on CUDA, or a single thread, as on a CPU (frame.py)
    - tables, sizes: the table of springs and the number of nodes of each twin (`Union`). Then `spring_pairs` is a sequence

    Twins may differ in parameters, in state, and in the fields `PER_TWIN` of their simulations. A twin's numbers are the same,
    bit for bit, alone and in a batch. Raises InputError if other fields differ.
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
        """Rest lengths of grasps that began after the parameters were set [B, L] (controllers.py)."""
        self._plain: torch.Tensor | None = None
        """Springs as they were set [B, S, 3]."""
        self._factor: torch.Tensor | None = None
        """Factors on the springs in this frame [B, S, 3], if some controller does not hold."""
        self._reach = 0.0
        """Largest contact distance, m."""
        self.narrower: FrameSolver | None = None
        """A solver in which the first twins end their frames."""
        self.frame_token = 0
        """Number of simulated frames, which identifies the frame in the buffers."""

    def holding(self, token: int) -> FrameSolver | None:
        """Return the solver whose buffers contain the frame that ended with this `frame_token`; None if no solver does."""
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
        """Simulate a frame from the state (x [N, 3] m, v [N, 3] m/s); return the state at its end.

        Controllers move from begin to end [C, 3], m (`controllers.waypoints`).
        """
        self.start(x, v)
        self.advance(begin, end)
        x, v = (self.buffers.get_vectors(name, self.last, self.nodes) for name in ("x", "v"))
        return self._one(x), self._one(v)

    def start(self, x: torch.Tensor, v: torch.Tensor) -> None:
        """Copy the state at the start of a frame to the buffers."""
        for name, values in (("x", x), ("v", v)):
            self.buffers.set_vectors(name, self._stacked(values), slot=0)

    def advance(self, begin: torch.Tensor, end: torch.Tensor) -> None:
        """Simulate a frame from the state in slot 0 to the state in slot `last`."""
        self._prepare(self._stacked(begin), self._stacked(end))
        self._simulate()
        self.frame_token += 1

    def _prepare(self, begin: torch.Tensor, end: torch.Tensor) -> None:
        """Update grasps, and partners for self-collision, at the start of a frame."""
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
        """Let the first twins end their frames in the solver `other`, when all remaining twins have ended their frames."""
        self.narrower, until = other, self.buffers.counts[other.buffers.twins]
        self.buffers.set_span(self.buffers.first, until)
        other.buffers.set_span(until, other.buffers.substeps)

    def _hand_over(self, other: FrameSolver, *, back: bool = False) -> None:
        """Copy the state of the twins of `other` to it, or back."""
        count = other.buffers.twins
        for name in ("x", "v"):
            values = self.buffers.get_vectors(name, 0)
            if back:
                values[:count] = other.buffers.get_vectors(name, 0)
            (self if back else other).buffers.set_vectors(name, values if back else values[:count], 0)

    def _lead(self, begin: torch.Tensor, end: torch.Tensor) -> None:
        """Set the controllers at the begin and the end of a frame: rows of `controllers.waypoints` [B, C, 3 or 4]."""
        if begin.shape[-1] == end.shape[-1] == 4:
            if self.grips is None:
                rule = "controllers of several scenes in one solver must hold in all frames"
                raise InputError("controllers", rule, "4 numbers per controller", "Create a solver for each scene.")
            if bool(begins(begin).any()):
                self._held = self.grips.taken(self._held, self.buffers.get_vectors("x", 0, self.nodes), begin)
            self._hold(begin[..., 3] * end[..., 3] > 0)
        elif {begin.shape[-1], end.shape[-1]} != {3}:
            rule = "3 numbers per controller are required, or 4 where some do not hold"
            raise InputError("controllers", rule, [begin.shape[-1], end.shape[-1]], "Create them with controllers.waypoints.")
        elif self._factor is not None:
            self._hold(None)
        for name, places in (("begin", begin), ("end", end)):
            self.buffers.set_vectors(name, places[..., :3])

    def _hold(self, holds: torch.Tensor | None) -> None:
        """Let only springs of controllers that hold act, `holds` [B, C]; None: all act."""
        assert self._plain is not None, "call set_parameters first"
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
        """Copy the state that another solver keeps between frames; this solver keeps none, because `start` sets the state."""

    def go_on(self) -> None:
        """Use the end of the last frame as the start of the next frame."""
        if self.last:
            for name in ("x", "v"):
                self.buffers.tensors[name][0].copy_(self.buffers.tensors[name][self.last])

    @property
    def last(self) -> int:
        """The slot that contains the end of a frame."""
        return self.buffers.substeps % self.buffers.slots

    def run(
        self, begin: torch.Tensor, end: torch.Tensor, x: torch.Tensor, v: torch.Tensor, parameters: Parameters
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Set the parameters and call `forward`."""
        self.set_parameters(parameters)
        return self.forward(x, v, begin, end)

    def backward(self, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, Parameters]:
        """Return the adjoints of the last forward frame: of x, of v, and of each trained parameter, by name."""
        assert self._held is None, "gradients of later grasps require their rest lengths in the parameters; see simulate_frame"
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
        """Collision candidates of each twin that exceeded the lists, summed over nodes and frames so far."""
        return [int(count) for count in collision.overflow(self.buffers)]

    @property
    def collision_overflow(self) -> int:
        """The sum of `overflows` over all twins."""
        return sum(self.overflows)

    def _stacked(self, values: torch.Tensor) -> torch.Tensor:
        """Add a leading axis [B] to the values of a single twin."""
        return values if self.together else values[None]

    def _one(self, values: torch.Tensor) -> torch.Tensor:
        return values if self.together else values[0]

    def _run(self, name: str, launch: Callable[[], None]) -> None:
        if self.buffers.threads:
            self._graphs.run(name, self._needed(name), launch)
            return
        # One launch needs no graph. A capture would also record the launches of other threads of the process.
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
        """Launch the kernels of a frame (`frame.py`)."""
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
        """Launch the kernels of the adjoint of a frame."""
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
    """The last frames of a spring graph, each in its own solver, so that a gradient through them does not simulate a frame again.

    `make` creates a solver of the graph. There are up to `frames` solvers, as far as they fit into `FRAME_WINDOW_BYTES`, at least
    one.
    """

    def __init__(self, make: Callable[[], FrameSolver], frames: int) -> None:
        self._make, self._solvers = make, [make()]
        self._room = max(1, min(frames, FRAME_WINDOW_BYTES // self._solvers[0].nbytes))
        self.frame_token = 0

    def turn(self) -> FrameSolver:
        """Return the solver for the next frame: a new one, or that of the oldest frame."""
        place = self.frame_token % self._room
        if place == len(self._solvers):
            self._solvers.append(self._make())
        self.frame_token += 1
        return self._solvers[place]

    def run(self, *inputs: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """Simulate a frame; see `FrameSolver.run`."""
        return self.turn().run(*inputs)

    def holding(self, token: int) -> FrameSolver | None:
        """Return the solver that contains a frame; see `FrameSolver.holding`."""
        held = max(0, self.frame_token - self._room) < token <= self.frame_token
        return self._solvers[(token - 1) % self._room] if held else None

    @property
    def overflows(self) -> list[int]:
        """The sum of `FrameSolver.overflows` over all solvers, of each twin."""
        return [sum(counts) for counts in zip(*(solver.overflows for solver in self._solvers), strict=True)]


class AdjointLimit:
    """Limit of a backward pass through chained frames: omits frames whose adjoints outgrow the losses, and counts them.

    The size of an adjoint is sqrt(|dL/dx|^2 + |dL/dv|^2 / T^2), where T is the duration of a frame, s. A frame is omitted if the
    size at its begin exceeds `factor` times the sum of |dL/dx| from the losses of this and later frames. Earlier frames then have
    only the gradients of their own losses.

    An object at rest on the ground bounces by micrometers. A reflection reverses the disturbance of a node, but not that of its
    neighbors, and springs amplify the difference. So a disturbance can grow a millionfold in a frame, although the motion is
    smooth. Such a gradient contains no information about the parameters, and it blocks Adam for hundreds of steps.
    """

    def __init__(self, factor: float, frame_time: float) -> None:
        self.factor, self.frame_time = factor, frame_time
        self.left_out = 0
        self._added = 0.0
        self._carried: torch.Tensor | None = None
        """dL/dx at the begin of the frame of the last call."""

    def passes(self, after: Sequence[torch.Tensor], before: Sequence[torch.Tensor]) -> bool:
        """Return True if a frame is not omitted, from (dL/dx, dL/dv) at its end, `after`, and begin, `before`.

        Call it for the frames in reverse order.
        """
        (end, _), (x, v) = after, before
        self._added += _norm(end if self._carried is None else end - self._carried)
        stays = math.hypot(_norm(x), _norm(v) / self.frame_time) <= self.factor * self._added
        self._carried = x if stays else None
        self.left_out += not stays
        return stays


def _norm(values: torch.Tensor) -> float:
    return float(torch.linalg.vector_norm(values, dtype=torch.float64))


class Frame(torch.autograd.Function):
    """A frame of any solver with these three members:

    - `run(begin, end, x, v, parameters)` simulates a frame and returns (x, v)
    - `frame_token` counts the frames
    - `holding(token)` returns an object that still contains the frame, or None. Its `backward(adj_x, adj_v)` returns the adjoints
      of x and v, and those of the parameters by name

    A frame that does not pass its limit has no gradient.
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, solver: Any, limit: AdjointLimit | None, names: Sequence[str], *inputs: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (x, v) after the frame. `inputs` are begin, end, x, v, and the parameters in the order of `names`."""
        ctx.solver, ctx.limit, ctx.names = solver, limit, names
        state = Frame._run(ctx, inputs)
        ctx.token = solver.frame_token
        ctx.save_for_backward(*inputs)
        return state

    @staticmethod
    def backward(ctx: Any, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[torch.Tensor | None, ...]:  # type: ignore[override]
        """Return the adjoints of the inputs; the path of the controllers has none."""
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
    """Simulate a frame, differentiably in x, v and parameters; return (x, v) at its end.

    Shapes are those of `FrameSolver.forward`; `Frame` lists the requirements on solvers. For grasps that begin after frame 0,
    first apply their rest lengths to the parameters (`controllers.ControllerSprings`). Without a limit, the gradient is exact.
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
    """Create a solver of one lattice or several and set its parameters. Tensors of several twins have a leading axis [B]."""
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
    """Create a solver of a union of twins, with options of `FrameSolver`. Its parameters are not set."""
    pairs = union.tables[0] if len(union.tables) == 1 else union.tables
    options |= {"tables": union.table, "sizes": [nodes for nodes, _ in union.sizes]}
    return FrameSolver(pairs, union.nodes, union.controllers, simulations, **options)


def narrowing_solver(twins: Sequence[Twin], device: str) -> FrameSolver:
    """Create a solver of several twins without gradients. On a CPU, the slowest twins end their frames outside of the lanes.

    Twins must be sorted, slowest first. The cost of lanes does not depend on how many twins still move, and a few candidates of a
    search need several times the substeps of the others. Twins of several scenes stay in the lanes.
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
