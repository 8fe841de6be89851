"""Fits and searches that advance in lockstep and share launches: generators that yield simulation requests.

`lockstep` collects one request from each generator, serves all requests at once, and sends each generator its answer.
`SharedFrames` serves fits: one solver simulates their twins together (union.py), and one backward pass computes the gradients of
all objectives. On a CPU, a fit has the same numbers alone and in a batch, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from neuspring.core.artifacts import Twin
from neuspring.physics.controllers import begun
from neuspring.physics.parameters import Parameters
from neuspring.physics.solver import AdjointLimit, FrameWindow, physics_of, simulate_frame, solver_for, solver_of
from neuspring.physics.union import Union

Course = Generator[Any, Any, Any]
"""A search or a fit that yields requests and returns its result."""


def lockstep(courses: Sequence[Course], serve: Callable[[Mapping[int, Any]], Mapping[int, Any]]) -> list[Any]:
    """Run the courses; return the result of each, or the exception that ended it.

    `serve` receives the requests of all running courses, by index, and answers at least one of them. An exception in `serve` ends
    all running courses.
    """
    results: list[Any] = [None] * len(courses)
    answers: Mapping[int, Any] = dict.fromkeys(range(len(courses)))
    requests: dict[int, Any] = {}
    while answers:
        for k, answer in answers.items():
            requests.pop(k, None)
            try:
                requests[k] = courses[k].send(answer)
            except StopIteration as end:
                results[k] = end.value
            except Exception as error:
                results[k] = error
        try:
            answers = serve(requests) if requests else {}
        except Exception as error:
            for k in requests:
                results[k] = error
            break
    return results


def result_of(results: Sequence[Any]) -> Any:
    """The result of a single course. Raises the exception that ended the course."""
    (result,) = results
    if isinstance(result, Exception):
        raise result
    return result


class SimulatedTwin:
    """A twin that a fit simulates, with its own solver, which is rebuilt when the number of substeps changes."""

    def __init__(self, twin: Twin, device: str, frames: int) -> None:
        """`frames`: number of frames that a gradient passes through."""
        self.twin, self.device, self.frames = twin, device, frames
        self._window: FrameWindow | None = None
        self._overflow = 0

    def window(self) -> FrameWindow:
        """The solver for the current number of substeps."""
        if self._window is None:
            twin, device = self.twin, self.device
            self._window = FrameWindow(lambda: solver_for(twin, device), self.frames)
        return self._window

    def replace(self, twin: Twin) -> None:
        """Simulate `twin` from now on."""
        self._overflow, self.twin, self._window = self.collision_overflow, twin, None

    def count(self, overflow: int) -> None:
        """Add collision candidates that exceeded the list of a shared solver."""
        self._overflow += overflow

    @property
    def collision_overflow(self) -> int:
        """Collision candidates that exceeded the list, summed over all solvers so far."""
        return self._overflow + (sum(self._window.overflows) if self._window else 0)


@dataclass(frozen=True, eq=False)
class FrameRequest:
    """Request for one frame of a fit's twin. The answer is (x, v) at its end; inputs are those of `simulate_frame`."""

    source: SimulatedTwin
    parameters: Parameters
    x: torch.Tensor
    v: torch.Tensor
    begin: torch.Tensor
    end: torch.Tensor
    limit: AdjointLimit | None


@dataclass(frozen=True, eq=False)
class GradientRequest:
    """Request for the gradient of an objective. The answer is a tensor or None for each of `tensors`."""

    objective: torch.Tensor
    tensors: Sequence[torch.Tensor]


