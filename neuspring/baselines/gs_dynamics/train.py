"""Training of GS-Dynamics: Adam on random windows of the training frames.

Random numbers come from a generator per epoch, so a continued training draws what an uninterrupted one does. A loss or gradient
that is not finite ends training as a named failure that keeps the latest weights with a finite loss; so does a capture without
windows, with the weights of the start. The last epoch is the result.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from neuspring.baselines.gs_dynamics.model import GsDynamicsModel
from neuspring.baselines.gs_dynamics.network import Dynamics, initial_weights
from neuspring.baselines.gs_dynamics.objective import draw, unroll
from neuspring.baselines.gs_dynamics.rules import preset_name, resolve
from neuspring.baselines.gs_dynamics.tracks import Tracks, tools_of
from neuspring.baselines.gs_dynamics.windows import Windows, executed
from neuspring.baselines.results import Trained
from neuspring.config.gs_dynamics import GsDynamics
from neuspring.core.artifacts import Observations
from neuspring.core.checkpoint import Checkpoint
from neuspring.core.progress import Progress

COLUMNS = ["step", "loss", "position_loss", "length_loss"]
MOMENTS = ("step", "exp_avg", "exp_avg_sq")


class NotFinite(ArithmeticError):
    """A loss or gradient of which nothing can be learned; says where."""


class Training:
    """Runs epochs on the training frames of a capture."""

    def __init__(self, observations: Observations, settings: GsDynamics, seed: int, device: str) -> None:
        self.settings, self.seed, self.device = settings, seed, device
        self.rules, self.recipe = resolve(settings, observations.scenario.category)
        self.tracks = Tracks.of(observations, settings, self.rules)
        self.windows = Windows.of(self.tracks, settings, device)
        self.weights = initial_weights(self.rules, seed).to(device).requires_grad_()
        self.optimiser = torch.optim.Adam([self.weights], lr=settings.learning_rate)
        self.usable = self.weights.detach().clone()
        """The latest weights whose loss was finite."""

    def epoch(self, number: int) -> dict[str, float]:
        """Means over the updates of an epoch. Raises NotFinite."""
        # Stateless, so that a continued training draws the same windows.
        (state,) = np.random.SeedSequence([self.seed, number]).generate_state(1, np.uint64)
        generator = torch.Generator().manual_seed(int(state >> np.uint64(1)))
        rows = []
        for update in range(self.settings.updates_per_epoch):
            rows.append(self.update(generator, f"epoch {number}, update {update}"))
        return dict(zip(COLUMNS[1:], np.mean(rows, axis=0).tolist(), strict=True))

    def update(self, generator: torch.Generator, where: str) -> tuple[float, float, float]:
        """One optimiser step: loss, position loss and unweighted length loss, m^2."""
        batch = draw(self.windows, self.rules, self.recipe, generator)
        position, length = unroll(Dynamics(self.rules, self.weights), batch, self.recipe)
        loss = position + self.recipe.length_weight * length
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        if not bool(torch.isfinite(loss.detach())):
            raise NotFinite(f"the loss is not finite ({where})")
        self.usable = self.weights.detach().clone()
        gradient = self.weights.grad
        if gradient is None or not bool(torch.isfinite(gradient).all()):
            raise NotFinite(f"the gradient of the loss is not finite ({where})")
        self.optimiser.step()
        found = torch.stack([loss, position, length]).tolist()
        return found[0], found[1], found[2]

    def model(self) -> GsDynamicsModel:
        """With the present weights."""
        return GsDynamicsModel(weights=self.weights.detach().cpu().numpy(), rules=self.rules)

    def checkpoint(self, values: dict[str, Any]) -> Checkpoint:
        """Everything that a continued training needs."""
        slots = self.optimiser.state[self.weights]
        moments = {name: slots[name].detach().cpu().numpy() for name in MOMENTS}
        return Checkpoint({"weights": self.weights.detach().cpu().numpy()} | moments, values)

    @torch.no_grad()
    def restore(self, checkpoint: Checkpoint) -> None:
        """Set weights and Adam's moments."""
        self.weights.copy_(torch.tensor(checkpoint.arrays["weights"]))
        slots = {name: torch.tensor(checkpoint.arrays[name]) for name in MOMENTS}
        self.optimiser.load_state_dict(self.optimiser.state_dict() | {"state": {0: slots}})
        self.usable = self.weights.detach().clone()

    @torch.no_grad()
    def fall_back(self) -> None:
        """To the latest weights whose loss was finite."""
        self.weights.copy_(self.usable)

    @torch.no_grad()
    def hold(self) -> None:
        """Predict no motion: the last layer, whose weights come last, is zero."""
        self.weights[-3 * (self.rules.width + 1) :] = 0.0

    def facts(self, category: str) -> dict[str, Any]:
        """What was made of the capture."""
        return {
            "preset": preset_name(self.settings, category),
            "weights": len(self.weights),
            "windows": len(self.windows),
            "tracks": self.tracks.points.shape[1],
            "tracks_dropped": self.tracks.dropped,
            "tools": self.tracks.tools.shape[1],
        }


def run(
    observations: Observations, settings: GsDynamics, seed: int, device: str, partial: Path | None = None, key: str = ""
) -> Trained[GsDynamicsModel]:
    """Train on the training frames of a capture; continue from `partial` if it holds a checkpoint with the same key."""
    training, begun = Training(observations, settings, seed, device), time.monotonic()
    history: list[dict[str, float]] = []
    attempts, earlier, failure = 1, 0.0, ""
    found = Checkpoint.load(partial, key, "training")
    if found:
        training.restore(found)
        history, attempts, earlier = found.values["history"], found.values["attempts"] + 1, found.values["seconds"]
        print(f"continuing after epoch {len(history) - 1}")
    epochs = settings.epochs
    if not len(training.windows):
        # What moves nothing yet must not move the object at random later.
        training.hold()
        if executed(tools_of(observations.controller_points, training.rules), settings.step):
            frames = observations.scenario.train_end
            failure = f"training did not start: no window of a tool that moves {settings.step} m in {frames} training frames"
        epochs = 0
    progress = Progress("train", epochs)
    for number in range(len(history), epochs):
        try:
            row = training.epoch(number)
        except NotFinite as fault:
            failure = f"training ended early: {fault}"
            training.fall_back()
            break
        history.append({"step": number, **row})
        progress.update(number + 1, f"loss {row['loss']:.4g}")
        if partial and (number + 1) % settings.checkpoint_every == 0:
            seconds = earlier + time.monotonic() - begun
            training.checkpoint({"history": history, "attempts": attempts, "seconds": seconds}).save(partial, key)
    facts = {"epochs": len(history)} | training.facts(observations.scenario.category)
    return Trained(training.model(), pd.DataFrame(history, columns=COLUMNS), facts, failure, attempts, earlier)
