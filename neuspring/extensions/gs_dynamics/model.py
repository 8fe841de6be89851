"""The model of GS-Dynamics: presets per kind of object, the graph, the network, the saved model and the rollout.

With receiver r and sender s of edge e, node states h, codes c and R = ReLU, all rounds share the weights and start from h = c_n:

    m_e = R(W_r [c_e, h_r, h_s]),    h' = R(W_p [c_n, sum_e m_e] + h).

A head maps the states of particles to displacements, m. Each block of W_r multiplies node states, and edges gather the products;
this gives the same sums as products of gathered states, with fewer operations.

The rollout is open-loop. Structure points make a step whenever the tools have moved by one step.
Each particle b has the rotation R_b that best maps the offsets to its neighbors in the graph (Kabsch). For neighbors on a line it
is the smallest rotation, without neighbors the identity. A point at x follows particles at b, which move by u_b, with weights
w_b ~ 1 / max(|x - b|, 0.1 mm):

    x' = x + sum_b w_b [(R_b - 1) (x - b) + u_b].
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, ClassVar, Literal

import numpy as np
import torch
import warp as wp
from torch.nn.functional import linear, relu
from torch.nn.utils import parameters_to_vector, skip_init, vector_to_parameters

from neuspring.baselines.results import DIVERGENCE_RADIUS, Prediction
from neuspring.core.artifacts import Artifact, Observations, Trajectory, Up, array
from neuspring.core.device import load, start_warp
from neuspring.core.errors import InputError
from neuspring.extensions.gs_dynamics.settings import GsDynamics
from neuspring.splats.skinning import turn_nodes
from neuspring.twin.rollout import left_scene

HISTORY = 3
"""Number H of steps in the network's input, including the current step."""
MESSAGE_ROUNDS = 3
"""Rounds of message passing, which share their weights."""
UP_AXIS = 2
"""Index of the up axis: +z is up in this module."""
PresetName = Literal["rope", "animals", "cloth"]
PRESET_COLUMNS = ("radius", "neighbors", "particles", "noise", "length_weight", "batch", "heights")
PRESETS: dict[PresetName, tuple[Any, ...]] = {
    "rope": (0.08, 5, 100, 0.003, 0.1, 16, False),
    "animals": (0.08, 6, 100, 0.003, 0.05, 64, True),
    "cloth": (0.075, 6, 150, 0.002, 0.1, 64, True),
}
"""The public configurations. Meanings as in `GsDynamicsTraining`."""
CLOTHS = ("cloth", "package")
COVERAGE = 0.03
"""Distance within which every point has a particle; no more particles are added then, m."""
MIN_PARTICLE_DISTANCE = 1e-4
"""Minimum distance in weights, m."""
HALF_TURN = np.array([1, -1, -1], dtype=np.float32)
"""A half turn about the x axis, which maps -z up to +z up and back without mirroring."""
# Layers start without weights: `initial` draws them, `of` sets them.
Linear = partial(skip_init, torch.nn.Linear)


@dataclass(frozen=True, kw_only=True)
class GsDynamicsTraining(GsDynamics):
    """The settings and the constants of the public code. None stands for the value of the preset of the object's category."""

    radius: float | None = None
    """Maximum length of an edge, m."""
    neighbors: int | None = None
    """Number k of nearest particles from which a particle receives messages, including itself."""
    particles: int | None = None
    """Maximum number of particles of a graph."""
    noise: float | None = None
    """Half width of the uniform noise that training adds to positions in the history, m."""
    length_weight: float | None = None
    """Weight lambda of the length loss."""
    outlier_deviations: float = 3.0
    """Maximum difference of a track's path length from the median, in median absolute deviations; 0 drops no track."""
    future: int = 5
    """Number F of consecutive steps that training predicts."""
    yaw: bool = True
    """Rotate each training window by a random angle about the vertical."""
    learning_rate: float = 1e-3
    """Adam's learning rate."""


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Settings of graphs and network inputs. A rollout needs them and the weights. Meanings are those of GsDynamicsTraining."""

    radius: float
    neighbors: int
    particles: int
    coverage: float
    width: int
    step: float
    heights: bool
    """Inputs of nodes include their heights and displacements in the history."""

    @property
    def node_size(self) -> int:
        """Inputs per node: kind 2, heights H, displacements 3 (H - 1), action 3."""
        return 5 + (4 * HISTORY - 3 if self.heights else 0)

    @property
    def edge_size(self) -> int:
        """Inputs per edge: kinds 2 + 2, difference of the kinds 1, receiver - sender 3 H."""
        return 5 + 3 * HISTORY


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Settings that only training needs. Meanings are those of GsDynamicsTraining."""

    noise: float
    yaw: bool
    length_weight: float
    batch: int


