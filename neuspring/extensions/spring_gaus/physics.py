"""Anchors and their motion: the forces, one substep and its adjoint as kernels, and frames of substeps.

Let d = |x_j - x_i|, n = (x_j - x_i) / d, strain e = d / l - 1 and r the rank of neighbor j by distance in frame 0. The forces on
anchor i are

    spring   (s_i / l) eta_r (d - l) (1 + |e|)^p n       (zero where |d - l| < 1e-6 m)
    damping  (zeta / l) ((v_j - v_i) . n) n
    control  c (|q - x_i| / L - 1) (q - x_i) / |q - x_i|  from each linked controller q
    gravity  at unit mass

Springs are directed: unlike those of `neuspring.physics.springs`, they exert no force on j. Integration is semi-implicit. After a
step, anchors at or below the ground are put on it: their velocity along z becomes zero, and their velocity along the ground is
multiplied by phi.
"""
# This module does not postpone annotations: Warp needs the evaluated types of the closures below.

import functools
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
import warp as wp
from scipy.spatial import cKDTree

from neuspring.core.artifacts import Artifact, array
from neuspring.core.device import start_warp
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.physics.arrays import Graphs
from neuspring.physics.solver import simulate_frame

LINK_COUNT, LINK_REACH = 50, 0.04
"""Maximum number of anchors linked to a controller, and their maximum distance in frame 0, m."""
SHORTEST_LINK = 1e-4
"""Minimum rest length of controller links, m: a controller may be at the position of an anchor."""
SLACK = 1e-6
"""Elongations below this exert no force, m."""
MIN_ANCHOR_LENGTH = 1e-6
"""Minimum length in directions, m."""
PACKED = ("stiffness", "soft", "scalars")
"""Arguments of the kernels with trained parameters; scalars are damping and friction."""


@dataclass(frozen=True, kw_only=True)
class AnchorGraph(Artifact):
    """The directed springs and links of each anchor: row i has the springs that pull anchor i."""

    kind: ClassVar[str] = "anchor_graph"
    anchors: np.ndarray = array("N,3", np.float32, "m", "positions in frame 0")
    neighbors: np.ndarray = array("N,K", np.int32, "1", "the K nearest other anchors, nearest first")
    lengths: np.ndarray = array("N,K", np.float32, "m", "rest lengths: distances to the neighbors in frame 0")
    link_starts: np.ndarray = array("L", np.int32, "1", "links of anchor i: link_starts[i] to link_starts[i + 1]")
    links: np.ndarray = array("M", np.int32, "1", "controller of each link")
    link_lengths: np.ndarray = array("M", np.float32, "m", "rest lengths of links")

    def check(self) -> None:
        anchors = len(self.anchors)
        if len(self.link_starts) != anchors + 1:
            raise InputError("spring_gaus.link_starts", f"{anchors + 1} entries are required", len(self.link_starts))
        if self.neighbors.size and not 0 <= self.neighbors.min() <= self.neighbors.max() < anchors:
            raise InputError("spring_gaus.neighbors", f"indices must be in [0, {anchors})", int(self.neighbors.max()))
        if (self.lengths <= 0).any() or (self.link_lengths <= 0).any():
            raise InputError("spring_gaus.lengths", "every rest length must be positive", "0 or less")

    @classmethod
    def between(cls, anchors: np.ndarray, controllers: np.ndarray, neighbors: int) -> "AnchorGraph":
        """The graph of anchors [N, 3] and controllers [C, 3] in frame 0, m.

        Raises NumericalFailure for too few anchors, or if two anchors have the same position.
        """
        if len(anchors) <= neighbors:
            raise NumericalFailure(f"more anchors than neighbors ({neighbors}) are required; received {len(anchors)}")
        tree = cKDTree(anchors)
        distance, index = tree.query(anchors, k=neighbors + 1)
        if distance[:, 1].min() <= 0:
            raise NumericalFailure(f"anchor {int(distance[:, 1].argmin())} has the position of another anchor")
        link_distance, near = tree.query(controllers, k=min(LINK_COUNT, len(anchors)), distance_upper_bound=LINK_REACH)
        link_distance, near = link_distance.reshape(len(controllers), -1), near.reshape(len(controllers), -1)
        controller, slot = np.nonzero(np.isfinite(link_distance))
        anchor, length = near[controller, slot], np.maximum(link_distance[controller, slot], SHORTEST_LINK)
        order = np.lexsort((controller, anchor))
        return AnchorGraph(
            anchors=anchors,
            # The nearest is the anchor itself, because all other distances are positive.
            neighbors=index[:, 1:],
            lengths=distance[:, 1:],
            link_starts=np.searchsorted(anchor[order], np.arange(len(anchors) + 1)),
            links=controller[order],
            link_lengths=length[order],
        )


