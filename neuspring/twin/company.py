"""Fits that run at the same time and share launches: each in a thread of its own, their frames in the lanes of one solver.

A fit asks its seat for a frame, or for a frame's adjoint, and waits. When every fit of the company waits, one launch serves all who
ask for the same. So fits in step (equal horizons) always share, and others still finish. Each fit's numbers are those it has alone,
bit for bit on a CPU.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
import torch

from neuspring.core.artifacts import Twin
from neuspring.physics.solver import FrameSolver, stacked, union, unstacked

T = TypeVar("T")
Results = tuple[Any, ...]
"""(x, v) of a frame, or the adjoints of x, v and of parameters by name."""


class Seat:
    """A fit's place in a company; to `simulate_frame` it is a solver."""

    def __init__(self, company: Company, twin: Twin) -> None:
        self.company = company
        self.twin = twin
        self.frame_token = 0
        """Changes with every frame that the shared solver simulates: tells whether it still holds a given one."""
        self.collision_overflow = 0
        """Collision candidates of this twin that did not fit the lists so far."""
        self.request: tuple[str, Sequence[Any]] | None = None
        self.answer: Results | BaseException | None = None

    def sit(self, twin: Twin) -> Seat:
        """Simulate `twin` from now on."""
        self.company.seat(self, twin)
        return self

    def run(self, *inputs: Any) -> Results:
        """As `FrameSolver.run`."""
        return self.company.ask(self, "run", inputs)

    def backward(self, adj_x: torch.Tensor, adj_v: torch.Tensor) -> Results:
        """As `FrameSolver.backward`."""
        return self.company.ask(self, "backward", (adj_x, adj_v))


class Company:
    """Seats that share a solver. Another is made for the next frame when a twin's substeps change, or when a fit has ended."""

    def __init__(self, twins: Sequence[Twin], device: str) -> None:
        self.seats = [Seat(self, twin) for twin in twins]
        self._device = device
        self._active = list(self.seats)
        self._turn = threading.Condition()
        self._end: BaseException | None = None
        self._solver: FrameSolver | None = None
        self._stale = True
        """Whether the next frame needs another solver. The old one holds the frames whose adjoints are still asked for."""
        self._members: list[Seat] = []
        """Seats of the solver, by lane."""
        self._places: list[np.ndarray] = []
        self._springs = 0

    def seat(self, seat: Seat, twin: Twin) -> None:
        """Put a twin on a seat."""
        with self._turn:
            if seat.twin is not twin:
                seat.twin, self._stale = twin, True

    def leave(self, seat: Seat) -> None:
        """End a seat's part, so that nobody waits for it."""
        with self._turn:
            self._active.remove(seat)
            self._stale = True
            self._serve_if_all_wait()

    def stop(self, reason: BaseException) -> None:
        """End every fit at its next frame, by the same error."""
        with self._turn:
            self._end = reason
            self._turn.notify_all()

    def ask(self, seat: Seat, what: str, inputs: Sequence[Any]) -> Results:
        """Wait for the launch that serves a request."""
        with self._turn:
            seat.request, seat.answer = (what, inputs), None
            self._serve_if_all_wait()
            self._turn.wait_for(lambda: seat.answer is not None or self._end is not None)
            answer = self._end or seat.answer
        if isinstance(answer, BaseException):
            raise answer
        assert answer is not None
        return answer

    def _serve_if_all_wait(self) -> None:
        if self._end or not self._active or any(seat.request is None for seat in self._active):
            return
        try:
            self._serve()
        except Exception as error:
            for seat in self._active:
                seat.request, seat.answer = None, error
        self._turn.notify_all()

    def _serve(self) -> None:
        # Adjoints first: the frames that they belong to are in the buffers until the next frame is simulated.
        for what, serve in (("backward", self._backward), ("run", self._run)):
            asking = [seat for seat in self._active if seat.request is not None and seat.request[0] == what]
            if asking:
                inputs = [seat.request[1] for seat in asking if seat.request is not None]
                for seat, answer in zip(asking, serve(asking, inputs), strict=True):
                    seat.request, seat.answer = None, answer

    def _run(self, asking: list[Seat], inputs: Sequence[Sequence[Any]]) -> list[Results]:
        if self._stale or self._solver is None:
            self._solver = self._made()
        solver, lanes = self._solver, [self._members.index(seat) for seat in asking]
        # A lane that nobody asks for repeats the first that is asked for.
        source = [lanes.index(lane) if lane in lanes else 0 for lane in range(len(self._members))]
        begin, end, x, v = (torch.stack([inputs[k][place] for k in source]) for place in range(4))
        places = [self._places[lanes[k]] for k in source]
        parameters = stacked([inputs[k][4] for k in source], places, self._springs)
        before = solver.overflows if solver.simulation.self_collision else None
        solver.set_parameters(parameters)
        after = solver.forward(x, v, begin, end)
        for seat in self._active:
            seat.frame_token += 1
        if before is not None:
            for seat, lane in zip(asking, lanes, strict=True):
                seat.collision_overflow += solver.overflows[lane] - before[lane]
        return [(after[0][lane].clone(), after[1][lane].clone()) for lane in lanes]

    def _backward(self, asking: list[Seat], inputs: Sequence[Sequence[Any]]) -> list[Results]:
        solver = self._solver
        assert solver is not None
        zero = torch.zeros_like(inputs[0][0])
        given = {self._members.index(seat): adjoints for seat, adjoints in zip(asking, inputs, strict=True)}
        adj_x, adj_v = (
            torch.stack([given[lane][place] if lane in given else zero for lane in range(len(self._members))]) for place in (0, 1)
        )
        x, v, gradients = solver.backward(adj_x, adj_v)
        return [(x[lane], v[lane], unstacked(gradients, lane, self._places[lane])) for lane in given]

    def _made(self) -> FrameSolver:
        """A solver of all active seats."""
        self._members, self._stale = list(self._active), False
        twins = [seat.twin for seat in self._members]
        pairs, self._places = union([twin.topology for twin in twins])
        self._springs = len(pairs)
        first = twins[0].topology
        simulations = [twin.simulation for twin in twins]
        return FrameSolver(pairs, len(first.nodes), len(first.controllers), simulations, device=self._device)


def together(twins: Sequence[Twin], device: str, works: Sequence[Callable[[Seat], T]]) -> list[T | Exception]:
    """What each work returns, or the error that ended it, with seats of one company; work k begins with twin k."""
    company = Company(twins, device)

    def run(seat: Seat, work: Callable[[Seat], T]) -> T | Exception:
        try:
            # Backward passes run in the thread that asks for them, on CUDA too: one thread for all would wait for itself.
            with torch.autograd.set_multithreading_enabled(False):
                return work(seat)
        except Exception as error:
            return error
        finally:
            company.leave(seat)

    with ThreadPoolExecutor(len(works)) as pool:
        try:
            return list(pool.map(run, company.seats, works))
        except BaseException as reason:
            # An interrupt must not wait for the ends of all fits.
            company.stop(reason)
            raise