class SharedFrames:
    """Serves the requests of several fits.

    Gradients come first, so that every running fit requests a frame when frames are simulated. Only fits whose gradients begin at
    the same frame share frames. Otherwise the graph of one fit's objective would contain earlier steps of another fit.
    """

    def __init__(self) -> None:
        self._round = 0
        self._in_step: dict[int, int] = {}
        """Round in which the current gradient of each fit begins."""
        self._members: tuple[int, ...] = ()
        self._solvers: dict[tuple[int, ...], tuple[list[Twin], Union, FrameWindow]] = {}
        """By the ids of the sources: their twins, the union of those, and the solver."""

    def serve(self, requests: Mapping[int, Any]) -> dict[int, Any]:
        """Answer all gradient requests or, if there are none, all frame requests."""
        gradients = {k: request for k, request in requests.items() if isinstance(request, GradientRequest)}
        answers: dict[int, Any] = {}
        if gradients:
            for members in self._groups(gradients):
                # Fits that have not reached the end of their gradient need the graph of shared frames again.
                in_group = {k: gradients[k] for k in members}
                answers |= self._gradients(in_group, retain=len(members) < len(requests))
            return answers
        if self._members != tuple(requests):
            self._members, self._solvers = tuple(requests), {}
        self._round += 1
        self._in_step |= {k: self._round for k, request in requests.items() if not request.x.requires_grad}
        for members in self._groups(requests):
            group = [requests[k] for k in members]
            answers |= dict(zip(members, self._frames(group) if len(members) > 1 else [_alone(group[0])], strict=True))
        return answers

    def _groups(self, requests: Mapping[int, Any]) -> list[list[int]]:
        groups: dict[int, list[int]] = {}
        for k in requests:
            groups.setdefault(self._in_step[k], []).append(k)
        return list(groups.values())

    @staticmethod
    def _gradients(requests: Mapping[int, GradientRequest], *, retain: bool) -> dict[int, Any]:
        tensors = [tensor for request in requests.values() for tensor in request.tensors]
        objectives = [request.objective for request in requests.values()]
        gradients = iter(torch.autograd.grad(objectives, tensors, retain_graph=retain, allow_unused=True))
        return {k: [next(gradients) for _ in request.tensors] for k, request in requests.items()}

    def _frames(self, requests: Sequence[FrameRequest]) -> list[tuple[torch.Tensor, torch.Tensor]]:
        union, window = self._solver([request.source for request in requests])
        gates = [Gate(request.limit) for request in requests]
        names = list(requests[0].parameters)
        entered = [Enter.apply(gate, r.x, r.v, *r.parameters.values()) for gate, r in zip(gates, requests, strict=True)]  # type: ignore[no-untyped-call]
        x, v = union.of_nodes([inputs[0] for inputs in entered], places=True), union.of_nodes([inputs[1] for inputs in entered])
        parameters = union.parameters([dict(zip(names, inputs[2:], strict=True)) for inputs in entered])
        begin, end = union.of_controllers([begun(r.begin) for r in requests]), union.of_controllers([r.end for r in requests])
        counted = requests[0].source.twin.simulation.self_collision
        before = window.overflows if counted else []
        after = simulate_frame(window, parameters, x, v, begin, end)
        for request, old, new in zip(requests, before, window.overflows if counted else [], strict=False):
            request.source.count(new - old)
        sizes = [nodes for nodes, _ in union.sizes]
        return [Leave.apply(gate, *(values[k, : sizes[k]] for values in after)) for k, gate in enumerate(gates)]  # type: ignore[no-untyped-call]

    def _solver(self, sources: Sequence[SimulatedTwin]) -> tuple[Union, FrameWindow]:
        key, twins = tuple(map(id, sources)), [source.twin for source in sources]
        known = self._solvers.get(key)
        if known is None or any(before is not now for before, now in zip(known[0], twins, strict=True)):
            union = Union([twin.topology for twin in twins])
            device, simulations = sources[0].device, [twin.simulation for twin in twins]
            window = FrameWindow(lambda: solver_of(union, simulations, device=device), max(source.frames for source in sources))
            known = self._solvers[key] = twins, union, window
        return known[1], known[2]


def _alone(r: FrameRequest) -> tuple[torch.Tensor, torch.Tensor]:
    return simulate_frame(r.source.window(), r.parameters, r.x, r.v, r.begin, r.end, r.limit)


class Gate:
    """The adjoint limit of one fit at a frame that it shares with other fits."""

    def __init__(self, limit: AdjointLimit | None) -> None:
        self.limit = limit
        self.after: Sequence[torch.Tensor] = ()
        """(dL/dx, dL/dv) at the end of the frame."""


class Enter(torch.autograd.Function):
    """The inputs of a frame. Their adjoints pass unless the gate's limit omits the frame, as in `solver.Frame`."""

    @staticmethod
    def forward(ctx: Any, gate: Gate, *inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:  # type: ignore[override]
        """Return the inputs: x, v, parameters."""
        ctx.gate = gate
        return tuple(tensor.view_as(tensor) for tensor in inputs)

    @staticmethod
    def backward(ctx: Any, *adjoints: torch.Tensor) -> tuple[torch.Tensor | None, ...]:  # type: ignore[override]
        """Return the adjoints, or None for each if the frame is omitted."""
        gate = ctx.gate
        # The backward pass of another fit with a shorter window does not reach the end of this fit's frame.
        if gate.limit is not None and not (gate.after and gate.limit.passes(gate.after, adjoints[:2])):
            return (None,) * (1 + len(adjoints))
        return None, *adjoints


class Leave(torch.autograd.Function):
    """The end of a frame. The gate stores its adjoints."""

    @staticmethod
    def forward(ctx: Any, gate: Gate, x: torch.Tensor, v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:  # type: ignore[override]
        """Return (x, v)."""
        ctx.gate = gate
        return x.view_as(x), v.view_as(v)

    @staticmethod
    def backward(ctx: Any, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[None, torch.Tensor, torch.Tensor]:  # type: ignore[override]
        """Store and return the adjoints."""
        ctx.gate.after = (adj_x, adj_v)
        return None, adj_x, adj_v


def shared_physics(twin: Twin, always: bool) -> tuple[Any, ...]:
    """Values that must be equal for twins that share a launch: the physics and, unless controllers `always` hold, the points."""
    points = () if always else (twin.topology.nodes.tobytes(), twin.topology.controllers.shape)
    return physics_of(twin.simulation), points
