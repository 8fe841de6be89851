"""This package's simulator behind the interface of the benchmark; no other file of the benchmark uses the solver."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch.nn.functional import smooth_l1_loss

from neuspring.core.artifacts import Twin
from neuspring.physics import reference
from neuspring.physics.parameters import Parameters, packed
from neuspring.physics.solver import simulate_frame, solver_for
from neuspring.physics.union import Union
from results.published.bench.simulators import Frame


class Ours:
    """The solver of the package on a device."""

    name = "ours"

    def __init__(self, device: str = "cpu") -> None:
        self.device = device

    def forward(self, twin: Twin, hands: np.ndarray) -> Frame:
        """One frame of one twin, with a solver that stores no substeps."""
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
        parameters = self._packed(twin)
        last: list[torch.Tensor] = []

        def run() -> None:
            parameters["springs"].grad = None
            last[:] = simulate_frame(solver, parameters, x, v, begin, end)
            smooth_l1_loss(last[0], torch.zeros_like(last[0])).backward()

        def gradient() -> np.ndarray:
            assert parameters["springs"].grad is not None
            return of_log_stiffness(parameters["springs"].grad, parameters["springs"])

        return Frame(run, lambda: last[0].detach().cpu().numpy(), gradient)

    def together(self, twins: Sequence[Twin], hands: np.ndarray, *, gradient: bool) -> Frame:
        """One frame of several twins of the same nodes in one call, with or without the gradient of the sum of their losses.

        Their topologies may differ. Positions [N, 3] and gradient [S] of the frame are those of the first twin.
        """
        solver = solver_for(twins, self.device, differentiable=gradient)
        union = Union([twin.topology for twin in twins])
        parameters = union.parameters([packed(twin, self.device) for twin in twins])
        x, v, begin, end = (values.expand(len(twins), -1, -1).contiguous() for values in self._start(twins[0], hands))
        last: list[torch.Tensor] = []

        def run() -> None:
            last[:] = solver.forward(x, v, begin, end)

        def learn() -> None:
            parameters["springs"].grad = None
            last[:] = simulate_frame(solver, parameters, x, v, begin, end)
            # The loss is a mean over the coordinates of a twin.
            loss = smooth_l1_loss(last[0], torch.zeros_like(last[0]), reduction="sum") / last[0][0].numel()
            loss.backward()

        def along() -> np.ndarray:
            assert parameters["springs"].grad is not None
            return of_log_stiffness(parameters["springs"].grad[0], parameters["springs"][0])[union.places[0]]

        parameters["springs"].requires_grad_(gradient)
        return Frame(learn if gradient else run, lambda: last[0][0].detach().cpu().numpy(), along if gradient else None)

    def chain(self, twin: Twin, path: np.ndarray) -> Callable[[], object]:
        """The gradient of the loss after all frames of a path of the controllers [F + 1, C, 3]."""
        solver = solver_for(twin, self.device, differentiable=True)
        steps = torch.tensor(path, dtype=torch.float32, device=self.device)
        start, rest, *_ = self._start(twin, path[:2])
        parameters = self._packed(twin)

        def run() -> None:
            parameters["springs"].grad = None
            x, v = start, rest
            for k in range(len(steps) - 1):
                x, v = simulate_frame(solver, parameters, x, v, steps[k], steps[k + 1])
            smooth_l1_loss(x, torch.zeros_like(x)).backward()

        return run

    def _start(self, twin: Twin, hands: np.ndarray) -> tuple[torch.Tensor, ...]:
        """The state at rest, and the controllers at both ends of the frame."""
        x = torch.tensor(twin.topology.nodes, device=self.device)
        begin, end = torch.tensor(hands, dtype=torch.float32, device=self.device)
        return x, torch.zeros_like(x), begin, end

    def _packed(self, twin: Twin) -> Parameters:
        parameters = packed(twin, self.device)
        parameters["springs"].requires_grad_()
        return parameters


def of_log_stiffness(gradient: torch.Tensor, springs: torch.Tensor) -> np.ndarray:
    """dL/d(log Y) = Y dL/dY [S] from the gradient of packed springs [S, 3] and their values; column 0 is dL/dY."""
    along: np.ndarray = (gradient[:, 0] * springs.detach()[:, 0]).cpu().numpy()
    return along


def reference_frame(twin: Twin, hands: np.ndarray) -> Frame:
    """One frame of the NumPy specification in float64."""
    scene, nodes = reference.ReferenceTwin.of(twin), twin.topology.nodes.astype(np.float64)
    last: list[np.ndarray] = []

    def run() -> None:
        last[:] = reference.frame(scene, nodes, np.zeros_like(nodes), *hands)[:2]

    return Frame(run, lambda: last[0])
