"""Training of GS-Dynamics: Adam on random windows of the training frames, with the loss of several consecutive predicted steps.

- Each epoch has its own random generator, so a resumed training draws the same windows.
- A loss or gradient that is not finite ends training as a failure, with the latest weights that had a finite loss.
- For a capture without windows, the last layer becomes zero, so that the object does not move.
- The result is the last epoch.

The data are smoothed tracks without outliers, and the tools, which are the controllers; +z is up. A window around a frame has H
steps of history and F steps of future. A step is `step` m of tool motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import islice
from typing import Any, NoReturn

import numpy as np
import torch
from torch.nn.utils import vector_to_parameters

from neuspring.baselines import TrainingRequest
from neuspring.baselines.results import Trained, TrainingStopped, run_epochs
from neuspring.core.artifacts import Observations
from neuspring.core.checkpoint import Checkpoint, adam_arrays, restore_adam
from neuspring.core.geometry import farthest
from neuspring.extensions.gs_dynamics.model import (
    HISTORY,
    Dynamics,
    GsDynamicsModel,
    GsDynamicsTraining,
    ParticleGraph,
    Recipe,
    Rules,
    connect,
    executed,
    preset_name,
    resolve,
    sample,
    steps,
    upright,
)

DENSE_POINTS = 1000
"""Maximum number of tracks from which particles are sampled."""
MIN_VISIBLE = 20
"""Minimum number of tracks that are visible in all frames of a window.

