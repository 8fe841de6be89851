"""Fits, or searches, that run at the same time and share launches: each in a thread of its own, their twins in one solver.

A fit requests a frame, or a frame's adjoint, from its lane, and waits; a search the rollouts of its candidates. When all of the
batch wait, one launch serves all requests of the same kind. So fits in step (equal horizons) always share, and others still finish.
Scenes may differ. The numbers of each are those it has alone, bit for bit on a CPU.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import Any, TypeVar

import torch

from neuspring.core.artifacts import Twin
from neuspring.physics.solver import FrameSolver, FrameWindow, physics_of, solver_of
from neuspring.physics.union import Union
from neuspring.twin.trials import Rollouts, rolled

T = TypeVar("T")
AnyLane = Any
"""`Lane` or `SearchLane`."""
Results = tuple[Any, ...]
"""(x, v) of a frame, or the adjoints of x, v and of parameters by name."""


class Lane:
    """A fit's lane in a batch; to `simulate_frame` it is a solver."""

    def __init__(self, batch: BatchedFits, twin: Twin) -> None:
        self.batch = batch
        self.twin = twin
        self.frames = 1
        """Number of frames that a gradient goes through."""
        self._asked = 0
        """The frame whose adjoint is asked for next."""
        self.collision_overflow = 0
        """Collision pairs of this twin that were dropped so far because the list was full."""
        self.waiting: tuple[str, Sequence[Any]] | None = None
        """The request, "run" or "backward", and its inputs."""
        self.asked: Sequence[Any] = ()
        """Inputs of the last frame."""
        self.answer: Results | BaseException | None = None

    @property
    def frame_token(self) -> int:
        """Number of frames simulated for the batch."""
        return self.batch.frame_token

    def of_twin(self, twin: Twin, frames: int = 1) -> Lane:
        """This lane, which simulates `twin` from now on, with gradients through so many frames."""
        self.frames = frames
        with self.batch.turn:
            if self.twin is not twin:
                self.twin, self.batch.stale = twin, True
        return self

    def run(self, *inputs: Any) -> Results:
        """As `FrameSolver.run`."""
        state: Results = self.batch.request(self, "run", inputs)
        self._asked = self.frame_token
        return state

    def holding(self, token: int) -> Lane | None:
        """As `FrameSolver.holding`; `backward` is then that of this frame."""
        self._asked = token
        return self if self.batch.holding(token) else None

    def backward(self, adj_x: torch.Tensor, adj_v: torch.Tensor) -> Results:
        """As `FrameSolver.backward`."""
        adjoints: Results = self.batch.request(self, "backward", (adj_x, adj_v, self._asked))
        return adjoints


class Shared(ABC):
    """Lanes of works that wait for one another: when each has a request, all are served at once.

    A request is what it asks for and its inputs.
    """

    one_at_a_time = False
    """True where a work runs only while all others wait."""

    def __init__(self, lanes: Sequence[AnyLane]) -> None:
        self.lanes = lanes
        self._active = list(lanes)
        self.turn = threading.Condition()
        self._end: BaseException | None = None

    def remove(self, lane: AnyLane) -> None:
        """Take out a lane whose work has ended, so that nobody waits for it."""
        with self.turn:
            self._active.remove(lane)
            self._serve_if_all_wait()

    def stop(self, reason: BaseException) -> None:
        """End every work at its next request, by the same error."""
        with self.turn:
            self._end = reason
            self.turn.notify_all()

    def request(self, lane: AnyLane, what: str, inputs: Sequence[Any]) -> Any:
        """Wait for the launch that serves a request."""
        with self.turn:
            lane.waiting, lane.answer = (what, inputs), None
            self._serve_if_all_wait()
            self.turn.wait_for(lambda: lane.answer is not None or self._end is not None)
            answer = self._end or lane.answer
        if isinstance(answer, BaseException):
            raise answer
        assert answer is not None
        return answer

    def _serve_if_all_wait(self) -> None:
        if self._end or not self._active or any(lane.waiting is None for lane in self._active):
            return
        try:
            self._serve()
        except Exception as error:
            for lane in self._active:
                lane.waiting, lane.answer = None, error
        self.turn.notify_all()

    @abstractmethod
    def _serve(self) -> None:
        """Answer the requests of all active lanes."""


class SearchLane:
    """A search's lane: it asks for the results of its rollouts (trials.py)."""

    def __init__(self, batch: BatchedSearches) -> None:
        self.batch = batch
        self.waiting: tuple[str, Sequence[Any]] | None = None
        self.answer: Any = None

    def __call__(self, rollouts: Rollouts) -> Any:
        """As `rolled` of one."""
        return self.batch.request(self, "roll out", (rollouts,))


class BatchedSearches(Shared):
    """Searches whose candidates are rolled out together, generation by generation, whatever their scenes.

    They make their candidates one after the other: Warp's tables of kernels are not made for threads.
    """

    one_at_a_time = True

    def __init__(self, count: int, device: str) -> None:
        super().__init__([SearchLane(self) for _ in range(count)])
        self._device = device

    def _serve(self) -> None:
        together: dict[Any, list[Any]] = {}
        for lane in self._active:
            one: Rollouts = lane.waiting[1][0]
            together.setdefault(physics_with(one.twins[0], one.hands.shape[-1] == 3), []).append((lane, one))
        for group in together.values():
            for (lane, _), answer in zip(group, rolled([one for _, one in group], self._device), strict=True):
                lane.waiting, lane.answer = None, answer