@dataclass(frozen=True, kw_only=True)
class AnchorPhysics:
    """Constants of the motion, which are not trained."""

    frame_time: float
    """Time per frame, s."""
    exponent: float = 0.5
    """p in (1 + |e|)^p."""
    link_stiffness: float = 3e4
    """Stiffness c of the controllers' links, N per unit strain, at 1 kg."""
    gravity: float = 9.8
    """Downward acceleration, m/s^2."""
    up_sign: float = 1.0
    """+1 if +z is up, -1 if -z is up."""
    ground: bool = True
    """Whether the plane z = 0 is the ground."""


@dataclass(frozen=True)
class AnchorParameters:
    """The trained values that forces use, at 1 kg per anchor."""

    stiffness: torch.Tensor
    """Stiffness s_i = 10^kappa [N], N."""
    soft: torch.Tensor
    """Soft vector eta by rank [K]."""
    damping: torch.Tensor
    """zeta, N s; divided by a spring's rest length it is the constant of its dashpot."""
    friction: torch.Tensor
    """phi: the fraction of the velocity along the ground that remains after each substep."""


class AnchorKernels(NamedTuple):
    """Kernels over [N] anchors and the types of their arguments, for one scalar type."""

    substep: Any
    adjoint: Any
    State: Any
    Model: Any


