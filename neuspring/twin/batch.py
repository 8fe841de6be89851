"""Work that advances in lockstep and shares launches: fits and searches are generators that yield what they want simulated.

`lockstep` collects one request of each generator, has all of them served at once, and sends each its answer. `SharedFrames` serves
fits: their twins stand side by side in one solver (union.py), and the gradients of all objectives are found in one backward pass.
The numbers of each fit are those that it has alone, bit for bit on a CPU.
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
    """The result of each course, or the exception that ended it.

    `serve` receives the requests of all courses that go on, by their number, and answers one of them at least. An exception of
    `serve` ends all of them.
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
    """The result of a single course. Raises the exception that ended it."""
    (result,) = results
    if isinstance(result, Exception):
        raise result
    return result


class SimulatedTwin:
    """A twin that a fit simulates, with a solver of its own that is made again when the number of substeps changes."""

    def __init__(self, twin: Twin, device: str, frames: int) -> None:
        """`frames`: those that a gradient goes through."""
        self.twin, self.device, self.frames = twin, device, frames
        self._window: FrameWindow | None = None
        self._overflow = 0

    def window(self) -> FrameWindow:
        """The solver for the present number of substeps."""
        if self._window is None:
            twin, device = self.twin, self.device
            self._window = FrameWindow(lambda: solver_for(twin, device), self.frames)
        return self._window

    def replace(self, twin: Twin) -> None:
        """Simulate `twin` from now on."""
        self._overflow, self.twin, self._window = self.collision_overflow, twin, None

    def count(self, overflow: int) -> None:
        """Add collision candidates that did not fit the list of a shared solver."""
        self._overflow += overflow

    @property
    def collision_overflow(self) -> int:
        """Collision candidates that did not fit the list, summed over all solvers so far."""
        return self._overflow + (sum(self._window.overflows) if self._window else 0)


@dataclass(frozen=True, eq=False)
class FrameRequest:
    """A frame of a fit's twin, answered by (x, v) at its end. Inputs are those of `simulate_frame`."""

    source: SimulatedTwin
    parameters: Parameters
    x: torch.Tensor
    v: torch.Tensor
    begin: torch.Tensor
    end: torch.Tensor
    limit: AdjointLimit | None


@dataclass(frozen=True, eq=False)
class GradientRequest:
    """The gradient of an objective, answered by one tensor or None for each of `tensors`."""

    objective: torch.Tensor
    tensors: Sequence[torch.Tensor]


