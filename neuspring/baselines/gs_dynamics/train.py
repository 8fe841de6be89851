"""Training of GS-Dynamics: Adam on random windows of the training frames.

Each epoch has its own random generator, so a continued training draws what an uninterrupted one does. A loss or gradient that is
not finite ends training as a named failure with the latest weights whose loss was finite. A capture without windows keeps its
initial weights, but for a last layer of zeros, so that it moves nothing. The last epoch is the result.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch.nn.utils import vector_to_parameters

from neuspring.baselines.gs_dynamics.model import GsDynamicsModel
from neuspring.baselines.gs_dynamics.network import Dynamics
from neuspring.baselines.gs_dynamics.objective import draw, unroll
from neuspring.baselines.gs_dynamics.rules import preset_name, resolve
from neuspring.baselines.gs_dynamics.tracks import Tracks, tools_of
from neuspring.baselines.gs_dynamics.windows import Windows, executed
from neuspring.baselines.results import Trained, TrainingStopped, run_epochs
from neuspring.config.gs_dynamics import GsDynamics
from neuspring.core.artifacts import Observations
from neuspring.core.checkpoint import Checkpoint, TrainingLoop, adam_arrays, restore_adam

METRICS = ("loss", "position_loss", "length_loss")


class Training:
    """Runs epochs on the training frames of a capture."""

    def __init__(self, observations: Observations, settings: GsDynamics, seed: int, device: str) -> None:
        self.settings, self.seed, self.category = settings, seed, observations.scenario.category
        self.rules, self.recipe = resolve(settings, self.category)
        self.tracks = Tracks.of(observations, settings, self.rules)
        self.windows = Windows.of(self.tracks, settings, device)
        self.network = Dynamics.initial(self.rules, seed, device)
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=settings.learning_rate)
        self.usable = self.network.weights
        """The latest weights whose loss was finite."""

    def epoch(self, number: int) -> dict[str, float]:
        """Means over the updates of an epoch. Raises TrainingStopped."""
        # Stateless, so that a continued training draws the same windows.
        (state,) = np.random.SeedSequence([self.seed, number]).generate_state(1, np.uint64)
        generator = torch.Generator().manual_seed(int(state >> np.uint64(1)))
        rows = []
        for update in range(self.settings.updates_per_epoch):
            rows.append(self.update(generator, f"epoch {number}, update {update}"))
        return dict(zip(METRICS, np.mean(rows, axis=0).tolist(), strict=True))

    def update(self, generator: torch.Generator, where: str) -> list[float]:
        """One optimizer step; returns the loss, the position loss and the length loss before its weight, m^2."""
        batch = draw(self.windows, self.rules, self.recipe, generator)
        position, length = unroll(self.network, batch, self.recipe)
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

    @torch.no_grad()
    def predict_no_motion(self) -> None:
        """Set the last layer to zero: a network that learned nothing must not move the object at random."""
        for parameter in self.network.head[-1].parameters():
            parameter.zero_()

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


def run(
    observations: Observations, settings: GsDynamics, seed: int, device: str, partial: Path | None = None, key: str = ""
) -> Trained[GsDynamicsModel]:
    """Train on the training frames of a capture; continue from `partial` if it holds a checkpoint with the same key."""
    training = Training(observations, settings, seed, device)
    if len(training.windows):
        loop = TrainingLoop("the training", "train", settings.epochs, settings.checkpoint_every, partial, key)
        return run_epochs(training, loop, METRICS)
    training.predict_no_motion()
    failure = ""
    if executed(tools_of(observations.controller_points, training.rules), settings.step):
        frames = observations.scenario.train_end
        failure = f"training did not start: no window of a tool that moves {settings.step} m in {frames} training frames"
    return run_epochs(training, TrainingLoop("the training", "train", 0, 1, None, key), METRICS, failure)
