"""Rollouts of several candidates at once, and their training losses (losses.py) without gradients.

All states stay in the solver's buffers, in lanes. After each frame, kernels add its loss to the sum of each twin and record the
frame in which a twin leaves the scene. losses.py computes terms without a kernel, twin by twin. Sums are in float64, in the order
of points and nodes, so on a CPU the cost of a twin does not depend on its batch, bit for bit. Rollouts on several recordings, of
one or several scenes, may share launches.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import torch
import warp as wp

from neuspring.core.artifacts import Twin
from neuspring.core.device import load
from neuspring.physics.lanes import lanes
from neuspring.physics.solver import FrameSolver, narrowing_solver
from neuspring.physics.union import Union
from neuspring.twin.losses import FrameLoss
from neuspring.twin.rollout import FAR_AWAY

CHECK_EVERY = {"cpu": 1, "cuda": 16}
"""Frames between two checks whether all twins have diverged; on CUDA each check synchronizes."""
ON_LANES = ("chamfer", "track", "acceleration")
"""Terms with a kernel."""


@dataclass(frozen=True)
class Outcome:
    """The result of a candidate's rollout."""

    cost: float
    """Mean training loss over frames 1 .. train_end - 1, m^2, acceleration included; infinite if a node left the scene."""
    diverged_frame: int
    """The frame in which a node left the scene; 0 if none did."""
    collision_overflow: int


@dataclass(frozen=True, eq=False)
class Rollouts:
    """Twins with the same nodes, to roll out on a recording.

    - hands: positions of the controllers [T, C, 3], m, or `controllers.waypoints` of these
    - velocity: in frame 0 [N, 3], m/s
    - loss: training loss, whose frames determine the cost
    """

    twins: Sequence[Twin]
    hands: torch.Tensor
    velocity: torch.Tensor
    loss: FrameLoss


def rolled(batches: Sequence[Rollouts], device: str) -> list[list[Outcome]]:
    """Roll out several `Rollouts` with shared launches; return the outcomes of each.

    All twins have the same physics. If they are of several scenes, controllers must hold in all frames.
    """
    twins = [twin for rollouts in batches for twin in rollouts.twins]
    solver = narrowing_solver(twins, device)
    firsts = accumulate((len(rollouts.twins) for rollouts in batches), initial=0)
    losses = [
        LossSums(solver, rollouts.loss, rollouts.velocity, slice(first, first + len(rollouts.twins)))
        for rollouts, first in zip(batches, firsts, strict=False)
    ]
    for frame in _frames(solver, batches, max(len(rollouts.hands) for rollouts in batches)):
        for rollouts, sums in zip(batches, losses, strict=True):
            if frame < len(rollouts.hands):
                sums.add(frame)
        if frame % CHECK_EVERY[device.partition(":")[0]] == 0 and all(sums.ended for sums in losses):
            break
    return [sums.result(len(rollouts.hands) - 1) for rollouts, sums in zip(batches, losses, strict=True)]


def _frames(solver: FrameSolver, batches: Sequence[Rollouts], count: int) -> Iterator[int]:
    """Simulate frames 1, 2, ...; yield each while the solver contains its end. Controllers of shorter recordings then rest."""
    union = Union([twin.topology for rollouts in batches for twin in rollouts.twins])
    nodes = [torch.tensor(rollouts.twins[0].topology.nodes, device=solver.device) for rollouts in batches for _ in rollouts.twins]
    velocities = [rollouts.velocity for rollouts in batches for _ in rollouts.twins]
    solver.start(union.of_nodes(nodes, places=True), union.of_nodes(velocities))
    padded = [torch.cat([r.hands, r.hands[-1:].expand(count - len(r.hands), -1, -1)]) for r in batches]
    hands = union.of_controllers([path for rollouts, path in zip(batches, padded, strict=True) for _ in rollouts.twins])
    for frame in range(1, count):
        solver.advance(hands[frame - 1], hands[frame])
        yield frame
        solver.go_on()


class LossSums:
    """The sums of the losses of some or all twins of a solver, on its device."""

    def __init__(self, solver: FrameSolver, loss: FrameLoss, velocity: torch.Tensor, twins: slice = slice(None)) -> None:
        b = self._buffers = solver.buffers.part(twins)
        self._solver, self._loss, self._twins = solver, loss, twins
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
        """Add the loss of a frame, whose end the solver contains."""
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
            # Twin by twin, so that a sum does not depend on the batch.
            for twin, nodes in enumerate(b.get_vectors("x", slot, b.nodes)):
                terms = self._loss.terms(frame, nodes, without=ON_LANES).values()
                self._other_terms[twin] += sum(term.double() for term in terms)
        b.launch(check_divergence, b.groups, x, slot, b.nodes, float(frame), views["diverged"])

    @property
    def diverged(self) -> torch.Tensor:
        """The frame in which each twin left the scene; 0 if it did not."""
        return self._buffers.of_twins(self._buffers.tensors["diverged"].reshape(-1))

    @property
    def ended(self) -> bool:
        """True if all twins have left the scene."""
        return bool(self.diverged.all())

    def result(self, frames: int) -> list[Outcome]:
        """The outcome of each twin after `frames` frames."""
        totals = self._buffers.of_twins(self._total.reshape(-1)) + self._other_terms
        ends = zip(totals.tolist(), self.diverged.tolist(), self._solver.overflows[self._twins], strict=True)
        return [Outcome(math.inf if frame else total / frames, int(frame), overflow) for total, frame, overflow in ends]


@functools.cache
def kernels(width: int) -> list[Any]:
    """Kernels in float32 for a number of lanes:

    nearest           squared distance of each visible point to the nearest surface node
    tracked           smooth-L1 between each tracked point and its node, summed over axes
    smooth            smooth-L1 between consecutive velocity changes of each node, summed over axes
    total             adds a weighted sum to each twin's cost
    check_divergence  records the first frame in which a twin has left the scene
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
    far, huge = wp.float32(FAR_AWAY), Number(*[3e38] * width)
    half, one = 0.5, 1.0

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
                    # NaN also counts as too far.
                    if not (wp.abs(x[slot, i, g][row, q]) < far):
                        largest[q] = one
        for q in range(width):
            if largest[q] > 0.0 and diverged[g][q] == 0.0:
                frames = diverged[g]
                frames[q] = frame
                diverged[g] = frames

    unique = wp.kernel(module="unique", enable_backward=False)
    return [unique(kernel) for kernel in (nearest, tracked, smooth, total, check_divergence)]
