"""Training of GS-Dynamics: Adam on random windows of the training frames, with the loss of several predicted steps in a row.

Each epoch has its own random generator, so a continued training draws what an uninterrupted one does. A loss or gradient that is
not finite ends training as a named failure with the latest weights whose loss was finite. A capture without windows keeps its
initial weights, but for a last layer of zeros, so that it moves nothing. The last epoch is the result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
import torch
from torch.nn.utils import vector_to_parameters

from neuspring.baselines import TrainingRequest
from neuspring.baselines.gs_dynamics.model import (
    HISTORY,
    Dynamics,
    Graph,
    GsDynamicsModel,
    Recipe,
    Rules,
    connect,
    preset_name,
    resolve,
    sample,
)
from neuspring.baselines.gs_dynamics.windows import Tracks, Windows, executed
from neuspring.baselines.results import Trained, TrainingStopped, run_epochs
from neuspring.core.checkpoint import Checkpoint, adam_arrays, restore_adam

METRICS = ("loss", "position_loss", "length_loss")


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


def draw(windows: Windows, rules: Rules, recipe: Recipe, generator: torch.Generator) -> Batch:
    """Draw random windows, each with its own particles, a random yaw and noise. The generator is on the CPU."""
    device = windows.frames.device

    def noise(shape: torch.Size) -> torch.Tensor:
        return ((torch.rand(shape, generator=generator) * 2 - 1) * recipe.noise).to(device)

    numbers = torch.randint(len(windows), (recipe.batch,), generator=generator)
    chances = torch.rand(recipe.batch, 2, generator=generator)
    frames, usable = windows.frames[numbers.to(device)], windows.usable[numbers.to(device)]
    now = windows.points[frames[:, HISTORY - 1]]
    indices, used = sample(now, usable, rules.particles, rules.coverage, pick(usable, chances[:, 0].to(device)))
    window, slot = used.nonzero(as_tuple=True)
    particle = indices[window, slot]
    points = windows.points[frames[window].T, particle]
    tools = windows.tools[frames].transpose(0, 1)
    turn = rotations(chances[:, 1] if recipe.yaw else torch.zeros(recipe.batch)).to(device)
    points = torch.einsum("nij,tnj->tni", turn[window], points)
    tools = torch.einsum("bij,tbcj->tbci", turn, tools)
    points[:HISTORY] += noise(points[:HISTORY].shape)
    past = tools[:HISTORY] + noise(tools[:HISTORY].shape)
    latest = torch.zeros_like(now[:, : used.shape[1]])
    latest[window, slot] = points[HISTORY - 1]
    return Batch(
        graph=connect(latest, used, past[-1], rules),
        history=torch.cat([points[:HISTORY], past.flatten(1, 2)], dim=1),
        tools=tools[HISTORY:].flatten(1, 2),
        targets=points[HISTORY:],
        known=windows.visible[frames[window].T, particle][HISTORY:],
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


def unroll(dynamics: Dynamics, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    """Position loss and length loss, m^2, each summed over the predicted steps. The length loss has no weight yet.

    The edges of the first graph stay. Tools move as recorded.
    """
    particles = batch.graph.particles
    state, tools = batch.history[:, :particles], batch.history[:, particles:]
    position, length = state.new_zeros(()), state.new_zeros(())
    for i, recorded in enumerate(batch.tools):
        moves = dynamics(batch.graph, torch.cat([state, tools], dim=1), recorded - tools[-1])
        after = state[-1] + moves
        position = position + position_loss(after, batch.targets[i], batch.known[i])
        length = length + length_loss(batch.graph, after, state[0].detach())
        state = torch.cat([state[1:], after[None]])
        tools = torch.cat([tools[1:], recorded[None]])
    return position, length


def position_loss(after: torch.Tensor, target: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """Mean squared error, m^2, over coordinates of known [P] targets."""
    squares = torch.where(known[:, None], (after - target).square(), 0.0)
    return squares.sum() / (3 * known.sum().clamp(min=1))


def length_loss(graph: Graph, after: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
    """Mean squared change of the lengths of edges among particles, `before` to `after` [P, 3], m^2.

    An edge of a particle to itself counts, with no change.
    """
    receivers, senders = graph.receivers[graph.among_particles], graph.senders[graph.among_particles]
    # A clone has the gradients of both ends added before those of the other loss: results keep their last bits.
    lengths = [(points[receivers] - points[senders]).norm(dim=1) for points in (after.clone(), before)]
    squares: torch.Tensor = (lengths[0] - lengths[1]).square()
    return squares.mean()


class Training:
    """Runs epochs on the training frames of a capture."""

    def __init__(self, request: TrainingRequest) -> None:
        self.settings, self.seed = request.settings.baselines.gs_dynamics, request.seed
        self.category = request.observations.scenario.category
        self.rules, self.recipe = resolve(self.settings, self.category)
        self.tracks = Tracks.of(request.observations, self.settings)
        self.windows = Windows.of(self.tracks, self.settings, request.device)
        self.network = Dynamics.initial(self.rules, request.seed, request.device)
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=self.settings.learning_rate)
        self.usable = self.network.weights
        """The latest weights whose loss was finite."""

    def epoch(self, number: int) -> dict[str, float]:
        """Means over the updates of an epoch. Raises TrainingStopped."""
        # Stateless, so that a continued training draws the same windows.
        (state,) = np.random.SeedSequence([self.seed, number]).generate_state(1, np.uint64)
        generator = torch.Generator().manual_seed(int(state >> np.uint64(1)))
        updates = range(self.settings.updates_per_epoch)
        rows = [self.update(generator, f"epoch {number}, update {update}") for update in updates]
        return dict(zip(METRICS, np.mean(rows, axis=0).tolist(), strict=True))

    def update(self, generator: torch.Generator, where: str) -> list[float]:
        """One optimizer step; returns the loss, the position loss and the length loss before its weight, m^2."""
        batch = draw(self.windows, self.rules, self.recipe, generator)
        position, length = unroll(self.network, batch)
        loss = position + self.recipe.length_weight * length
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        if not bool(torch.isfinite(loss.detach())):
            self.stop(f"the loss is not finite ({where})")
        self.usable = self.network.weights
        gradients = [parameter.grad for parameter in self.network.parameters()]
        if not all(gradient is not None and bool(torch.isfinite(gradient).all()) for gradient in gradients):
            self.stop(f"the gradient of the loss is not finite ({where})")
        self.optimizer.step()
        return torch.stack([loss, position, length]).tolist()

    def stop(self, reason: str) -> NoReturn:
        """End training with the latest weights whose loss was finite."""
        vector_to_parameters(self.usable, self.network.parameters())
        raise TrainingStopped(reason)

    def model(self) -> GsDynamicsModel:
        """With the present weights."""
        return GsDynamicsModel(weights=self.network.weights.cpu().numpy(), rules=self.rules)

    def checkpoint(self) -> Checkpoint:
        """Everything that a continued training needs."""
        return Checkpoint({"network": {"weights": self.network.weights.cpu().numpy()}, "adam": adam_arrays(self.optimizer)}, {})

    def restore(self, checkpoint: Checkpoint) -> None:
        """Set weights and Adam's moments."""
        self.usable = torch.tensor(checkpoint.arrays["network"]["weights"], device=self.usable.device)
        vector_to_parameters(self.usable.clone(), self.network.parameters())
        restore_adam(self.optimizer, checkpoint.arrays["adam"])

    def facts(self, epochs: int) -> dict[str, Any]:
        """Facts for the record."""
        return {
            "epochs": epochs,
            "preset": preset_name(self.settings, self.category),
            "weights": len(self.network.weights),
            "windows": len(self.windows),
            "tracks": self.tracks.points.shape[1],
            "tracks_dropped": self.tracks.dropped,
            "tools": self.tracks.tools.shape[1],
        }


def train(request: TrainingRequest) -> Trained[GsDynamicsModel]:
    """Train on the tracks of the training frames; continue a checkpoint with the same key."""
    training, settings = Training(request), request.settings.baselines.gs_dynamics
    if len(training.windows):
        return run_epochs(training, METRICS, settings.epochs, request.partial, request.key())
    # A network that learned nothing must not move the object at random.
    with torch.no_grad():
        for parameter in training.network.head[-1].parameters():
            parameter.zero_()
    failure = ""
    if executed(request.observations.controller_points, settings.step):
        frames = request.observations.scenario.train_end
        failure = f"training did not start: no window of a tool that moves {settings.step} m in {frames} training frames"
    return run_epochs(training, METRICS, 0, None, "", failure)