def preset_name(category: str) -> PresetName:
    """The preset of an object's category."""
    # Cables in motion capture are called DLO1, DLO2, ...
    if category == "rope" or category.startswith("DLO"):
        return "rope"
    return "cloth" if category in CLOTHS else "animals"


def resolve(settings: GsDynamicsTraining, category: str) -> tuple[Rules, Recipe]:
    """The settings of a model and of its training; the preset replaces every None."""
    values = dict(zip(PRESET_COLUMNS, PRESETS[preset_name(category)], strict=True))
    values |= {"coverage": COVERAGE} | {name: value for name, value in vars(settings).items() if value is not None}
    rules, recipe = ({field.name: values[field.name] for field in fields(kind)} for kind in (Rules, Recipe))
    return Rules(**rules), Recipe(**recipe)


@dataclass(frozen=True, eq=False)
class ParticleGraph:
    """Directed edges among nodes 0..N-1. Particles come first, then tools."""

    receivers: torch.Tensor
    """Receiving nodes [E], int64."""
    senders: torch.Tensor
    """Sending nodes [E], int64."""
    particles: int

    @property
    def among_particles(self) -> torch.Tensor:
        """Whether an edge connects two particles [E], bool."""
        return (self.receivers < self.particles) & (self.senders < self.particles)


def connect(points: torch.Tensor, used: torch.Tensor, tools: torch.Tensor, rules: Rules) -> ParticleGraph:
    """The graph of B windows with points [B, K, 3] and tools [B, C, 3], m. Points with used [B, K] are particles.

    - A particle receives from its k nearest particles within the radius, including itself.
    - A particle and a tool within the radius have edges in both directions.
    - Tools have no edges among each other, and windows have no edges in common.
    - Nodes are the particles of window 0, 1, ..., then the tools of window 0, 1, ...
    """
    count = int(used.sum())
    number = (used.flatten().cumsum(0) - 1).view(used.shape)
    # Matrix products would round the distance of a particle from itself, which must be 0.
    distances = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
    distances = distances.masked_fill(~used[:, None, :], torch.inf)
    distance, near = distances.topk(min(rules.neighbors, points.shape[1]), dim=2, largest=False)
    window, receiver, slot = ((distance < rules.radius) & used[:, :, None]).nonzero(as_tuple=True)
    receivers, senders = number[window, receiver], number[window, near[window, receiver, slot]]
    near_tools = torch.cdist(points, tools, compute_mode="donot_use_mm_for_euclid_dist") < rules.radius
    window, point, tool = (near_tools & used[:, :, None]).nonzero(as_tuple=True)
    particle_ends, tool_ends = number[window, point], count + window * tools.shape[1] + tool
    return ParticleGraph(torch.cat([receivers, particle_ends, tool_ends]), torch.cat([senders, tool_ends, particle_ends]), count)


