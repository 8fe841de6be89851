"""Rollouts of several candidates at once, and their training losses (losses.py) without gradients.

Everything stays in the solver's buffers, in lanes: after each frame kernels add the frame's loss to each twin's sum, and note the
frame in which a twin leaves the scene. Terms without a kernel here come from losses.py, twin by twin. Sums go through points and
nodes in order, in float64, so that a twin's cost does not depend on its batch, bit for bit on a CPU.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp

from neuspring.core.artifacts import Twin
from neuspring.core.device import load
from neuspring.physics.lanes import lanes
from neuspring.physics.solver import FrameSolver, narrowing_solver, solver_for
from neuspring.twin.losses import FrameLoss
from neuspring.twin.rollout import FAR_AWAY

CHECK_EVERY = {"cpu": 1, "cuda": 16}
"""Frames from one look for twins that all diverged to the next; on CUDA each check synchronizes."""
ON_LANES = ("chamfer", "track", "acceleration")
"""Terms that have a kernel."""


@dataclass(frozen=True)
class Outcome:
    """The end of a candidate's rollout."""

    cost: float
    """Mean training loss over frames 1 .. train_end - 1, m^2, acceleration included; infinite if it left the scene."""
    diverged_frame: int
    """The frame in which a node left the scene; 0 if none did."""
    collision_overflow: int


def outcomes(twins: Sequence[Twin], hands: torch.Tensor, velocity: torch.Tensor, loss: FrameLoss, device: str) -> list[Outcome]:
    """Roll twins of the same nodes out from velocity [N, 3], m/s, and judge the frames that the loss holds.

    hands are the controllers' positions [T, C, 3], or `controllers.waypoints` of them.
    """
    solver = narrowing_solver(twins, device)
    sums = LossSums(solver, loss, velocity)
    for frame in _frames(solver, twins, hands, velocity):
        sums.add(frame)
        if frame % CHECK_EVERY[device.partition(":")[0]] == 0 and bool(sums.diverged.all()):
            break
    return [
        Outcome(math.inf if frame else cost, int(frame), overflow)
        for cost, frame, overflow in zip(sums.costs(len(hands) - 1), sums.diverged.tolist(), solver.overflows, strict=True)
    ]


