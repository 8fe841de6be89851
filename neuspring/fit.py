"""First-order stage: stiffness per spring and contact scalars by Adam, gradients through the simulation (section 5.5).

An epoch is one pass over the training frames from rest. Every `horizon` frames (1 as released, 0 for the whole training
span) one optimiser step is made with the gradient through those frames; the state is detached there and goes on while
parameters change. The epoch with the lowest training loss wins; test frames are never read. A non-finite loss or gradient
restores the parameters of the epoch's start, halves the learning rate and is reported.
"""

from __future__ import annotations

import json
import time
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from neuspring import config
from neuspring.artifacts import Observations, Twin, write_atomically
from neuspring.errors import NumericalFailure
from neuspring.losses import FrameLoss
from neuspring.physics import stability
from neuspring.physics.autograd import pack, simulate_frame, twin_tensors
from neuspring.physics.solver import FrameSolver, Parameters
from neuspring.progress import Progress

TRAINED_SCALARS = ("ground_elasticity", "ground_friction", "contact_elasticity", "contact_friction")
LOWEST_STIFFNESS = 1e-3
"""Stiffness below this is raised to it before taking the logarithm, N."""
MAX_ROLLBACKS = 5
RELEASED_CHECKPOINT_EPOCHS = 20


class NonFinite(ArithmeticError):
    """A loss or gradient is not finite; says where."""


@dataclass(frozen=True)
class FitProblem:
    """Everything that a fit is made from."""

    observations: Observations
    twin: Twin
    fit: config.Fit
    simulation: config.Simulation
    losses: config.Losses
    quirks: config.ReleasedQuirks
    device: str = "cpu"


@dataclass(frozen=True)
class FitResult:
    """The best twin, and the history: one row per epoch (epoch, loss, gradient_norm, rolled_back, learning_rate)."""

    twin: Twin
    history: pd.DataFrame
    best_epoch: int
    rollbacks: list[str]
    attempts: int
    """1, plus one for every time the fit continued from a checkpoint."""
    earlier_seconds: float
    """Wall time of the attempts that this one continued, up to their last checkpoint."""
    collision_overflow: int


class SpringParameters:
    """What is trained: theta = log stiffness per spring [S], and four contact scalars (clamped on use, as released)."""

    def __init__(self, twin: Twin, limits: tuple[float, float], device: str) -> None:
        self._fixed = twin_tensors(twin, device)
        self._limits = limits
        stiffness = self._fixed.pop("stiffness").clamp_min(LOWEST_STIFFNESS)
        self.tensors = {"log_stiffness": stiffness.log().requires_grad_()}
        for name in TRAINED_SCALARS:
            self.tensors[name] = self._fixed.pop(name).requires_grad_()

    def stiffness(self) -> torch.Tensor:
        """Clamped stiffness [S], N."""
        return self.tensors["log_stiffness"].exp().clamp(*self._limits)

    def pack(self, substep: float) -> Parameters:
        """Packed for the solver, differentiably."""
        scalars = {name: self.tensors[name] for name in TRAINED_SCALARS}
        return pack(stiffness=self.stiffness(), **scalars, **self._fixed, substep=substep)

    def copy(self) -> dict[str, np.ndarray]:
        """The trained values as arrays."""
        return {name: tensor.detach().cpu().numpy().copy() for name, tensor in self.tensors.items()}

    def restore(self, values: dict[str, np.ndarray]) -> None:
        """Set the trained values."""
        with torch.no_grad():
            for name, tensor in self.tensors.items():
                tensor.copy_(torch.from_numpy(np.asarray(values[name])))


@dataclass
class _State:
    """Everything that a continued fit needs, and nothing else."""

    epoch: int
    values: dict[str, np.ndarray]
    moments: dict[str, np.ndarray]
    learning_rate: float
    history: list[dict[str, Any]]
    rollbacks: list[str]
    best_epoch: int
    best_values: dict[str, np.ndarray]
    substeps: int
    attempts: int = 1
    seconds: float = 0.0

    def save(self, path: Path, key: str, seconds: float) -> None:
        arrays = {f"values.{k}": v for k, v in self.values.items()} | {f"best.{k}": v for k, v in self.best_values.items()}
        arrays |= {f"moments.{k}": v for k, v in self.moments.items()}
        meta = {
            "key": key,
            "epoch": self.epoch,
            "learning_rate": self.learning_rate,
            "history": self.history,
            "rollbacks": self.rollbacks,
            "best_epoch": self.best_epoch,
            "substeps": self.substeps,
            "attempts": self.attempts,
            "seconds": seconds,
        }
        arrays["meta"] = np.frombuffer(json.dumps(meta).encode(), np.uint8)

        def write(temporary: Path) -> None:
            with temporary.open("wb") as stream:
                np.savez(stream, **arrays)  # type: ignore[arg-type]

        write_atomically(path, write)

    @classmethod
    def load(cls, path: Path | None, key: str) -> _State | None:
        if path is None or not path.is_file():
            return None
        try:
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            meta = json.loads(arrays.pop("meta").tobytes())
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            print(f"{path}: unreadable ({error}); the fit starts afresh")
            return None
        if meta.pop("key") != key:
            print(f"{path}: made with other inputs or settings; the fit starts afresh")
            return None

        def part(prefix: str) -> dict[str, np.ndarray]:
            return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}

        print(f"continuing the fit after epoch {meta['epoch']}")
        meta["attempts"] += 1
        return cls(values=part("values."), moments=part("moments."), best_values=part("best."), **meta)