@functools.cache
def kernels(real: Any) -> AnchorKernels:
    """Kernels for the scalar type `real`, wp.float32 or wp.float64."""
    vec3 = wp.types.vector(3, real)
    slack, floor = real(SLACK), real(MIN_ANCHOR_LENGTH)
    zero, one = real(0.0), real(1.0)

    @wp.struct
    class State:
        x: wp.array2d(dtype=vec3)  # [substeps + 1, N]
        v: wp.array2d(dtype=vec3)
        stiffness: wp.array(dtype=real)  # [N]
        soft: wp.array(dtype=real)  # [K]
        scalars: wp.array(dtype=real)  # zeta, phi

    @wp.struct
    class Model:
        neighbors: wp.array2d(dtype=wp.int32)
        lengths: wp.array2d(dtype=real)
        link_starts: wp.array(dtype=wp.int32)
        links: wp.array(dtype=wp.int32)
        link_lengths: wp.array(dtype=real)
        begin: wp.array(dtype=vec3)  # controllers at the start of the frame
        end: wp.array(dtype=vec3)
        exponent: real
        link_stiffness: real
        substep: real
        gravity: real
        up: real
        ground: int

    def anchor_substep(slot: int, fraction: real, state: State, model: Model):
        i = wp.tid()
        at = state.x[slot, i]
        speed = state.v[slot, i]
        force = vec3(zero, zero, model.gravity)
        for r in range(model.neighbors.shape[1]):
            j = model.neighbors[i, r]
            rest = model.lengths[i, r]
            offset = state.x[slot, j] - at
            length = wp.length(offset)
            n = offset / wp.max(length, floor)
            stretch = length - rest
            pull = state.scalars[0] / rest * wp.dot(state.v[slot, j] - speed, n)
            if wp.abs(stretch) >= slack:
                pull += state.stiffness[i] / rest * state.soft[r] * stretch * wp.pow(one + wp.abs(stretch) / rest, model.exponent)
            force += n * pull
        for k in range(model.link_starts[i], model.link_starts[i + 1]):
            c = model.links[k]
            reach = model.begin[c] * (one - fraction) + model.end[c] * fraction - at
            distance = wp.length(reach)
            force += reach / wp.max(distance, floor) * (model.link_stiffness * (distance / model.link_lengths[k] - one))
        moved = speed + force * model.substep
        target = at + moved * model.substep
        if model.ground != 0 and model.up * target[2] <= zero:
            target = vec3(target[0], target[1], zero)
            moved = vec3(moved[0] * state.scalars[1], moved[1] * state.scalars[1], zero)
        state.x[slot + 1, i] = target
        state.v[slot + 1, i] = moved

    def anchor_substep_adjoint(slot: int, fraction: real, state: State, model: Model, adjoint: State):
        i = wp.tid()
        at = state.x[slot, i]
        speed = state.v[slot, i]
        to = adjoint.x[slot + 1, i]
        by = adjoint.v[slot + 1, i]
        # Only the ground sets a height to exactly 0.
        if model.ground != 0 and state.x[slot + 1, i][2] == zero:
            # Along the ground the step is x + h u. Positions give u, because phi may be 0.
            u = (state.x[slot + 1, i] - at) / model.substep
            wp.atomic_add(adjoint.scalars, 1, by[0] * u[0] + by[1] * u[1])
            to = vec3(to[0], to[1], zero)
            by = vec3(by[0] * state.scalars[1], by[1] * state.scalars[1], zero)
        by += to * model.substep
        c = by * model.substep
        damping = zero
        hard = zero
        for r in range(model.neighbors.shape[1]):
            j = model.neighbors[i, r]
            rest = model.lengths[i, r]
            offset = state.x[slot, j] - at
            length = wp.max(wp.length(offset), floor)
            n = offset / length
            stretch = length - rest
            relative = state.v[slot, j] - speed
            closing = wp.dot(relative, n)
            cn = wp.dot(c, n)
            dashpot = state.scalars[0] / rest
            pull = dashpot * closing
            slope = zero
            if wp.abs(stretch) >= slack:
                strain = wp.abs(stretch) / rest
                grown = wp.pow(one + strain, model.exponent)
                unit = stretch / rest * grown
                spring = state.stiffness[i] * state.soft[r]
                pull += spring * unit
                slope = spring / rest * grown * (one + model.exponent * strain / (one + strain))
                hard += cn * state.soft[r] * unit
                wp.atomic_add(adjoint.soft, r, cn * state.stiffness[i] * unit)
            damping += cn * closing / rest
            # Gradients of the direction (c and the relative velocity, without their components along n) and of the length.
            g = (c - n * cn) * (pull / length) + (relative - n * closing) * (dashpot * cn / length) + n * (cn * slope)
            w = n * (cn * dashpot)
            wp.atomic_add(adjoint.x, slot, j, g)
            wp.atomic_add(adjoint.v, slot, j, w)
            to -= g
            by -= w
        for k in range(model.link_starts[i], model.link_starts[i + 1]):
            q = model.links[k]
            reach = model.begin[q] * (one - fraction) + model.end[q] * fraction - at
            distance = wp.max(wp.length(reach), floor)
            m = reach / distance
            cm = wp.dot(c, m)
            turn = model.link_stiffness * (one / model.link_lengths[k] - one / distance)
            to -= (c - m * cm) * turn + m * (cm * model.link_stiffness / model.link_lengths[k])
        wp.atomic_add(adjoint.x, slot, i, to)
        wp.atomic_add(adjoint.v, slot, i, by)
        wp.atomic_add(adjoint.scalars, 0, damping)
        adjoint.stiffness[i] = adjoint.stiffness[i] + hard

    unique = wp.kernel(module="unique", enable_backward=False)
    return AnchorKernels(unique(anchor_substep), unique(anchor_substep_adjoint), State, Model)