def motions(twins: Sequence[Twin], hands: torch.Tensor, velocity: torch.Tensor, device: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions, m, and velocities, m/s, [T - 1, B, N, 3] at the end of each frame of rollouts over hands [T, C, 3], on the CPU."""
    solver = solver_for(twins, device, differentiable=False)
    kept: dict[str, list[torch.Tensor]] = {"x": [], "v": []}
    for _ in _frames(solver, twins, hands, velocity):
        for name, states in kept.items():
            states.append(solver.buffers.get_vectors(name, solver.last, solver.nodes).cpu())
    return torch.stack(kept["x"]), torch.stack(kept["v"])


def _frames(solver: FrameSolver, twins: Sequence[Twin], hands: torch.Tensor, velocity: torch.Tensor) -> Iterator[int]:
    """Simulate frame after frame: 1, 2, ... while the solver holds its end."""
    count = len(twins)
    nodes = torch.tensor(twins[0].topology.nodes, device=solver.device)
    solver.start(nodes.expand(count, -1, -1), velocity.expand(count, -1, -1))
    every = hands[:, None].expand(-1, count, -1, -1)
    for frame in range(1, len(hands)):
        solver.advance(every[frame - 1], every[frame])
        yield frame
        solver.go_on()


class LossSums:
    """The sums of a population's losses, on its device."""

    def __init__(self, solver: FrameSolver, loss: FrameLoss, velocity: torch.Tensor) -> None:
        b = self._buffers = solver.buffers
        self._solver, self._loss = solver, loss
        self._kernels = [load(kernel, b.device) for kernel in kernels(b.width)]
        b.add_vectors(before=(b.nodes,), change=(b.nodes,))
        b.set_vectors("before", velocity.expand(b.twins, -1, -1))
        points = loss.points.shape[1]
        b.add_numbers(chamfer=points, track=points, acceleration=b.nodes, diverged=None)
        self._total = torch.zeros((b.groups, b.width), dtype=torch.float64, device=b.device)
        self._view = wp.from_torch(self._total, dtype=wp.types.vector(b.width, wp.float64))
        self._points = wp.from_torch(loss.points.contiguous(), dtype=wp.vec3)
        self._visible, self._valid = (
            wp.from_torch(flags.to(torch.int32).contiguous()) for flags in (loss.visible, loss.motion_valid)
        )
        self._others = [name for name in loss.names if name not in ON_LANES]
        self._other_terms = torch.zeros(b.twins, dtype=torch.float64, device=b.device)

    def add(self, frame: int) -> None:
        """Add the loss of a frame, whose end the solver holds."""
        b, views = self._buffers, self._buffers.views
        nearest, tracked, smooth, total, check_divergence = self._kernels
        points, slot, weights = self._points.shape[1], self._solver.last, self._loss.weights
        visible, valid = self._loss.counts[frame]
        x, v = views["x"], views["v"]
        b.launch(nearest, (points, b.groups), x, slot, self._loss.surface, self._points, self._visible, frame, views["chamfer"])
        b.launch(tracked, (points, b.groups), x, slot, self._points, self._valid, frame, views["track"])
        b.launch(smooth, (b.nodes, b.groups), v, slot, frame, views["before"], views["change"], views["acceleration"])
        for name, size, weight in (
            ("chamfer", points, weights.chamfer / max(visible, 1)),
            ("track", points, weights.track / (3 * max(valid, 1))),
            ("acceleration", b.nodes, weights.acceleration / (3 * b.nodes)),
        ):
            b.launch(total, b.groups, views[name], size, weight, self._view)
        if self._others:
            # One twin at a time, so that its sum does not depend on its batch.
            for twin, nodes in enumerate(b.get_vectors("x", slot, b.nodes)):
                terms = self._loss.terms(frame, nodes, without=ON_LANES).values()
                self._other_terms[twin] += sum(term.double() for term in terms)
        b.launch(check_divergence, b.groups, x, slot, b.nodes, float(frame), views["diverged"])

    def costs(self, frames: int) -> list[float]:
        """Mean loss of `frames` frames, of each twin."""
        totals = self._total.reshape(-1)[: self._buffers.twins] + self._other_terms
        return [float(total) / frames for total in totals.cpu()]

    @property
    def diverged(self) -> torch.Tensor:
        """The frame in which each twin left the scene; 0 if it did not."""
        return self._buffers.tensors["diverged"].reshape(-1)[: self._buffers.twins]


@functools.cache
def kernels(width: int) -> list[Any]:
    """Kernels in float32 for a number of lanes:

    nearest           squared distance of each visible point to the nearest surface node
    tracked           smooth-L1 between each tracked point and its node, summed over axes
    smooth            smooth-L1 between consecutive velocity changes of each node, summed over axes
    total             add a weighted sum to each twin's cost
    check_divergence  note the first frame in which a twin is out of the scene
    """
    lane = lanes(wp.float32, width)
    Number, Vector, dot = lane.Number, lane.Vector, lane.dot
    Total = wp.types.vector(width, wp.float64)
    of_twin: Any = wp.array(dtype=Number)
    totals: Any = wp.array(dtype=Total)
    numbers: Any = wp.array2d(dtype=Number)
    vectors: Any = wp.array2d(dtype=Vector)
    slots: Any = wp.array3d(dtype=Vector)
    targets: Any = wp.array2d(dtype=wp.vec3)
    flags: Any = wp.array2d(dtype=wp.int32)
    far, huge = wp.constant(wp.float32(FAR_AWAY)), wp.constant(Number(*[3e38] * width))
    half, one = wp.constant(0.5), wp.constant(1.0)

    @wp.func
    def everywhere(p: wp.vec3) -> Vector:
        x = Number()
        y = Number()
        z = Number()
        for q in range(width):
            x[q] = p[0]
            y[q] = p[1]
            z[q] = p[2]
        return wp.matrix_from_rows(x, y, z)

    @wp.func
    def smooth_l1(a: Number) -> Number:
        """0.5 a^2 below 1, |a| - 0.5 beyond."""
        result = Number()
        for q in range(width):
            size = wp.abs(a[q])
            result[q] = wp.where(size < one, half * a[q] * a[q], size - half)
        return result

    def nearest(x: slots, slot: int, surface: int, points: targets, visible: flags, frame: int, result: numbers):
        p, g = wp.tid()
        least = Number()
        if visible[frame, p] != 0:
            place = everywhere(points[frame, p])
            least = huge
            for j in range(surface):
                offset = x[slot, j, g] - place
                distance = dot(offset, offset)
                for q in range(width):
                    least[q] = wp.min(least[q], distance[q])
        result[p, g] = least

    def tracked(x: slots, slot: int, points: targets, valid: flags, frame: int, result: numbers):
        p, g = wp.tid()
        total = Number()
        if valid[frame - 1, p] != 0:
            offset = x[slot, p, g] - everywhere(points[frame, p])
            total = smooth_l1(offset[0]) + smooth_l1(offset[1]) + smooth_l1(offset[2])
        result[p, g] = total

    def smooth(v: slots, slot: int, frame: int, before: vectors, change: vectors, result: numbers):
        i, g = wp.tid()
        now = v[slot, i, g] - before[i, g]
        total = Number()
        if frame > 1:
            jerk = now - change[i, g]
            total = smooth_l1(jerk[0]) + smooth_l1(jerk[1]) + smooth_l1(jerk[2])
        before[i, g] = v[slot, i, g]
        change[i, g] = now
        result[i, g] = total

    def total(values: numbers, size: int, weight: wp.float64, result: totals):
        g = wp.tid()
        sum = Total()
        for k in range(size):
            for q in range(width):
                sum[q] = sum[q] + wp.float64(values[k, g][q])
        result[g] = result[g] + sum * weight

    def check_divergence(x: slots, slot: int, nodes: int, frame: float, diverged: of_twin):
        g = wp.tid()
        largest = Number()
        for i in range(nodes):
            for q in range(width):
                for row in range(3):
                    # Not a number is not near either.
                    if not (wp.abs(x[slot, i, g][row, q]) < far):
                        largest[q] = one
        for q in range(width):
            if largest[q] > 0.0 and diverged[g][q] == 0.0:
                frames = diverged[g]
                frames[q] = frame
                diverged[g] = frames

    unique = wp.kernel(module="unique", enable_backward=False)
    return [unique(kernel) for kernel in (nearest, tracked, smooth, total, check_divergence)]