class SpringFit:
    """Runs epochs. The solver is rebuilt only when stiffer springs ask for more substeps."""

    def __init__(self, problem: FitProblem) -> None:
        self.problem = problem
        observations = problem.observations
        self.parameters = SpringParameters(problem.twin, problem.fit.stiffness_range, problem.device)
        self.loss = FrameLoss.of(
            observations, problem.losses, problem.device, frozen_counts=problem.quirks.frozen_loss_denominators
        )
        hands = torch.tensor(observations.controller_points[: observations.scenario.train_end], device=problem.device)
        self.hands = hands
        self.rest = torch.tensor(problem.twin.topology.nodes, device=problem.device)
        self.optimiser = torch.optim.Adam(self.parameters.tensors.values(), lr=problem.fit.learning_rate, betas=problem.fit.betas)
        self.twin = problem.twin
        self._solver: FrameSolver | None = None

    def solver(self) -> FrameSolver:
        """The solver for the present number of substeps."""
        if self._solver is None:
            topology = self.twin.topology
            counts = (len(topology.nodes), len(topology.controllers))
            self._solver = FrameSolver(topology.springs, *counts, self.twin.simulation, device=self.problem.device)
        return self._solver

    def use_substeps(self, count: int) -> None:
        """Integrate with `count` substeps per frame from now on."""
        if count != self.twin.simulation.substeps:
            self.twin = replace(self.twin, simulation=replace(self.twin.simulation, substeps=count))
            self._solver = None

    def settle(self) -> None:
        """See that the present stiffness can be integrated: ask for more substeps where they may grow.

        Raises NonFinite where they may not (a fixed count, the released 667, `max_substeps`) and the bound is passed.
        """
        chosen, frame_time = self.problem.simulation, self.twin.simulation.frame_time
        spectrum = stability.twin_spectrum(self.as_twin(self.parameters.copy()))
        load = spectrum.load(self.twin.simulation.substep)
        # Half of the safety margin is kept for the parameters' way through the next epoch.
        if load < stability.LIMIT * (1 + chosen.safety) / 2:
            return
        count = stability.smallest_safe_substeps(spectrum, frame_time, chosen.safety)
        may_grow = chosen.substeps == "auto" and not self.problem.quirks.frame_time_667
        if may_grow and count <= chosen.max_substeps:
            self.use_substeps(count)
        elif load >= stability.LIMIT:
            raise NonFinite(f"stiffness grew beyond what {self.twin.simulation.substeps} substeps per frame can integrate")

    def as_twin(self, values: dict[str, np.ndarray]) -> Twin:
        """A twin with the given trained values, clamped as they are used."""
        low, high = self.problem.fit.stiffness_range
        stiffness = np.clip(np.exp(values["log_stiffness"].astype(np.float64)), low, high)
        limits = {"elasticity": (0.0, 1.0), "friction": (0.0, 2.0)}
        scalars: dict[str, Any] = {n: float(np.clip(values[n], *limits[n.rpartition("_")[2]])) for n in TRAINED_SCALARS}
        return replace(self.twin, material=replace(self.twin.material, stiffness=stiffness, **scalars))

    def epoch(self) -> tuple[float, float]:
        """One pass; returns the mean frame loss while parameters change, and the largest gradient norm. Raises NonFinite."""
        solver, horizon = self.solver(), self.problem.fit.horizon or len(self.hands) - 1
        x, v = self.rest, torch.zeros_like(self.rest)
        total, largest = 0.0, 0.0
        for start in range(1, len(self.hands), horizon):
            window = range(start, min(start + horizon, len(self.hands)))
            self.optimiser.zero_grad(set_to_none=True)
            packed = self.parameters.pack(self.twin.simulation.substep)
            losses = []
            for frame in window:
                x, v = simulate_frame(solver, packed, x, v, self.hands[frame - 1], self.hands[frame])
                losses.append(self.loss(frame, x))
            mean = torch.stack(losses).mean()
            if not bool(torch.isfinite(mean)):
                raise NonFinite(f"the loss is not finite in frames {window.start} to {window.stop - 1}")
            if mean.requires_grad:
                mean.backward()  # type: ignore[no-untyped-call]
            largest = max(largest, self._step(window))
            total += float(mean.detach()) * len(window)
            x, v = x.detach(), v.detach()
        return total / (len(self.hands) - 1), largest

    def _step(self, window: range) -> float:
        tensors = [tensor for tensor in self.parameters.tensors.values() if tensor.grad is not None]
        norm = torch.nn.utils.get_total_norm([tensor.grad for tensor in tensors])  # type: ignore[misc]
        if not bool(torch.isfinite(norm)):
            raise NonFinite(f"the gradient is not finite in frames {window.start} to {window.stop - 1}")
        limit = self.problem.fit.clip_gradient_norm
        if limit:
            torch.nn.utils.clip_grads_with_norm_(tensors, limit, norm)
        self.optimiser.step()
        return float(norm)

    def moments(self) -> dict[str, np.ndarray]:
        """Adam's state as arrays; empty before the first step."""
        state = self.optimiser.state_dict()["state"]
        return {f"{index}.{name}": value.cpu().numpy().copy() for index, slots in state.items() for name, value in slots.items()}

    def restore(self, values: dict[str, np.ndarray], moments: dict[str, np.ndarray], learning_rate: float) -> None:
        """Set parameters, Adam's state and the learning rate."""
        self.parameters.restore(values)
        state: dict[int, dict[str, torch.Tensor]] = {}
        for name, value in moments.items():
            index, _, slot = name.partition(".")
            state.setdefault(int(index), {})[slot] = torch.from_numpy(value.copy())
        stored = self.optimiser.state_dict()
        stored["state"] = state
        for group in stored["param_groups"]:
            group["lr"] = learning_rate
        self.optimiser.load_state_dict(stored)


