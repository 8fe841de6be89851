"""Rollouts of several candidates at once, and their training losses (losses.py) without gradients.

Everything stays in the solver's buffers, in lanes: after each frame kernels add the frame's loss to each twin's sum, and note the
frame in which a twin leaves the scene. Sums go through points and nodes in order, in float64, so that a twin's cost does not depend
on its company, bit for bit on a CPU.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import warp as wp

from neuspring.core.artifacts import Twin
from neuspring.core.device import load
from neuspring.physics.solver import FrameSolver, solver_for
from neuspring.twin.losses import FrameLoss
from neuspring.twin.trial_kernels import Kernels, kernels

LOOK_EVERY = {"cpu": 1, "cuda": 16}
"""Frames between two looks whether any twin is still in the scene: on CUDA each makes the host wait."""


@dataclass(frozen=True)
class Outcome:
    """What became of a candidate's rollout."""

    cost: float
    """Mean training loss over frames 1 .. train_end - 1, m^2, acceleration included; infinite if it left the scene."""
    left: int
    """The frame in which a node left the scene; 0 if none did."""
    collision_overflow: int


def outcomes(twins: Sequence[Twin], hands: torch.Tensor, velocity: torch.Tensor, loss: FrameLoss, device: str) -> list[Outcome]:
    """Roll twins of the same nodes out from velocity [N, 3], m/s, and judge the frames that the loss holds.

    hands are the controllers' positions [T, C, 3], or `controllers.waypoints` of them; or those of each twin, [T, B, C, 3].
    """
    solver = solver_for(twins, device, differentiable=False)
    count = len(twins)
    nodes = torch.tensor(twins[0].topology.nodes, device=device)
    solver.start(nodes.expand(count, -1, -1), velocity.expand(count, -1, -1))
    sums = LossSums(solver, loss, velocity)
    every = _of_each(hands, count)
    for frame in range(1, len(hands)):
        solver.advance(every[frame - 1], every[frame])
        sums.add(frame)
        solver.go_on()
        if frame % LOOK_EVERY[device.partition(":")[0]] == 0 and not sums.present:
            break
    return [
        Outcome(math.inf if left else cost, left, overflow)
        for cost, left, overflow in zip(sums.costs(len(hands) - 1), sums.left, solver.overflows, strict=True)
    ]


def motions(twins: Sequence[Twin], hands: torch.Tensor, velocity: torch.Tensor, device: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions, m, and velocities, m/s, [T - 1, B, N, 3] at the end of each frame of rollouts over hands [T, C, 3], or
    [T, B, C, 3] of each twin, on the CPU."""
    solver, count = solver_for(twins, device, differentiable=False), len(twins)
    nodes = torch.tensor(twins[0].topology.nodes, device=device)
    solver.start(nodes.expand(count, -1, -1), velocity.expand(count, -1, -1))
    every = _of_each(hands, count)
    kept: dict[str, list[torch.Tensor]] = {"x": [], "v": []}
    for frame in range(1, len(hands)):
        solver.advance(every[frame - 1], every[frame])
        for name, states in kept.items():
            states.append(solver.buffers.get_vectors(name, solver.last, solver.nodes).cpu())
        solver.go_on()
    return torch.stack(kept["x"]), torch.stack(kept["v"])


def _of_each(hands: torch.Tensor, twins: int) -> torch.Tensor:
    """Hands [T, B, C, k] of each twin, if all share [T, C, k]."""
    return hands if hands.dim() == 4 else hands[:, None].expand(-1, twins, -1, -1)


class LossSums:
    """The sums of a population's losses, on its device."""

    def __init__(self, solver: FrameSolver, loss: FrameLoss, velocity: torch.Tensor) -> None:
        b = self._buffers = solver.buffers
        self._solver, self._loss = solver, loss
        self._kernels = Kernels(*(load(kernel, b.device) for kernel in kernels(b.width)))
        b.add_vectors(before=(b.nodes,), change=(b.nodes,))
        b.set_vectors("before", velocity.expand(b.twins, -1, -1))
        points = loss.points.shape[1]
        b.add_numbers(chamfer=points, track=points, acceleration=b.nodes, gone=None)
        self._total = torch.zeros((b.groups, b.width), dtype=torch.float64, device=b.device)
        self._view = wp.from_torch(self._total, dtype=wp.types.vector(b.width, wp.float64))
        self._points = wp.from_torch(loss.points.contiguous(), dtype=wp.vec3)
        self._visible, self._valid = (
            wp.from_torch(flags.to(torch.int32).contiguous()) for flags in (loss.visible, loss.motion_valid)
        )
        self._counts = loss.counts()
        self._images = torch.zeros(b.twins, dtype=torch.float64, device=b.device)

    def add(self, frame: int) -> None:
        """Add the loss of a frame, whose end the solver holds."""
        b, k, views = self._buffers, self._kernels, self._buffers.views
        points, slot, weights = self._points.shape[1], self._solver.last, self._loss.weights
        visible, valid = self._counts[frame]
        x, v = views["x"], views["v"]
        b.launch(k.nearest, (points, b.groups), x, slot, self._loss.surface, self._points, self._visible, frame, views["chamfer"])
        b.launch(k.tracked, (points, b.groups), x, slot, self._points, self._valid, frame, views["track"])
        b.launch(k.smooth, (b.nodes, b.groups), v, slot, frame, views["before"], views["change"], views["acceleration"])
        for name, size, weight in (
            ("chamfer", points, weights.chamfer / max(visible, 1)),
            ("track", points, weights.track / (3 * max(valid, 1))),
            ("acceleration", b.nodes, weights.acceleration / (3 * b.nodes)),
        ):
            b.launch(k.total, b.groups, views[name], size, weight, self._view)
        if self._loss.image:
            # One twin at a time, so that its sum does not depend on its company.
            for twin, nodes in enumerate(b.get_vectors("x", slot, b.nodes)):
                terms = self._loss.image.terms(frame, nodes).values()
                self._images[twin] += sum(term.double() for term in terms)
        b.launch(k.look, b.groups, x, slot, b.nodes, float(frame), views["gone"])

    def costs(self, frames: int) -> list[float]:
        """Mean loss of `frames` frames, of each twin."""
        totals = self._total.reshape(-1)[: self._buffers.twins] + self._images
        return [float(total) / frames for total in totals.cpu()]

    @property
    def left(self) -> list[int]:
        """The frame in which each twin left the scene; 0 if it did not."""
        return [int(frame) for frame in self._buffers.tensors["gone"].reshape(-1)[: self._buffers.twins].cpu()]

    @property
    def present(self) -> bool:
        """Whether any twin is in the scene."""
        return not bool(self._buffers.tensors["gone"].all())