def physics_with(twin: Twin, always: bool) -> tuple[Any, ...]:
    """The physics, which rollouts that share launches have in common, and the points too unless hands `always` hold."""
    points = () if always else (twin.topology.nodes.tobytes(), twin.topology.controllers.shape)
    return physics_of(twin.simulation), points


class BatchedFits(Shared):
    """Lanes that share a solver; another is made for the next frame when a twin's substeps change or a fit has ended."""

    def __init__(self, twins: Sequence[Twin], device: str) -> None:
        super().__init__([Lane(self, twin) for twin in twins])
        self._device = device
        self.frame_token = 0
        self._window: FrameWindow | None = None
        self.stale = True
        """True where the next frame needs another window. The old one holds frames whose adjoints may be requested."""
        self._members: list[Lane] = []
        """Lanes of the present window, in the order of its solvers."""
        self._union: Union
        """Their points and springs."""

    def remove(self, lane: Lane) -> None:
        self.stale = True
        super().remove(lane)

    def holding(self, token: int) -> FrameSolver | None:
        """The solver that holds a frame; None if it is no longer held."""
        return self._window.holding(token) if self._window else None

    def _serve(self) -> None:
        # Adjoints first: the frames that they belong to are in the buffers until the next frame is simulated.
        waiting = {lane: lane.waiting for lane in self._active if lane.waiting is not None}
        runs = {lane: inputs for lane, (what, inputs) in waiting.items() if what == "run"}
        adjoints = {lane: inputs for lane, (what, inputs) in waiting.items() if what == "backward"}
        for token in sorted({inputs[2] for inputs in adjoints.values()}):
            self._answer(self._backward, {lane: inputs for lane, inputs in adjoints.items() if inputs[2] == token})
        if runs:
            self._answer(self._run, runs)

    @staticmethod
    def _answer(serve: Callable[..., list[Results]], requests: dict[Lane, Sequence[Any]]) -> None:
        for lane, answer in zip(requests, serve(list(requests), list(requests.values())), strict=True):
            lane.waiting, lane.answer = None, answer

    def _run(self, waiting: list[Lane], inputs: Sequence[Sequence[Any]]) -> list[Results]:
        if self.stale or self._window is None:
            self._window = self._made()
        solver, union, numbers = self._window.turn(), self._union, [self._members.index(lane) for lane in waiting]
        for lane, own in zip(waiting, inputs, strict=True):
            lane.asked = own
        # A lane without a request repeats its last one.
        begin, end, x, v, parameters = zip(*(lane.asked for lane in self._members), strict=True)
        hands = union.of_controllers(begin), union.of_controllers(end)
        state = union.of_nodes(x, places=True), union.of_nodes(v)
        before = solver.overflows if solver.simulation.self_collision else None
        after = solver.run(*hands, *state, union.parameters(parameters))
        self.frame_token += 1
        if before is not None:
            for lane, number in zip(waiting, numbers, strict=True):
                lane.collision_overflow += solver.overflows[number] - before[number]
        return [tuple(values[number, : union.sizes[number][0]].clone() for values in after) for number in numbers]

    def _backward(self, waiting: list[Lane], inputs: Sequence[Sequence[Any]]) -> list[Results]:
        solver, union = self.holding(inputs[0][2]), self._union
        assert solver is not None
        given = {self._members.index(lane): adjoints for lane, adjoints in zip(waiting, inputs, strict=True)}
        zero = torch.zeros_like(inputs[0][0])[:0]
        adj_x, adj_v = (
            union.of_nodes([given[number][place] if number in given else zero for number in range(len(self._members))])
            for place in (0, 1)
        )
        x, v, gradients = solver.backward(adj_x, adj_v)
        own = {number: slice(union.sizes[number][0]) for number in given}
        return [(x[number, kept], v[number, kept], union.gradients(gradients, number)) for number, kept in own.items()]

    def _made(self) -> FrameWindow:
        """A window of all active lanes."""
        self._members, self.stale = list(self._active), False
        twins = [lane.twin for lane in self._members]
        self._union = union = Union([twin.topology for twin in twins])

        def make() -> FrameSolver:
            return solver_of(union, [twin.simulation for twin in twins], device=self._device)

        return FrameWindow(make, max(lane.frames for lane in self._members), self.frame_token)


def run_batch(twins: Sequence[Twin], device: str, works: Sequence[Callable[[Lane], T]]) -> list[T | Exception]:
    """The results of each fit, or the error that ended it, with the lanes of one batch; work k begins with twin k."""
    return _run(BatchedFits(twins, device), works)


def run_searches(device: str, works: Sequence[Callable[[SearchLane], T]]) -> list[T | Exception]:
    """The results of each search, or the error that ended it, with the lanes of one batch."""
    before = torch.get_num_threads()
    # Of torch's own threads a search has none; each would set them back when it ends.
    torch.set_num_threads(1)
    try:
        return _run(BatchedSearches(len(works), device), works)
    finally:
        torch.set_num_threads(before)


def _run(batch: Shared, works: Sequence[Callable[[Any], T]]) -> list[T | Exception]:
    def run(lane: Any, work: Callable[[Any], T]) -> T | Exception:
        try:
            # Backward passes run in the thread that asks for them, on CUDA too: one thread for all would wait for itself.
            with torch.autograd.set_multithreading_enabled(False), batch.turn if batch.one_at_a_time else nullcontext():
                return work(lane)
        except Exception as error:
            return error
        finally:
            batch.remove(lane)

    with ThreadPoolExecutor(len(works)) as pool:
        try:
            return list(pool.map(run, batch.lanes, works))
        except BaseException as reason:
            # An interrupt must not wait for the ends of all fits.
            batch.stop(reason)
            raise
