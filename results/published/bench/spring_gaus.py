"""Time of a frame of Spring-Gaus with its gradient, in kernels and in eager torch.

    python -m results.published.bench.spring_gaus [DEVICE]

Both in float32, on one CPU thread or on a GPU (`cuda`); states and gradients are compared before the times.
"""

from __future__ import annotations

import sys

import numpy as np
import torch

from neuspring.core.device import resolve_device
from neuspring.extensions.spring_gaus.model import SpringGausModel, SpringGausTraining
from neuspring.extensions.spring_gaus.physics import AnchorGraph, AnchorPhysics, AnchorSolver
from results.published.bench.simulators import take_turns
from tests.extensions.spring_gaus.test_spring_gaus import reference_substep

ANCHORS, SUBSTEPS, REPEATS = 1024, 100, 5


def main() -> None:
    """Print milliseconds per frame and their ratio."""
    torch.set_num_threads(1)
    device = resolve_device(sys.argv[1] if len(sys.argv) > 1 else "cpu")
    model, hands = bar()
    kernels, eager = ByKernels(model, hands, device), InTorch(model, hands, device)
    for found, wanted in zip(kernels.run(), eager.run(), strict=True):
        scale = float(wanted.abs().max())
        # Rounding grows in so stiff an object; the tests compare in float64.
        np.testing.assert_allclose(found.cpu(), wanted.cpu(), atol=1e-2 * scale)
    times = take_turns({"kernels": kernels.run, "eager": eager.run}, device, rounds=REPEATS, least=REPEATS)
    first, second = (1e3 * its.least for its in times.values())
    print(f"Spring-Gaus, {ANCHORS} anchors, {SUBSTEPS} substeps, a frame and its gradient, {device}, ms (minimum of {REPEATS})")
    print(f"    kernels       {first:8.1f}")
    print(f"    eager torch   {second:8.1f}    {second / first:.1f} x as long")


def bar() -> tuple[SpringGausModel, np.ndarray]:
    """A falling object and its controllers [2, 30, 3], m."""
    rng = np.random.default_rng(0)
    cells = np.stack(np.meshgrid(range(16), range(8), range(8), indexing="ij"), axis=-1).reshape(-1, 3)
    anchors = 0.01 * cells + rng.uniform(-1e-3, 1e-3, cells.shape) + [0, 0, 0.3]
    hands = np.stack([anchors[:30] + 0.005, anchors[:30] + 0.01]).astype(np.float32)
    settings = SpringGausTraining()
    graph = AnchorGraph.between(anchors, hands[0], settings.neighbors)
    model = SpringGausModel.start(graph, AnchorPhysics(frame_time=1 / 30), settings)
    return model, hands


class ByKernels:
    """The implementation of training."""

    def __init__(self, model: SpringGausModel, hands: np.ndarray, device: str) -> None:
        self.model, self.hands = model, torch.tensor(hands, device=device)
        self.x = torch.tensor(model.anchors, device=device)
        self.values = {name: tensor.requires_grad_() for name, tensor in model.tensors(device).items()}
        self.solver = AnchorSolver(model, model, SUBSTEPS, device)

    def run(self) -> list[torch.Tensor]:
        """Positions after a frame, and the gradients of their sum of squares."""
        for tensor in self.values.values():
            tensor.grad = None
        after = self.frame(torch.zeros_like(self.x) + self.values["velocity"])
        after.square().sum().backward()
        return [after.detach(), *(tensor.grad for tensor in self.values.values())]

    def frame(self, v: torch.Tensor) -> torch.Tensor:
        """Positions after a frame."""
        return self.solver.frame(self.model.parameters(self.values), self.x, v, *self.hands)[0]


class InTorch(ByKernels):
    """The reference in eager torch, float32."""

    def frame(self, v: torch.Tensor) -> torch.Tensor:
        """Positions after a frame."""
        model, x = self.model, self.x
        parameters = model.parameters(self.values)
        for k in range(SUBSTEPS):
            at = self.hands[0] + (k + 1) / SUBSTEPS * (self.hands[1] - self.hands[0])
            x, v = reference_substep(model, model, parameters, x, v, at, model.frame_time / SUBSTEPS)
        return x


if __name__ == "__main__":
    main()
