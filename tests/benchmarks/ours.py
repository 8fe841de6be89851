"""This project's simulator as the table times it: the only file of the table that knows the engine's interface."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch.nn.functional import smooth_l1_loss

from neuspring.core.artifacts import Twin
from neuspring.physics.autograd import pack, simulate_frame, solver_for, twin_tensors
from neuspring.physics.solver import Parameters
from tests.benchmarks.simulators import Frame


class Ours:
    """The project's solver on a device."""

    name = "ours"

    def __init__(self, device: str = "cpu") -> None:
        self.device = device

    def forward(self, twin: Twin, hands: np.ndarray) -> Frame:
        """One frame of one twin, by a solver that keeps no substeps."""
        solver = solver_for(twin, self.device, differentiable=False)
        x, v, begin, end = self._start(twin, hands)
        last: list[torch.Tensor] = []

        def run() -> None:
            last[:] = solver.forward(x, v, begin, end)

        return Frame(run, lambda: last[0].cpu().numpy())

    def forward_backward(self, twin: Twin, hands: np.ndarray) -> Frame:
        """One frame of one twin and the gradient of its loss."""
        solver = solver_for(twin, self.device, differentiable=True)
        x, v, begin, end = self._start(twin, hands)
        packed = self._packed(twin)
        last: list[torch.Tensor] = []

        def run() -> None:
            packed.springs.grad = None
            last[:] = simulate_frame(solver, packed, x, v, begin, end)
            smooth_l1_loss(last[0], torch.zeros_like(last[0])).backward()

        def gradient() -> np.ndarray:
            assert packed.springs.grad is not None
            # Column 0 is dL/dY; Y dL/dY = dL/d(log Y).
            along: np.ndarray = (packed.springs.grad[:, 0] * packed.springs.detach()[:, 0]).cpu().numpy()
            return along

        return Frame(run, lambda: last[0].detach().cpu().numpy(), gradient)

    def together(self, twins: Sequence[Twin], hands: np.ndarray, *, gradient: bool) -> Frame:
        """One frame of several twins of one topology in one call, with or without the gradient of the sum of their losses.

        Positions [N, 3] and gradient [S] of the frame are those of the first twin. Raises NotImplementedError: this engine
        simulates one twin at a time.
        """
        raise NotImplementedError("several twins together, since the engine simulates one at a time")

    def chain(self, twin: Twin, path: np.ndarray) -> Callable[[], object]:
        """The gradient of the loss after all frames of a path of the hands [F + 1, C, 3]."""
        solver = solver_for(twin, self.device, differentiable=True)
        steps = torch.tensor(path, dtype=torch.float32, device=self.device)
        start, rest, *_ = self._start(twin, path[:2])
        packed = self._packed(twin)

        def run() -> None:
            packed.springs.grad = None
            x, v = start, rest
            for k in range(len(steps) - 1):
                x, v = simulate_frame(solver, packed, x, v, steps[k], steps[k + 1])
            smooth_l1_loss(x, torch.zeros_like(x)).backward()

        return run

    def _start(self, twin: Twin, hands: np.ndarray) -> tuple[torch.Tensor, ...]:
        """The state at rest, and the hands at both ends of the frame."""
        x = torch.tensor(twin.topology.nodes, device=self.device)
        begin, end = torch.tensor(hands, dtype=torch.float32, device=self.device)
        return x, torch.zeros_like(x), begin, end

    def _packed(self, twin: Twin) -> Parameters:
        packed = pack(**twin_tensors(twin, self.device), substep=twin.simulation.substep)
        packed.springs.requires_grad_()
        return packed
