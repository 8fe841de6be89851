"""A batch of windows, and the loss of several predicted steps in a row."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from neuspring.baselines.gs_dynamics.graph import Graph, connect, sample
from neuspring.baselines.gs_dynamics.network import Dynamics
from neuspring.baselines.gs_dynamics.rules import Recipe, Rules
from neuspring.baselines.gs_dynamics.windows import Windows


@dataclass(frozen=True, eq=False)
class Batch:
    """A batch of windows. All together have P particles and C tools, N = P + C nodes."""

    graph: Graph
    history: torch.Tensor
    """[H, N, 3] m, with noise."""
    tools: torch.Tensor
    """[F, C, 3] m, as recorded."""
    targets: torch.Tensor
    """[F, P, 3] m."""
    known: torch.Tensor
    """[F, P] bool: whether the target was seen."""
    slots: int
    """The batch size times the most particles of a window, for `padded_mean`."""


def draw(windows: Windows, rules: Rules, recipe: Recipe, generator: torch.Generator) -> Batch:
    """Draw random windows, each with its own particles, a random yaw and noise. The generator is on the CPU."""
    device, history = windows.frames.device, windows.history
    numbers = torch.randint(len(windows), (recipe.batch,), generator=generator)
    chances = torch.rand(recipe.batch, 2, generator=generator)
    frames, usable = windows.frames[numbers.to(device)], windows.usable[numbers.to(device)]
    now = windows.points[frames[:, history - 1]]
    indices, used = sample(now, usable, rules.particles, rules.coverage, pick(usable, chances[:, 0].to(device)))
    window, slot = used.nonzero(as_tuple=True)
    particle = indices[window, slot]
    points = windows.points[frames[window].T, particle]
    tools = windows.tools[frames].transpose(0, 1)
    turn = rotations(chances[:, 1] if recipe.yaw else torch.zeros(recipe.batch)).to(device)
    points = torch.einsum("nij,tnj->tni", turn[window], points)
    tools = torch.einsum("bij,tbcj->tbci", turn, tools)
    points[:history] += noise(points[:history].shape, recipe.noise, generator).to(device)
    past = tools[:history] + noise(tools[:history].shape, recipe.noise, generator).to(device)
    latest = torch.zeros_like(now[:, : used.shape[1]])
    latest[window, slot] = points[history - 1]
    graph = connect(latest, used, past[-1], rules)
    nodes = torch.cat([points[:history], past.flatten(1, 2)], dim=1)
    visible = windows.visible[frames[window].T, particle]
    return Batch(
        graph=graph,
        history=nodes,
        tools=tools[history:].flatten(1, 2),
        targets=points[history:],
        known=visible[history:],
        slots=recipe.batch * rules.particles,
    )


def pick(usable: torch.Tensor, chance: torch.Tensor) -> torch.Tensor:
    """Index [B] of one of the usable [B, M] entries of each row, for a uniform draw `chance` [B] in [0, 1)."""
    counts = usable.sum(dim=1)
    rank = torch.minimum((chance * counts).long(), counts - 1)
    return (usable.cumsum(dim=1) > rank[:, None]).to(torch.uint8).argmax(dim=1)


def rotations(chance: torch.Tensor) -> torch.Tensor:
    """Rotations [B, 3, 3] about z by the fraction `chance` [B] of a whole turn."""
    angle = chance * 2 * math.pi
    turn = torch.zeros(len(chance), 3, 3)
    turn[:, 0, 0] = turn[:, 1, 1] = angle.cos()
    turn[:, 1, 0] = angle.sin()
    turn[:, 0, 1] = -angle.sin()
    turn[:, 2, 2] = 1
    return turn


def noise(shape: torch.Size, size: float, generator: torch.Generator) -> torch.Tensor:
    """Noise, uniform in +- size, m."""
    return (torch.rand(shape, generator=generator) * 2 - 1) * size


def unroll(dynamics: Dynamics, batch: Batch, recipe: Recipe) -> tuple[torch.Tensor, torch.Tensor]:
    """Position loss and length loss, m^2, each summed over the predicted steps. The length loss has no weight yet.

    The edges of the first graph stay. Tools move as recorded.
    """
    particles = batch.graph.particles
    state, tools = batch.history[:, :particles], batch.history[:, particles:]
    position, length = state.new_zeros(()), state.new_zeros(())
    for i, recorded in enumerate(batch.tools):
        moves = dynamics(batch.graph, torch.cat([state, tools], dim=1), recorded - tools[-1])
        after = state[-1] + moves
        slots = batch.slots if recipe.padded_mean else None
        position = position + position_loss(after, batch.targets[i], batch.known[i], slots)
        length = length + length_loss(batch.graph, after, state[0].detach(), recipe.faithful_length_loss)
        state = torch.cat([state[1:], after[None]])
        tools = torch.cat([tools[1:], recorded[None]])
    return position, length


def position_loss(after: torch.Tensor, target: torch.Tensor, known: torch.Tensor, slots: int | None) -> torch.Tensor:
    """Mean squared error, m^2, over coordinates of known [P] targets; with `slots`, the sum is divided by so many particles."""
    squares = torch.where(known[:, None], (after - target).square(), 0.0)
    count = known.sum().clamp(min=1) if slots is None else slots
    return squares.sum() / (3 * count)


def length_loss(graph: Graph, after: torch.Tensor, before: torch.Tensor, faithful: bool) -> torch.Tensor:
    """Mean squared change of the lengths of edges from particles `before` to `after` [P, 3], m^2.

    An edge of a particle to itself counts, with no change. Edges to tools are left out. With `faithful` they count as if the tool
    were at the origin: its column is missing from the incidence matrices of the public code.
    """
    receivers, senders = graph.receivers, graph.senders
    if not faithful:
        receivers, senders = receivers[graph.among_particles], senders[graph.among_particles]
    change = edge_lengths(after, receivers, senders) - edge_lengths(before, receivers, senders)
    squares: torch.Tensor = change.square()
    return squares.mean()


def edge_lengths(points: torch.Tensor, receivers: torch.Tensor, senders: torch.Tensor) -> torch.Tensor:
    """Lengths [E] m. Nodes that are no particle count as at the origin."""
    ends, origin = torch.cat([points, points.new_zeros(1, 3)]), len(points)
    lengths: torch.Tensor = (ends[receivers.clamp(max=origin)] - ends[senders.clamp(max=origin)]).norm(dim=1)
    return lengths
