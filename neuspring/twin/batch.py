"""Fits that run at the same time and share launches: each in a thread of its own, their frames in the lanes of one solver.

A fit requests a frame, or a frame's adjoint, from its lane, and waits. When every fit of the batch waits, one launch serves all
requests of the same kind. So fits in step (equal horizons) always share, and others still finish. Each fit's numbers are those it
has alone, bit for bit on a CPU.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
import torch

from neuspring.core.artifacts import Twin
from neuspring.physics.solver import FrameSolver, FrameWindow, stacked, union, unstacked

T = TypeVar("T")
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
        state = self.batch.request(self, "run", inputs)
        self._asked = self.frame_token
        return state

    def holding(self, token: int) -> Lane | None:
        """As `FrameSolver.holding`; `backward` is then that of this frame."""
        self._asked = token
        return self if self.batch.holding(token) else None

    def backward(self, adj_x: torch.Tensor, adj_v: torch.Tensor) -> Results:
        """As `FrameSolver.backward`."""
        return self.batch.request(self, "backward", (adj_x, adj_v, self._asked))


class BatchedFits:
    """Lanes that share a solver; another is made for the next frame when a twin's substeps change or a fit has ended."""

    def __init__(self, twins: Sequence[Twin], device: str) -> None:
        self.lanes = [Lane(self, twin) for twin in twins]
        self._device = device
        self._active = list(self.lanes)
        self.turn = threading.Condition()
        self._end: BaseException | None = None
        self.frame_token = 0
        self._window: FrameWindow | None = None
        self.stale = True
        """True where the next frame needs another window. The old one holds frames whose adjoints may be requested."""
        self._members: list[Lane] = []
        """Lanes of the present window, in the order of its solvers."""
        self._places: list[np.ndarray] = []
        self._springs = 0

    def remove(self, lane: Lane) -> None:
        """Take out a lane whose fit has ended, so that nobody waits for it."""
        with self.turn:
            self._active.remove(lane)
            self.stale = True
            self._serve_if_all_wait()

    def stop(self, reason: BaseException) -> None:
        """End every fit at its next frame, by the same error."""
        with self.turn:
            self._end = reason
            self.turn.notify_all()

    def holding(self, token: int) -> FrameSolver | None:
        """The solver that holds a frame; None if it is no longer held."""
        return self._window.holding(token) if self._window else None

    def request(self, lane: Lane, what: str, inputs: Sequence[Any]) -> Results:
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
        solver, numbers = self._window.turn(), [self._members.index(lane) for lane in waiting]
        # A lane without a request repeats the first that has one.
        source = [numbers.index(number) if number in numbers else 0 for number in range(len(self._members))]
        begin, end, x, v = (torch.stack([inputs[k][place] for k in source]) for place in range(4))
        places = [self._places[numbers[k]] for k in source]
        parameters = stacked([inputs[k][4] for k in source], places, self._springs)
        before = solver.overflows if solver.simulation.self_collision else None
        after = solver.run(begin, end, x, v, parameters)
        self.frame_token += 1
        if before is not None:
            for lane, number in zip(waiting, numbers, strict=True):
                lane.collision_overflow += solver.overflows[number] - before[number]
        return [(after[0][number].clone(), after[1][number].clone()) for number in numbers]

    def _backward(self, waiting: list[Lane], inputs: Sequence[Sequence[Any]]) -> list[Results]:
        solver = self.holding(inputs[0][2])
        assert solver is not None
        zero = torch.zeros_like(inputs[0][0])
        given = {self._members.index(lane): adjoints for lane, adjoints in zip(waiting, inputs, strict=True)}
        adj_x, adj_v = (
            torch.stack([given[number][place] if number in given else zero for number in range(len(self._members))])
            for place in (0, 1)
        )
        x, v, gradients = solver.backward(adj_x, adj_v)
        return [(x[number], v[number], unstacked(gradients, number, self._places[number])) for number in given]

    def _made(self) -> FrameWindow:
        """A window of all active lanes."""
        self._members, self.stale = list(self._active), False
        twins = [lane.twin for lane in self._members]
        pairs, self._places = union([twin.topology for twin in twins])
        self._springs = len(pairs)
        size = len(twins[0].topology.nodes), len(twins[0].topology.controllers)
        simulations = [twin.simulation for twin in twins]

        def make() -> FrameSolver:
            return FrameSolver(pairs, *size, simulations, device=self._device)

        return FrameWindow(make, max(lane.frames for lane in self._members), self.frame_token)


def run_batch(twins: Sequence[Twin], device: str, works: Sequence[Callable[[Lane], T]]) -> list[T | Exception]:
    """The results of each work, or the error that ended it, with the lanes of one batch; work k begins with twin k."""
    batch = BatchedFits(twins, device)

    def run(lane: Lane, work: Callable[[Lane], T]) -> T | Exception:
        try:
            # Backward passes run in the thread that asks for them, on CUDA too: one thread for all would wait for itself.
            with torch.autograd.set_multithreading_enabled(False):
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