class SharedFrames:
    """Serves the requests of fits.

    Gradients come first, so that all fits that go on wait for a frame when frames are simulated. Frames are shared by fits whose
    gradients begin at the same frame: otherwise the graph of one fit's objective would contain earlier steps of another.
    """

    def __init__(self) -> None:
        self._round = 0
        self._in_step: dict[int, int] = {}
        """The round in which the present gradient of each fit begins."""
        self._members: tuple[int, ...] = ()
        self._solvers: dict[tuple[int, ...], tuple[list[Twin], Union, FrameWindow]] = {}
        """By the twins' sources: the twins that it was made for, their union, and the solver."""

    def serve(self, requests: Mapping[int, Any]) -> dict[int, Any]:
        """Answers to all requests for gradients, or, where there are none, to all frames."""
        gradients = {k: request for k, request in requests.items() if isinstance(request, GradientRequest)}
        answers: dict[int, Any] = {}
        if gradients:
            for members in self._groups(gradients):
                # The graph of shared frames is needed again by fits that have not come to the end of their gradient.
                own = {k: gradients[k] for k in members}
                answers |= self._gradients(own, retain=len(members) < len(requests))
            return answers
        if self._members != tuple(requests):
            self._members, self._solvers = tuple(requests), {}
        self._round += 1
        self._in_step |= {k: self._round for k, request in requests.items() if not request.x.requires_grad}
        for members in self._groups(requests):
            wanted = [requests[k] for k in members]
            answers |= dict(zip(members, self._frames(wanted) if len(members) > 1 else [_alone(wanted[0])], strict=True))
        return answers

    def _groups(self, requests: Mapping[int, Any]) -> list[list[int]]:
        groups: dict[int, list[int]] = {}
        for k in requests:
            groups.setdefault(self._in_step[k], []).append(k)
        return list(groups.values())

    @staticmethod
    def _gradients(requests: Mapping[int, GradientRequest], *, retain: bool) -> dict[int, Any]:
        every = [tensor for request in requests.values() for tensor in request.tensors]
        objectives = [request.objective for request in requests.values()]
        found = iter(torch.autograd.grad(objectives, every, retain_graph=retain, allow_unused=True))
        return {k: [next(found) for _ in request.tensors] for k, request in requests.items()}

    def _frames(self, requests: Sequence[FrameRequest]) -> list[tuple[torch.Tensor, torch.Tensor]]:
        union, window = self._solver([request.source for request in requests])
        gates = [Gate(request.limit) for request in requests]
        names = list(requests[0].parameters)
        entered = [Enter.apply(gate, r.x, r.v, *r.parameters.values()) for gate, r in zip(gates, requests, strict=True)]  # type: ignore[no-untyped-call]
        x, v = union.of_nodes([own[0] for own in entered], places=True), union.of_nodes([own[1] for own in entered])
        parameters = union.parameters([dict(zip(names, own[2:], strict=True)) for own in entered])
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
        if known is None or any(one is not other for one, other in zip(known[0], twins, strict=True)):
            union = Union([twin.topology for twin in twins])
            device, simulations = sources[0].device, [twin.simulation for twin in twins]
            window = FrameWindow(lambda: solver_of(union, simulations, device=device), max(source.frames for source in sources))
            known = self._solvers[key] = twins, union, window
        return known[1], known[2]


def _alone(one: FrameRequest) -> tuple[torch.Tensor, torch.Tensor]:
    return simulate_frame(one.source.window(), one.parameters, one.x, one.v, one.begin, one.end, one.limit)


class Gate:
    """The limit of one fit's adjoint at a frame that it shares with others."""

    def __init__(self, limit: AdjointLimit | None) -> None:
        self.limit = limit
        self.after: Sequence[torch.Tensor] = ()
        """(dL/dx, dL/dv) at the end of the frame."""


class Enter(torch.autograd.Function):
    """The inputs of a frame, whose adjoints pass unless the gate's limit leaves the frame out, as in `solver.Frame`."""

    @staticmethod
    def forward(ctx: Any, gate: Gate, *inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:  # type: ignore[override]
        """The inputs: x, v, parameters."""
        ctx.gate = gate
        return tuple(tensor.view_as(tensor) for tensor in inputs)

    @staticmethod
    def backward(ctx: Any, *adjoints: torch.Tensor) -> tuple[torch.Tensor | None, ...]:  # type: ignore[override]
        """The adjoints, or none."""
        gate = ctx.gate
        # In a backward pass of others, whose window is shorter, nothing has come to the end of this fit's frame.
        if gate.limit is not None and not (gate.after and gate.limit.passes(gate.after, adjoints[:2])):
            return (None,) * (1 + len(adjoints))
        return None, *adjoints


class Leave(torch.autograd.Function):
    """The end of a frame, whose adjoints the gate keeps."""

    @staticmethod
    def forward(ctx: Any, gate: Gate, x: torch.Tensor, v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:  # type: ignore[override]
        """(x, v)."""
        ctx.gate = gate
        return x.view_as(x), v.view_as(v)

    @staticmethod
    def backward(ctx: Any, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[None, torch.Tensor, torch.Tensor]:  # type: ignore[override]
        """The adjoints."""
        ctx.gate.after = (adj_x, adj_v)
        return None, adj_x, adj_v


def shared_physics(twin: Twin, always: bool) -> tuple[Any, ...]:
    """Values that twins have in common which share a launch: the physics, and the points too unless hands `always` hold."""
    points = () if always else (twin.topology.nodes.tobytes(), twin.topology.controllers.shape)
    return physics_of(twin.simulation), points
