"""Dynamic training of Spring-Gaus: each iteration replays the training frames from rest, with an optimiser step per frame.

The gradient goes through one frame only. One initial velocity v0 is added on entering every frame and taken away on leaving it, as
in the public code, so a step of the optimiser moves the velocity in the middle of a trajectory. A frame that leaves the range of
plausible states, or whose loss or gradient is not finite, is simulated again with more substeps; with no more to give, training
ends as a named failure that keeps the parameters of the last complete iteration. The last iteration is the result.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from neuspring.baselines.results import LIMIT, Trained
from neuspring.baselines.spring_gaus.model import TRAINED, SpringGausModel
from neuspring.baselines.spring_gaus.solver import AnchorSolver
from neuspring.config.spring_gaus import SpringGaus
from neuspring.core.checkpoint import Checkpoint
from neuspring.core.progress import Progress

Objective = Callable[[int, int, torch.Tensor], torch.Tensor | None]
"""(iteration, frame, anchors [N, 3] m at the end of the frame) -> loss; None where there is nothing to compare with."""
ADAM_EPSILON = 1e-15


class UnusableFrame(ArithmeticError):
    """A frame of which nothing can be learned; says why."""


@dataclass(frozen=True)
class Problem:
    """What a model is trained on."""

    start: SpringGausModel
    hands: np.ndarray
    """[T, C, 3] m, of the training frames."""
    objective: Objective
    settings: SpringGaus
    device: str = "cpu"


class Training:
    """Runs iterations; a frame at a time."""

    def __init__(self, problem: Problem) -> None:
        self.problem, settings = problem, problem.settings
        model, device = problem.start, problem.device
        self.values = {name: tensor.requires_grad_() for name, tensor in model.tensors(device).items()}
        self.solver = AnchorSolver(model.graph, model.physics, settings.substeps, device)
        rates = {
            "kappa": settings.stiffness_rate,
            "soft": settings.soft_rate,
            "theta": settings.damping_rate,
            "rho": settings.ground_rate,
            "velocity": settings.velocity_rate,
        }
        groups = [{"params": [self.values[name]], "lr": rates[name]} for name in TRAINED]
        self.optimiser = torch.optim.Adam(groups, eps=ADAM_EPSILON)
        self.rest = torch.tensor(model.anchors, device=device)
        self.hands = torch.tensor(problem.hands, device=device)
        self.keep()

    @property
    def frames(self) -> range:
        """The loop of the public code ends one frame before the last training frame."""
        return range(1, max(len(self.hands) - 1, 2))

    def iteration(self, number: int) -> dict[str, float]:
        """One pass over the frames. Raises UnusableFrame where even the most substeps do not help."""
        if number in self.problem.settings.substeps_raised:
            self.add_substeps()
        x, v = self.rest, torch.zeros_like(self.rest)
        losses, largest = [], 0.0
        for frame in self.frames:
            while True:
                try:
                    x, v, loss, norm = self.frame(number, frame, x, v)
                    break
                except UnusableFrame as fault:
                    if not self.add_substeps():
                        where = f"iteration {number}, frame {frame}, {self.substeps} substeps"
                        raise UnusableFrame(f"{fault} ({where})") from fault
                    print(f"iteration {number}, frame {frame}: {fault}; {self.substeps} substeps from here on", flush=True)
            if loss is not None:
                losses.append(loss)
                largest = max(largest, norm)
        return {"loss": float(np.mean(losses)) if losses else 0.0, "gradient_norm": largest, "substeps": float(self.substeps)}

    def add_substeps(self) -> bool:
        """More substeps per frame; False if there are as many as may be."""
        settings = self.problem.settings
        more = min(self.substeps + settings.substeps_added, settings.max_substeps)
        raised = more > self.substeps
        if raised:
            self.use_substeps(more)
        return raised

    def use_substeps(self, count: int) -> None:
        """Integrate with `count` substeps per frame from now on."""
        model = self.problem.start
        self.solver = AnchorSolver(model.graph, model.physics, count, self.problem.device)

    @property
    def substeps(self) -> int:
        """Per frame."""
        return self.solver.substeps

    def frame(
        self, iteration: int, frame: int, x: torch.Tensor, v: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, float | None, float]:
        """State after a frame, its loss, and the largest gradient of any tensor before clipping; makes an optimiser step."""
        model = self.problem.start
        parameters = model.parameters(self.values)
        ends = self.hands[frame - 1], self.hands[frame]
        after, speed = self.solver.frame(parameters, x, v + self.values["velocity"], *ends)
        # NaN compares false, so this catches it together with infinity and absurd distances.
        if not bool((after.detach().abs() < LIMIT).all() and torch.isfinite(speed.detach()).all()):
            raise UnusableFrame("the anchors left the scene")
        state = after.detach(), (speed - self.values["velocity"]).detach()
        loss = self.problem.objective(iteration, frame, after)
        if loss is None:
            return *state, None, 0.0
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        tensors = [tensor for tensor in self.values.values() if tensor.grad is not None]
        norms = torch.stack([tensor.grad.norm() for tensor in tensors if tensor.grad is not None])
        if not bool(torch.isfinite(loss.detach()) and torch.isfinite(norms).all()):
            raise UnusableFrame("the loss or its gradient is not finite")
        limit = self.problem.settings.clip_gradient_norm
        if limit:
            for tensor in tensors:
                torch.nn.utils.clip_grad_norm_([tensor], limit)
        self.optimiser.step()
        if not self.problem.settings.negative_damping:
            # Here and not in the forces alone, where a clamp would leave no gradient to come back with.
            with torch.no_grad():
                self.values["theta"].clamp_(min=1.0)
        return *state, float(loss.detach()), float(norms.max())

    def keep(self) -> None:
        """Remember the present values: an iteration was completed with them."""
        self.kept = {name: tensor.detach().clone() for name, tensor in self.values.items()}

    def model(self) -> SpringGausModel:
        """With the values of the last complete iteration."""
        values: dict[str, Any] = {name: tensor.cpu().numpy() for name, tensor in self.kept.items()}
        return replace(self.problem.start, **values, substeps=self.substeps)

    def checkpoint(self, values: dict[str, Any]) -> Checkpoint:
        """Everything that a continued training needs."""
        arrays = {name: tensor.detach().cpu().numpy() for name, tensor in self.values.items()}
        state = self.optimiser.state_dict()["state"]
        arrays |= {f"adam.{i}.{name}": value.cpu().numpy() for i, slots in state.items() for name, value in slots.items()}
        return Checkpoint(arrays, values | {"substeps": self.substeps})

    @torch.no_grad()
    def restore(self, checkpoint: Checkpoint) -> None:
        """Set values, Adam's moments and the substeps."""
        self.use_substeps(checkpoint.values["substeps"])
        for name, tensor in self.values.items():
            tensor.copy_(torch.tensor(checkpoint.arrays[name]))
        described = self.optimiser.state_dict()
        slots: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in checkpoint.arrays.items():
            if key.startswith("adam."):
                _, index, name = key.split(".")
                slots.setdefault(int(index), {})[name] = torch.tensor(value)
        self.optimiser.load_state_dict(described | {"state": slots})
        self.keep()