With fewer, the window uses all tracks that are visible in its history, and losses omit invisible points."""
SMOOTHING_PASSES = 10
"""Passes of a moving average over three frames on the visible points of tracks."""
LAST_ACCEPTED = 0.75
"""Fraction of a step that suffices in the last training frame."""
GS_DYNAMICS_METRICS = ("loss", "position_loss", "length_loss")


@dataclass(frozen=True)
class Tracks:
    """Tracks and tools in T training frames."""

    points: np.ndarray
    """Positions [T, M, 3], m; undefined where invisible."""
    visible: np.ndarray
    """Visibility [T, M], bool."""
    tools: np.ndarray
    """Positions of the tools [T, C, 3], m."""
    dropped: int
    """Number of dropped outliers."""

    @classmethod
    def of(cls, observations: Observations, settings: GsDynamicsTraining) -> Tracks:
        """Tracks and tools of the training frames of a capture."""
        train, up = slice(observations.scenario.train_end), observations.scenario.up
        points, visible = upright(observations.object_points[train], up), observations.object_visibility[train]
        inliers = np.flatnonzero(ordinary(points, visible, settings.outlier_deviations))
        indices = inliers[farthest(points[0, inliers], DENSE_POINTS)]
        smooth = smoothed(points[:, indices], visible[:, indices], SMOOTHING_PASSES)
        tools = upright(observations.controller_points[train], up)
        return cls(smooth, visible[:, indices], tools, points.shape[1] - len(inliers))


def ordinary(points: np.ndarray, visible: np.ndarray, deviations: float) -> np.ndarray:
    """Which tracks [M] have a path length within `deviations` median absolute deviations of the median.

    The path length is the mean motion over pairs of successive frames with a visible point, times the number of all pairs. Tracks
    without such a pair are dropped. With `deviations` 0 all tracks stay; if the deviation is 0, all tracks with a path stay.
    """
    both = visible[1:] & visible[:-1]
    steps = np.where(both, np.linalg.norm(np.diff(points, axis=0), axis=2), 0.0)
    pairs = both.sum(axis=0)
    lengths = np.where(pairs > 0, steps.sum(axis=0) * len(both) / np.maximum(pairs, 1), np.nan)
    finite = np.isfinite(lengths)
    if not deviations or not finite.any():
        return np.ones_like(finite)
    distance = np.abs(lengths - np.median(lengths[finite]))
    spread = np.median(distance[finite])
    return np.asarray(finite & (distance < deviations * spread)) if spread > 0 else finite


def smoothed(points: np.ndarray, visible: np.ndarray, passes: int) -> np.ndarray:
    """Points [T, M, 3] after moving averages over three frames; only visible [T, M] points are averaged and changed."""

    def three(values: np.ndarray) -> np.ndarray:
        total = values.copy()
        total[1:] += values[:-1]
        total[:-1] += values[1:]
        return total

    weights = visible[..., None].astype(np.float32)
    result = np.where(visible[..., None], points, 0).astype(np.float32)
    count = three(weights)
    for _ in range(passes):
        result = weights * three(result) / np.maximum(count, 1)
    return np.where(visible[..., None], result, points).astype(np.float32)


def past(tools: np.ndarray, frame: int, step: float) -> list[int]:
    """H frames up to `frame`, oldest first, one step apart; if there are fewer, the oldest is repeated."""
    frames = list(islice(steps(tools, range(frame, -1, -1), step), HISTORY))
    return [frames[-1]] * (HISTORY - len(frames)) + frames[::-1]


def ahead(tools: np.ndarray, frame: int, step: float, count: int) -> list[int]:
    """`count` frames after `frame`, one step apart; if there are fewer, the latest is repeated; if there is none, empty."""
    frames = list(islice(steps(tools, range(frame, len(tools)), step, LAST_ACCEPTED), 1, count + 1))
    return frames + frames[-1:] * (count - len(frames))


def window_frames(tools: np.ndarray, settings: GsDynamicsTraining) -> np.ndarray:
    """Frames of each window [W, H + F]. Frames without a step ahead have no window, because a rollout does not move there."""
    rows = []
    for frame in range(len(tools)):
        future = ahead(tools, frame, settings.step, settings.future)
        if future:
            rows.append(past(tools, frame, settings.step) + future)
    return np.array(rows, dtype=np.int64).reshape(-1, HISTORY + settings.future)


@dataclass(frozen=True, eq=False)
class Windows:
    """The windows of a capture, on a device."""

    frames: torch.Tensor
    """Frames of each window [W, H + F], int64."""
    usable: torch.Tensor
    """Tracks that may become particles [W, M], bool. They are visible in the full history, so every input was measured."""
    points: torch.Tensor
    """Positions of tracks [T, M, 3], m."""
    visible: torch.Tensor
    """Visibility of tracks [T, M], bool."""
    tools: torch.Tensor
    """Positions of the tools [T, C, 3], m."""

    def __len__(self) -> int:
        return len(self.frames)

    @classmethod
    def of(cls, tracks: Tracks, settings: GsDynamicsTraining, device: str) -> Windows:
        """All windows in which at least one track may become a particle.

        Tracks must be visible in all frames of the window; if fewer than MIN_VISIBLE are, only in its history.
        """
        frames = window_frames(tracks.tools, settings)
        seen = tracks.visible[frames]
        throughout = seen.all(axis=1)
        enough = throughout.sum(axis=1, keepdims=True) >= MIN_VISIBLE
        usable = np.where(enough, throughout, seen[:, :HISTORY].all(axis=1))
        nonempty = usable.any(axis=1)
        arrays = (frames[nonempty], usable[nonempty], tracks.points, tracks.visible, tracks.tools)
        return cls(*(torch.tensor(values, device=device) for values in arrays))


@dataclass(frozen=True, eq=False)
class Batch:
    """A batch of windows with P particles and C tools in total, N = P + C nodes."""

    graph: ParticleGraph
    history: torch.Tensor
    """Positions of nodes with noise [H, N, 3], m."""
    tools: torch.Tensor
    """Recorded positions of tools [F, C, 3], m."""
    targets: torch.Tensor
    """Recorded positions of particles [F, P, 3], m."""
    known: torch.Tensor
    """Visibility of targets [F, P], bool."""


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
    """Index [B] of a random usable [B, M] entry of each row, for a uniform draw `chance` [B] in [0, 1)."""
    counts = usable.sum(dim=1)
    rank = torch.minimum((chance * counts).long(), counts - 1)
    return (usable.cumsum(dim=1) > rank[:, None]).to(torch.uint8).argmax(dim=1)


def rotations(chance: torch.Tensor) -> torch.Tensor:
    """Rotations [B, 3, 3] about z by the fraction `chance` [B] of a full turn."""
    angle = chance * 2 * math.pi
    turn = torch.zeros(len(chance), 3, 3)
    turn[:, 0, 0] = turn[:, 1, 1] = angle.cos()
    turn[:, 1, 0] = angle.sin()
    turn[:, 0, 1] = -angle.sin()
    turn[:, 2, 2] = 1
    return turn


def unroll(dynamics: Dynamics, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    """Position loss and unweighted length loss, m^2, each summed over the predicted steps.

    All steps use the edges of the first graph. Tools move as recorded.
    """
    particles = batch.graph.particles
    state, tools = batch.history[:, :particles], batch.history[:, particles:]
    position, length = state.new_zeros(()), state.new_zeros(())
    for i, recorded in enumerate(batch.tools):
        after = state[-1] + dynamics(batch.graph, torch.cat([state, tools], dim=1), recorded - tools[-1])
        position = position + position_loss(after, batch.targets[i], batch.known[i])
        length = length + length_loss(batch.graph, after, state[0].detach())
        state = torch.cat([state[1:], after[None]])
        tools = torch.cat([tools[1:], recorded[None]])
    return position, length


def position_loss(after: torch.Tensor, target: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """Mean squared error, m^2, over coordinates of known [P] targets."""
    squares = torch.where(known[:, None], (after - target).square(), 0.0)
    return squares.sum() / (3 * known.sum().clamp(min=1))


def length_loss(graph: ParticleGraph, after: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
    """Mean squared change of the lengths of edges among particles, from `before` to `after` [P, 3], m^2.

    The mean includes edges of particles to themselves, which do not change.
    """
    receivers, senders = graph.receivers[graph.among_particles], graph.senders[graph.among_particles]
    # The clone fixes the order in which gradients are added, so that results stay the same to the last bit.
    lengths = [(points[receivers] - points[senders]).norm(dim=1) for points in (after.clone(), before)]
    squares: torch.Tensor = (lengths[0] - lengths[1]).square()
    return squares.mean()


class GsDynamicsTrainer:
    """Runs epochs on the training frames of a capture."""

    def __init__(self, request: TrainingRequest) -> None:
        self.settings, self.seed = GsDynamicsTraining(**vars(request.settings.baselines.gs_dynamics)), request.seed
        self.category = request.observations.scenario.category
        self.rules, self.recipe = resolve(self.settings, self.category)
        self.tracks = Tracks.of(request.observations, self.settings)
        self.windows = Windows.of(self.tracks, self.settings, request.device)
        self.network = Dynamics.initial(self.rules, request.seed, request.device)
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=self.settings.learning_rate)
        self.usable = self.network.weights
        """The latest weights whose loss was finite."""

    def epoch(self, number: int) -> dict[str, float]:
        """Run one epoch; returns means over its updates. Raises TrainingStopped."""
        # The generator depends only on seed and epoch, so that a resumed training draws the same windows.
        (state,) = np.random.SeedSequence([self.seed, number]).generate_state(1, np.uint64)
        generator = torch.Generator().manual_seed(int(state >> np.uint64(1)))
        updates = range(self.settings.updates_per_epoch)
        rows = [self.update(generator, f"epoch {number}, update {update}") for update in updates]
        return dict(zip(GS_DYNAMICS_METRICS, np.mean(rows, axis=0).tolist(), strict=True))

    def update(self, generator: torch.Generator, where: str) -> list[float]:
        """Make one optimizer step; returns the loss, the position loss and the unweighted length loss, m^2."""
        position, length = unroll(self.network, draw(self.windows, self.rules, self.recipe, generator))
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
        """The model with the current weights."""
        return GsDynamicsModel(weights=self.network.weights.cpu().numpy(), rules=self.rules)

    def checkpoint(self) -> Checkpoint:
        """The state from which training resumes."""
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
            "preset": preset_name(self.category),
            "weights": len(self.network.weights),
            "windows": len(self.windows),
            "tracks": self.tracks.points.shape[1],
            "tracks_dropped": self.tracks.dropped,
            "tools": self.tracks.tools.shape[1],
        }


def train(request: TrainingRequest) -> Trained[GsDynamicsModel]:
    """Train on the tracks of the training frames; resumes from a checkpoint with the same key."""
    training, settings = GsDynamicsTrainer(request), request.settings.baselines.gs_dynamics
    if len(training.windows):
        return run_epochs(training, GS_DYNAMICS_METRICS, settings.epochs, request.partial, request.key())
    # An untrained network must not move the object at random.
    with torch.no_grad():
        for parameter in training.network.head[-1].parameters():
            parameter.zero_()
    failure = ""
    if executed(request.observations.controller_points, settings.step):
        frames = request.observations.scenario.train_end
        failure = f"training did not start: no window of a tool that moves {settings.step} m in {frames} training frames"
    return run_epochs(training, GS_DYNAMICS_METRICS, 0, None, "", failure)