def sample(
    points: torch.Tensor, usable: torch.Tensor, most: int, coverage: float, first: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Farthest-point samples of B clouds: indices [B, K] into points [B, M, 3], and which entries are used [B, K].

    A sample starts at point `first` [B] and adds the farthest usable [B, M] point, until it has `most` points or all points are
    within `coverage`, m. The result equals that of the two passes of the public code.
    """
    rows = torch.arange(len(points), device=points.device)
    distance = torch.where(usable, torch.inf, -torch.inf).to(points.dtype)
    indices, used = [first], [torch.ones_like(first, dtype=torch.bool)]
    while len(indices) < most:
        distance = torch.minimum(distance, (points - points[rows, indices[-1]][:, None]).norm(dim=2))
        farthest, index = distance.max(dim=1)
        uncovered = used[-1] & (farthest > coverage)
        if not bool(uncovered.any()):
            break
        indices.append(index)
        used.append(uncovered)
    return torch.stack(indices, dim=1), torch.stack(used, dim=1)


class Dynamics(torch.nn.Module):
    """The network. Its weights are one vector [W]: the parameters in order, with each matrix before its bias."""

    def __init__(self, rules: Rules) -> None:
        super().__init__()
        self.rules, width = rules, rules.width
        self.node, self.edge = _encoder(rules.node_size, width), _encoder(rules.edge_size, width)
        self.relation, self.particle = Linear(3 * width, width), Linear(2 * width, width)
        relu_layer = torch.nn.ReLU()
        self.head = torch.nn.Sequential(Linear(width, width), relu_layer, Linear(width, width), relu_layer, Linear(width, 3))

    @classmethod
    def of(cls, rules: Rules, weights: torch.Tensor) -> Dynamics:
        """The network with weights [W]; it has their device and dtype and shares their memory."""
        network = cls(rules).to(weights)
        vector_to_parameters(weights, network.parameters())
        return network

    @classmethod
    def initial(cls, rules: Rules, seed: int, device: str = "cpu") -> Dynamics:
        """The network with Torch's initial weights of linear layers: uniform in +- 1 / sqrt(inputs)."""
        generator = torch.Generator().manual_seed(seed)
        layers = [layer for layer in cls(rules).modules() if isinstance(layer, torch.nn.Linear)]
        draws = [
            (torch.rand(layer.out_features * (layer.in_features + 1), generator=generator) * 2 - 1) / layer.in_features**0.5
            for layer in layers
        ]
        return cls.of(rules, torch.cat(draws).to(device))

    @property
    def weights(self) -> torch.Tensor:
        """A copy of the weights [W], without gradient."""
        return parameters_to_vector(self.parameters()).detach()

    def forward(self, graph: ParticleGraph, history: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Displacements [P, 3] of particles, m, in the next step.

        history [H, N, 3], m, oldest first: positions of the nodes. action [N - P, 3], m: the tools' next displacements.
        """
        nodes = self.node(node_inputs(self.rules, graph, history, action))
        edges = self.edge(edge_inputs(graph, history))
        by_edge, by_receiver, by_sender = self.relation.weight.chunk(3, dim=1)
        by_code, by_sum = self.particle.weight.chunk(2, dim=1)
        edge_part, code_part = linear(edges, by_edge, self.relation.bias), linear(nodes, by_code, self.particle.bias)
        state = nodes
        for _ in range(MESSAGE_ROUNDS):
            received = linear(state, by_receiver).index_select(0, graph.receivers)
            messages = relu(edge_part + received + linear(state, by_sender).index_select(0, graph.senders))
            total = torch.zeros_like(state).index_add(0, graph.receivers, messages)
            state = relu(code_part + linear(total, by_sum) + state)
        displacements: torch.Tensor = self.head(state[: graph.particles])
        return displacements


def _encoder(inputs: int, width: int) -> torch.nn.Sequential:
    relu_layer = torch.nn.ReLU()
    layers = (Linear(inputs, width), Linear(width, width), Linear(width, width))
    return torch.nn.Sequential(*(module for layer in layers for module in (layer, relu_layer)))


def node_inputs(rules: Rules, graph: ParticleGraph, history: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """Inputs of nodes [N, `node_size`]: kind, optional heights and displacements of the history [H, N, 3], action.

    The action of particles is 0.
    """
    nodes = history.shape[1]
    parts = [_kinds(torch.arange(nodes, device=history.device) < graph.particles, history)]
    if rules.heights:
        parts += [history[:, :, UP_AXIS].T, history.diff(dim=0).transpose(0, 1).reshape(nodes, -1)]
    return torch.cat([*parts, torch.cat([action.new_zeros(graph.particles, 3), action])], dim=1)


def edge_inputs(graph: ParticleGraph, history: torch.Tensor) -> torch.Tensor:
    """Inputs of edges [E, `edge_size`]: both kinds, 1 between particle and tool, receiver - sender in each of H steps."""
    receives, sends = graph.receivers < graph.particles, graph.senders < graph.particles
    between = history.index_select(1, graph.receivers) - history.index_select(1, graph.senders)
    differs = (receives != sends).to(history.dtype)[:, None]
    offsets = between.transpose(0, 1).reshape(len(receives), -1)
    return torch.cat([_kinds(receives, history), _kinds(sends, history), differs, offsets], dim=1)


def _kinds(particle: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    return torch.stack([particle, ~particle], dim=1).to(like.dtype)


def weight_count(rules: Rules) -> int:
    """Length of the vector of weights."""
    return sum(parameter.numel() for parameter in Dynamics(rules).parameters())


@dataclass(frozen=True, kw_only=True)
class GsDynamicsModel(Artifact):
    """A trained model. It contains no object and moves the structure points of any scenario."""

    kind: ClassVar[str] = "gs_dynamics"
    weights: np.ndarray = array("W", np.float32, "1", "parameters of Dynamics in their order")
    rules: Rules

    def check(self) -> None:
        count = weight_count(self.rules)
        if len(self.weights) != count:
            raise InputError("gs_dynamics.weights", f"{count} weights are required", len(self.weights))

    def dynamics(self, device: str) -> Dynamics:
        """The network on a device."""
        return Dynamics.of(self.rules, torch.tensor(self.weights, device=device))


def predict(model: GsDynamicsModel, observations: Observations, splats: np.ndarray | None, device: str) -> Prediction:
    """Structure points in all frames, predicted from the points of frame 0 and the controllers only.

    For a transfer, the observations are those of the target and the model is that of the source. The published transfers started
    from the source's points, registered to the target. The model has no splats of its own.
    """
    up = observations.scenario.up
    tools = upright(observations.controller_points, up)
    frames, positions, counts, touched, reason, diverged = [0], [], [], [], "", None
    with torch.no_grad():
        dynamics = model.dynamics(device)
        start, hands = torch.tensor(upright(observations.nodes, up), device=device), torch.tensor(tools, device=device)
        positions.append(start)
        history, last = start.expand(HISTORY, -1, -1), [0] * HISTORY
        for frame in executed(tools, model.rules.step):
            after, particles, contacts = make_step(dynamics, history, hands[[*last, frame]])
            counts.append(particles)
            touched.append(contacts)
            if reason := left_scene(after, frame, DIVERGENCE_RADIUS):
                diverged = frame
                break
            frames.append(frame)
            positions.append(after)
            history, last = torch.cat([history[1:], after[None]]), [*last[1:], frame]
    end = len(tools) if diverged is None else diverged
    shown = upright(in_every_frame(frames, torch.stack(positions).cpu().numpy(), end), up)
    facts = {
        "executed_steps": len(frames) - 1,
        "tools": tools.shape[1],
        "particles": float(np.mean(counts)) if counts else 0.0,
        "tool_contacts": float(np.mean(touched)) if touched else 0.0,
    }
    return Prediction(Trajectory(positions=shown, frame_count=len(tools), diverged_frame=diverged, reason=reason), facts)


def make_step(dynamics: Dynamics, history: torch.Tensor, tools: torch.Tensor) -> tuple[torch.Tensor, int, int]:
    """Structure points [N, 3], m, after one step, from the history [H, N, 3] and tools [H + 1, C, 3], m.

    The last tools are those after the step. Returns also the numbers of particles and of contacts between particles and tools.
    """
    rules, now = dynamics.rules, history[-1]
    first = torch.zeros(1, dtype=torch.long, device=now.device)
    usable = torch.ones(1, len(now), dtype=torch.bool, device=now.device)
    indices = sample(now[None], usable, rules.particles, rules.coverage, first)[0][0]
    particles = history[:, indices]
    used = torch.ones(1, len(indices), dtype=torch.bool, device=now.device)
    graph = connect(particles[-1:], used, tools[-2:-1], rules)
    moves = dynamics(graph, torch.cat([particles, tools[:-1]], dim=1), tools[-1] - tools[-2])
    contacts = int((~graph.among_particles).sum()) // 2
    if not bool(torch.isfinite(moves).all()):
        return torch.full_like(now, torch.nan), len(indices), contacts
    after = carry(now, particles[-1], turns(graph, particles[-1], particles[-1] + moves), moves)
    return after, len(indices), contacts


def in_every_frame(steps: list[int], positions: np.ndarray, frames: int) -> np.ndarray:
    """Positions in all frames [frames, N, 3], m, from those in the frames `steps` [S, N, 3].

    Points move on straight lines between two steps, which only works offline, and rest after the last step.
    """
    given_frames, frame = np.array(steps), np.arange(frames)
    before = np.searchsorted(given_frames, frame, side="right") - 1
    after = np.minimum(before + 1, len(given_frames) - 1)
    span = np.maximum(given_frames[after] - given_frames[before], 1)
    fraction = ((frame - given_frames[before]) / span).astype(positions.dtype)[:, None, None]
    # This form is exact for equal positions.
    return np.asarray(positions[before] + fraction * (positions[after] - positions[before]))


def turns(graph: ParticleGraph, before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
    """Rotations [P, 3, 3] of particles that moved from `before` to `after` [P, 3], m."""
    start_warp()
    count, among = graph.particles, graph.among_particles
    receivers, senders = (ends[among].cpu().numpy() for ends in (graph.receivers, graph.senders))
    order = np.argsort(receivers, kind="stable")
    receivers, senders = receivers[order], senders[order]
    slot = np.arange(len(receivers)) - np.searchsorted(receivers, receivers)
    # Neighbors [P, k] of each particle. Empty slots contain the particle itself, whose offset is zero.
    neighbors = np.repeat(np.arange(count, dtype=np.int32)[:, None], int(slot.max(initial=0)) + 1, axis=1)
    neighbors[receivers, slot] = senders
    # With a hundred particles the CPU is as fast as any device.
    arrays = [points.cpu().numpy().astype(np.float32) for points in (before, after)]
    positions: list[Any] = [wp.array(points, dtype=wp.vec3, device="cpu") for points in arrays]
    table: Any = wp.array(neighbors, dtype=int, device="cpu")
    rotations = wp.zeros(count, dtype=wp.mat33, device="cpu")
    wp.launch(load(turn_nodes, "cpu"), count, [*positions, table, rotations], device="cpu")
    return torch.tensor(rotations.numpy(), dtype=before.dtype, device=before.device)


def carry(points: torch.Tensor, particles: torch.Tensor, rotations: torch.Tensor, displacements: torch.Tensor) -> torch.Tensor:
    """Points [N, 3] after particles [P, 3] with rotations [P, 3, 3] moved by displacements [P, 3], all in m."""
    weights = 1 / torch.cdist(points, particles, compute_mode="donot_use_mm_for_euclid_dist").clamp(min=MIN_PARTICLE_DISTANCE)
    weights = weights / weights.sum(dim=1, keepdim=True)
    bend = rotations - torch.eye(3, dtype=points.dtype, device=points.device)
    # sum_b w_b [B_b (x - b) + u_b] = (sum_b w_b B_b) x + sum_b w_b (u_b - B_b b); a center keeps precision.
    center = particles.mean(dim=0)
    shift = displacements - torch.einsum("bij,bj->bi", bend, particles - center)
    turned = torch.einsum("nij,nj->ni", (weights @ bend.flatten(1)).view(-1, 3, 3), points - center)
    return points + turned + weights @ shift


def upright(points: np.ndarray, up: Up) -> np.ndarray:
    """Points [..., 3], m, from a world with this `up` to one with +z up, or back."""
    return points.astype(np.float32) if up == "+z" else points.astype(np.float32) * HALF_TURN


def steps(tools: np.ndarray, frames: Iterable[int], step: float, last_accepted: float = 1.0) -> Iterator[int]:
    """The first of `frames`, then each frame in which a tool of [T, C, 3] has moved by `step`, m, since the previous one.

    The last frame of the recording needs only the fraction `last_accepted` of a step.
    """
    latest = None
    for frame in frames:
        least = step * (last_accepted if frame == len(tools) - 1 else 1.0)
        if latest is None or float(np.linalg.norm(tools[frame] - tools[latest], axis=1).max()) >= least:
            latest = frame
            yield frame


def executed(tools: np.ndarray, step: float) -> list[int]:
    """Frames in which a rollout makes a step: a tool of [T, C, 3] has moved by `step`, m, since the previous one."""
    return list(steps(tools, range(len(tools)), step))[1:]