def fit(problem: FitProblem, *, partial: Path | None = None, key: str = "") -> FitResult:
    """Fit stiffness per spring. `partial` is where checkpoints go; one with the same `key` is continued from.

    Raises NumericalFailure if no epoch could be completed.
    """
    clock = time.perf_counter()
    run = SpringFit(problem)
    state = _State.load(partial, key)
    if state is None:
        initial = run.parameters.copy()
        substeps = problem.twin.simulation.substeps
        state = _State(0, initial, {}, problem.fit.learning_rate, [], [], -1, initial, substeps)
    earlier = state.seconds
    run.use_substeps(state.substeps)
    run.restore(state.values, state.moments, state.learning_rate)
    progress = Progress(f"fit {problem.observations.scenario.name}", problem.fit.epochs)
    overflow = 0
    while state.epoch < problem.fit.epochs and len(state.rollbacks) < MAX_ROLLBACKS:
        _advance(run, state, problem)
        overflow = max(overflow, run.solver().collision_overflow)
        last = state.history[-1]
        progress.update(state.epoch, f"loss {last['loss']:.3e} m^2" if not last["rolled_back"] else "rolled back")
        if partial is not None and state.epoch % problem.fit.checkpoint_every == 0:
            state.save(partial, key, earlier + time.perf_counter() - clock)
    if state.best_epoch < 0:
        raise NumericalFailure(f"no epoch could be completed: {'; '.join(state.rollbacks)}")
    best = run.as_twin(state.best_values)
    return FitResult(best, pd.DataFrame(state.history), state.best_epoch, state.rollbacks, state.attempts, earlier, overflow)


def _advance(run: SpringFit, state: _State, problem: FitProblem) -> None:
    """One epoch, or its rollback, recorded in `state`. Accepted values can always be integrated with `state.substeps`."""
    row: dict[str, Any] = {"epoch": state.epoch, "learning_rate": state.learning_rate, "rolled_back": False}
    try:
        loss, norm = run.epoch()
        run.settle()
        state.values, state.moments, state.substeps = run.parameters.copy(), run.moments(), run.twin.simulation.substeps
        row |= {"loss": loss, "gradient_norm": norm}
        if _eligible(state.epoch, problem) and loss < _best_loss(state):
            state.best_epoch, state.best_values = state.epoch, state.values
    except NonFinite as failure:
        state.rollbacks.append(f"epoch {state.epoch}: {failure}")
        print(f"rolled back: {state.rollbacks[-1]}; the learning rate is halved")
        state.learning_rate /= 2
        run.restore(state.values, state.moments, state.learning_rate)
        row |= {"loss": None, "gradient_norm": None, "rolled_back": True}
    state.history.append(row)
    state.epoch += 1


def _eligible(epoch: int, problem: FitProblem) -> bool:
    """Whether an epoch may become the best: all of them, or with the released quirk every 20th and the last."""
    last = problem.fit.epochs - 1
    return not problem.quirks.sparse_checkpoints or epoch % RELEASED_CHECKPOINT_EPOCHS == 0 or epoch == last


def _best_loss(state: _State) -> float:
    return float(state.history[state.best_epoch]["loss"]) if state.best_epoch >= 0 else float("inf")