class AnchorSolver:
    """Advances anchors by frames with a fixed number of substeps. The forward and backward passes are captured graphs."""

    def __init__(
        self, graph: AnchorGraph, physics: AnchorPhysics, substeps: int, device: str = "cpu", dtype: torch.dtype = torch.float32
    ) -> None:
        start_warp()
        self.physics, self.substeps, self.device, self.dtype = physics, substeps, device, dtype
        self._real = real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
        self._kernels = kernels(real)
        vec3 = wp.types.vector(3, real)
        self.count, ranks = graph.neighbors.shape
        controllers = int(graph.links.max(initial=-1)) + 1
        self._buffers: dict[str, torch.Tensor] = {}
        self._state, self._adjoint, self._model = self._kernels.State(), self._kernels.State(), self._kernels.Model()
        for struct, prefix in ((self._state, ""), (self._adjoint, "adj_")):
            for name in ("x", "v"):
                setattr(struct, name, self._allocate(prefix + name, (substeps + 1, self.count, 3), vec3))
            for name, size in zip(PACKED, (self.count, ranks, 2), strict=True):
                setattr(struct, name, self._allocate(prefix + name, (size,), real))
        for name in ("begin", "end"):
            setattr(self._model, name, self._allocate(name, (controllers, 3), vec3))
        for name in ("neighbors", "lengths", "link_starts", "links", "link_lengths"):
            values = getattr(graph, name)
            kind = wp.int32 if values.dtype.kind == "i" else real
            setattr(self._model, name, wp.array(values, dtype=kind, device=device))
        self._model.exponent, self._model.link_stiffness = physics.exponent, physics.link_stiffness
        self._model.substep = physics.frame_time / substeps
        self._model.gravity, self._model.up = -physics.up_sign * physics.gravity, physics.up_sign
        self._model.ground = int(physics.ground)
        self._graphs = Graphs(device)
        self.frame_token = 0
        """Number of the frame whose substeps are in the buffers."""

    def holding(self, token: int) -> Any:
        """This solver, if the substeps of that frame are in the buffers."""
        return self if token == self.frame_token else None

    def _allocate(self, name: str, shape: tuple[int, ...], kind: Any) -> Any:
        self._buffers[name] = torch.zeros(shape, dtype=self.dtype, device=self.device)
        return wp.from_torch(self._buffers[name], dtype=kind)

    def frame(
        self, parameters: AnchorParameters, x: torch.Tensor, v: torch.Tensor, begin: torch.Tensor, end: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(x, v) [N, 3] after one frame, differentiable in x, v and parameters; controllers [C, 3] move from `begin` to `end`."""
        scalars = torch.stack([parameters.damping.reshape(()), parameters.friction.reshape(())])
        packed = {"stiffness": parameters.stiffness, "soft": parameters.soft, "scalars": scalars}
        return simulate_frame(self, packed, x, v, begin, end)

    def run(
        self, begin: torch.Tensor, end: torch.Tensor, x: torch.Tensor, v: torch.Tensor, parameters: dict[str, torch.Tensor]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(x, v) after a frame, with the parameters of the kernels (`PACKED`)."""
        b = self._buffers
        for name in PACKED:
            b[name].copy_(parameters[name])
        # Controllers after the last linked controller do not matter.
        b["begin"].copy_(begin[: len(b["begin"])])
        b["end"].copy_(end[: len(b["end"])])
        b["x"][0], b["v"][0] = x, v
        self._launch(backward=False)
        self.frame_token += 1
        return b["x"][-1].clone(), b["v"][-1].clone()

    def backward(self, adj_x: torch.Tensor, adj_v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        """Adjoints of x, v and the parameters, by name, for the last forward frame."""
        b = self._buffers
        for name in ("x", "v", *PACKED):
            b[f"adj_{name}"].zero_()
        b["adj_x"][-1], b["adj_v"][-1] = adj_x, adj_v
        self._launch(backward=True)
        return b["adj_x"][0].clone(), b["adj_v"][0].clone(), {name: b[f"adj_{name}"].clone() for name in PACKED}

    def _launch(self, *, backward: bool) -> None:
        kernel = self._kernels.adjoint if backward else self._kernels.substep
        structs = (self._state, self._model, self._adjoint) if backward else (self._state, self._model)

        def record() -> None:
            for substep in reversed(range(self.substeps)) if backward else range(self.substeps):
                fraction = self._real((substep + 1) / self.substeps)
                wp.launch(kernel, self.count, [substep, fraction, *structs], device=self.device)

        self._graphs.run("backward" if backward else "forward", [kernel], record)