def run(problem: Problem, partial: Path | None = None, key: str = "") -> Trained[SpringGausModel]:
    """Train; continue from `partial` if it holds a checkpoint with the same key."""
    training, settings, begun = Training(problem), problem.settings, time.monotonic()
    history: list[dict[str, float]] = []
    attempts, earlier, failure = 1, 0.0, ""
    found = Checkpoint.load(partial, key, "training")
    if found:
        training.restore(found)
        history, attempts, earlier = found.values["history"], found.values["attempts"] + 1, found.values["seconds"]
        print(f"continuing after iteration {len(history) - 1}")
    progress = Progress("train", settings.iterations)
    for number in range(len(history), settings.iterations):
        try:
            row = training.iteration(number)
        except UnusableFrame as fault:
            failure = f"training ended early: {fault}"
            break
        training.keep()
        history.append({"step": number, **row})
        progress.update(number + 1, f"loss {row['loss']:.4g}, {training.substeps} substeps")
        if partial and (number + 1) % settings.checkpoint_every == 0:
            seconds = earlier + time.monotonic() - begun
            training.checkpoint({"history": history, "attempts": attempts, "seconds": seconds}).save(partial, key)
    columns = ["step", "loss", "gradient_norm", "substeps"]
    facts = {"iterations": len(history), "substeps": training.substeps}
    return Trained(training.model(), pd.DataFrame(history, columns=columns), facts, failure, attempts, earlier)
