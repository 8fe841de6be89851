"""First-order stage: springs, or a neural spring field, by Adam with gradients through the simulation.

An epoch is one pass over the training frames from rest. Every `horizon` frames (1 as released, 0 for the whole training span) one
optimizer step is made with the gradient through those frames, as far back as `solver.AdjointLimit` lets it; the state is detached
there and goes on while parameters change. The best epoch is the one with the lowest training loss, or the lowest loss of a
held-back tail of the training frames, to which the start counts too. Test frames are never read, but by an oracle
(`FitProblem.oracle`). A non-finite loss or gradient restores the parameters of the epoch's start, halves the learning rates and is
reported.

What is differentiated is the loss in squared node spacings (`loss_unit`), so a fit does not depend on the unit of length; what
is recorded is in m^2.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from neuspring import config
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.checkpoint import Checkpoint, TrainingLoop, adam_arrays, restore_adam
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.physics import stability
from neuspring.physics.controllers import ControllerSprings, waypoints
from neuspring.physics.parameters import Parameters
from neuspring.physics.solver import AdjointLimit, FrameWindow, simulate_frame, solver_for
from neuspring.twin.batch import Lane
from neuspring.twin.body import Learned, body_of
from neuspring.twin.field import NO_POINTS, midpoints
from neuspring.twin.losses import FrameLoss, frames_seen
from neuspring.twin.parameters import TwinParameters, movement, topology_spacing, watched
from neuspring.twin.rollout import initial_velocity
from neuspring.twin.transfer import move

if TYPE_CHECKING:
    import pandas as pd


BETAS = (0.9, 0.99)
"""Adam's decay rates of the first and the second moment, as released."""
TAIL_FRACTION = 0.2
"""Part of the training frames on which nothing is fitted with `fit.selection: tail`, as in sweeps."""
MAX_ROLLBACKS = 5
RELEASED_CHECKPOINT_EPOCHS = 20


_Motion = tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]
"""x [N, 3] m, v [N, 3] m/s, and rest lengths of grips that have begun (controllers.py)."""


class NonFinite(ArithmeticError):
    """A loss or gradient is not finite; says where."""


@dataclass(frozen=True, kw_only=True)
class FitProblem:
    """Everything that a fit is made from."""

    observations: Observations
    twin: Twin
    fit: config.Fit
    simulation: config.SimulationSettings
    losses: config.Losses
    quirks: config.ReleasedQuirks
    device: str = "cpu"
    kind: str = "springs"
    """One of the body's `fits`."""
    seed: int = 0
    """Seed of the field's first weights."""
    oracle: bool = False
    """Fit all frames, the future included: no prediction, but what fitting could reach at best."""
    pool: Sequence[Observations] = ()
    """Other recordings of the object, that one material is fitted on together with `observations`."""
    leave_out: bool = False
    """Fit the pool alone: of `observations` the nodes and hands of frame 0 are read, and no other frame."""

    def __post_init__(self) -> None:
        body = body_of(self.twin)
        body.require_pool(self.observations, self.pool)
        if self.kind not in body.fits:
            raise InputError("fit, kind", f"a {body.name} is fitted as {' or '.join(body.fits)}", self.kind)
        if self.oracle and self.fit.selection == "tail":
            raise InputError("fit.selection", "an oracle is fitted on all frames and holds none back", "tail", "Use training_loss.")

    @property
    def frame_end(self) -> int:
        """Frames that the fit reads, from frame 0 on: those before the split; all of them for an oracle."""
        return frames_seen(self.observations, oracle=self.oracle)

    @property
    def frames(self) -> int:
        """Frames that an epoch passes over, on all recordings that count."""
        counted = (*(() if self.leave_out else (self.observations,)), *self.pool)
        return sum(frames_seen(one, oracle=self.oracle) - 1 for one in counted)


@dataclass(frozen=True, kw_only=True)
class FitResult(Learned):
    """The best twin, and the history: one row per epoch (epoch, loss, tail_loss, gradient_norm, rolled_back, learning_rate).

    Gradients are those of the loss in its unit (`fit.loss_unit`). Facts: best_epoch, whose end is the result (-1: the start);
    best_loss, the training loss or tail loss that selected it, m^2; rollbacks; what moved and what was in the way (`movement`).
    """

    history: pd.DataFrame

    @property
    def best_epoch(self) -> int:
        """Epoch whose end is the result; -1: the start."""
        return int(self.facts["best_epoch"])

    @property
    def best_loss(self) -> float:
        """Training loss or tail loss that selected it, m^2."""
        return float(self.facts["best_loss"])


@dataclass
class _State:
    """Everything that a continued fit needs besides its history."""

    values: dict[str, np.ndarray]
    moments: dict[str, np.ndarray]
    rate: float
    rollbacks: list[str]
    best_epoch: int
    best_loss: float
    best_values: dict[str, np.ndarray]
    best_substeps: int
    substeps: int
    overflow: int = 0
    gradient_over_epsilon: float | None = None
    """Median |gradient| per step over Adam's epsilon, in the first epoch in which the median is not zero."""

    def checkpoint(self) -> Checkpoint:
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in FIT_ARRAYS}
        return Checkpoint({name: getattr(self, name) for name in FIT_ARRAYS}, plain)

    @classmethod
    def of(cls, checkpoint: Checkpoint) -> _State:
        arrays: dict[str, Any] = {name: dict(checkpoint.arrays[name]) for name in FIT_ARRAYS}
        return cls(**arrays, **checkpoint.values)


FIT_ARRAYS = ("values", "moments", "best_values")
"""The fields of a state that hold arrays."""


def tail_start(train_end: int) -> int:
    """The first held-back frame of `train_end` training frames: at least one frame is trained on, and one selects the epoch."""
    return train_end - min(max(round(TAIL_FRACTION * (train_end - 1)), 1), train_end - 2)


class TwinFit:
    """Runs epochs. The solver is rebuilt only when stiffer springs ask for more substeps."""

    def __init__(self, problem: FitProblem, lane: Lane | None = None, beside: np.ndarray = NO_POINTS) -> None:
        """`beside`: as of `TwinParameters`."""
        self.problem, self._lane = problem, lane
        observations, settings = problem.observations, problem.fit
        self.parameters = TwinParameters(problem.twin, settings, problem.kind, problem.device, problem.seed, beside)
        self.loss = FrameLoss.of(
            *(observations, problem.losses, problem.device),
            frozen_counts=problem.quirks.frozen_loss_denominators,
            oracle=problem.oracle,
        )
        end = problem.frame_end
        hands = torch.tensor(observations.controller_points[:end], device=problem.device)
        self.hands = waypoints(hands, observations.controller_valid)
        graph = problem.twin.topology
        self.grips = ControllerSprings(graph.springs, len(graph.nodes), problem.device)
        if settings.selection == "tail" and end < 3:
            raise InputError("fit.selection", "a held-back tail needs at least two training frames after frame 0", end - 1)
        self.fitted_end = tail_start(end) if settings.selection == "tail" else end
        self.horizon = settings.horizon or self.fitted_end - 1
        self.rest = torch.tensor(problem.twin.topology.nodes, device=problem.device)
        velocity = initial_velocity(observations, problem.twin.simulation.initial_velocity)
        self.velocity = torch.tensor(velocity, dtype=torch.float32, device=problem.device)
        self.optimizer = torch.optim.Adam(self.parameters.groups(), betas=BETAS, eps=settings.epsilon)
        self.loss_scale = 1.0 if settings.loss_unit == "meter" else topology_spacing(problem.twin.topology) ** -2
        """Loss units per m^2."""
        self.gradients: list[float] | None = None
        """The median |gradient| of each step is put here, if it is wanted."""
        self.twin = problem.twin
        self._solver: FrameWindow | None = None
        self._overflow = 0
        self._known: tuple[stability.Spectrum, np.ndarray, np.ndarray] | None = None
        """The last spectrum that was computed, and for which stiffness and dashpots."""

    @property
    def one_step(self) -> bool:
        """True where an epoch is a single optimizer step, so that its losses belong to the values before it."""
        return self.horizon >= self.fitted_end - 1

    def solver(self) -> FrameWindow | Lane:
        """The solver for the current number of substeps, or the lane in a shared one."""
        if self._lane:
            # The members of a pool take turns in it.
            return self._lane.of_twin(self.twin, self.horizon)
        if self._solver is None:
            twin, device = self.twin, self.problem.device
            self._solver = FrameWindow(lambda: solver_for(twin, device), self.horizon)
        return self._solver

    @property
    def collision_overflow(self) -> int:
        """Collision candidates that did not fit the list, summed over all solvers so far."""
        if self._lane:
            return self._lane.collision_overflow
        return self._overflow + (self._solver.collision_overflow if self._solver is not None else 0)

    def use_substeps(self, count: int) -> None:
        """Integrate with `count` substeps per frame from now on."""
        if count != self.twin.simulation.substeps:
            self.twin = replace(self.twin, simulation=replace(self.twin.simulation, substeps=count))
            self._overflow, self._solver = self.collision_overflow, None

    def stable_parameters(self) -> Parameters:
        """The present parameters, packed, after seeing that they can be integrated.

        More substeps are taken where they may grow. Raises NonFinite where they may not (a fixed count, the released 667,
        `MAX_SUBSTEPS`) and the bound is passed.
        """
        packed = self.parameters.pack(self.twin.simulation.substep)
        springs = packed["springs"].detach().double().cpu().numpy()
        if not np.isfinite(springs).all():
            raise NonFinite("a spring's stiffness, rest length or dashpot is not finite")
        count = self._needed_substeps(springs[:, 0] * np.abs(springs[:, 1]), springs[:, 2])
        if count <= self.twin.simulation.substeps:
            return packed
        self.use_substeps(count)
        return self.parameters.pack(self.twin.simulation.substep)

    def _needed_substeps(self, stiffness: np.ndarray, dashpot: np.ndarray) -> int:
        """Substeps per frame for stiffness Y / l0 [S] and dashpots [S]. Raises NonFinite."""
        chosen, simulation = self.problem.simulation, self.twin.simulation
        # Half of the safety margin is kept for the parameters' way to the next look.
        enough = stability.STABILITY_LIMIT * (1 + chosen.safety) / 2
        if self._known is not None:
            # K and C grow at most as much as their fastest growing spring (sums of positive semidefinite terms).
            known, k, c = self._known
            grown = stability.Spectrum(known.stiffness * _growth(stiffness, k), known.damping * _growth(dashpot, c), known.node)
            if grown.load(simulation.substep) < enough:
                return simulation.substeps
        topology = self.twin.topology
        graph = topology.springs, topology.nodes, topology.controllers
        spectrum = stability.rest_spectrum(*graph, stiffness, dashpot, self.twin.material.mass)
        self._known = (spectrum, stiffness, dashpot)
        if spectrum.load(simulation.substep) < enough:
            return simulation.substeps
        count = stability.smallest_safe_substeps(spectrum, simulation.frame_time, chosen.safety)
        may_grow = chosen.substeps == "auto" and not self.problem.quirks.frame_time_667
        if may_grow and count <= stability.MAX_SUBSTEPS:
            return count
        if spectrum.load(simulation.substep) >= stability.STABILITY_LIMIT:
            raise NonFinite(f"stiffness grew beyond what {simulation.substeps} substeps per frame can integrate")
        return simulation.substeps

    def set_rate(self, rate: float) -> None:
        """Set the learning rates: the settings' times `rate` (halved by rollbacks)."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group["base_rate"]

    def epoch(self) -> dict[str, float]:
        """One pass over the frames that are trained on; raises NonFinite.

        Returns `loss`, the mean frame loss while parameters change, m^2; `gradient_norm`, the largest of any step;
        `frames_left_out` of gradients; and, if frames are held back and the epoch is one step, their `tail_loss` before it.
        """
        state: _Motion = (self.rest, self.velocity, None)
        total, largest, left_out, row, factor = 0.0, 0.0, 0, {}, self.problem.fit.adjoint_limit
        for start in range(1, self.fitted_end, self.horizon):
            window = range(start, min(start + self.horizon, self.fitted_end))
            self.optimizer.zero_grad(set_to_none=True)
            packed = self.stable_parameters()
            # None where a window is one frame, as released.
            time = self.twin.simulation.frame_time
            limit = AdjointLimit(factor, time) if factor is not None and self.horizon > 1 else None
            state, mean = self._simulate(state, window, packed, limit)
            if not bool(torch.isfinite(mean)):
                raise NonFinite(f"the loss is not finite in frames {window.start} to {window.stop - 1}")
            objective = self.loss_scale * mean + self.parameters.penalty()
            if objective.requires_grad:
                objective.backward()  # type: ignore[no-untyped-call]
            if limit is not None:
                left_out += limit.left_out
            total += float(mean.detach()) * len(window)
            x, v, lengths = state
            state = (x.detach(), v.detach(), None if lengths is None else lengths.detach())
            if self.one_step and self.fitted_end < len(self.hands):
                with torch.no_grad():
                    row["tail_loss"] = float(self._simulate(state, range(self.fitted_end, len(self.hands)), packed)[1])
            largest = max(largest, self._step(window))
        return row | {"loss": total / (self.fitted_end - 1), "gradient_norm": largest, "frames_left_out": left_out}

    def tail_loss(self) -> float:
        """Mean loss of the held-back frames, m^2, in a rollout from rest with the present values. Raises NonFinite."""
        with torch.no_grad():
            packed = self.stable_parameters()
            state: _Motion = (self.rest, self.velocity, None)
            for frame in range(1, self.fitted_end):
                state = self._frame(state, frame, packed)
            loss = float(self._simulate(state, range(self.fitted_end, len(self.hands)), packed)[1])
        if not math.isfinite(loss):
            raise NonFinite("the loss of the held-back frames is not finite")
        return loss

    def _frame(self, state: _Motion, frame: int, packed: Parameters, limit: AdjointLimit | None = None) -> _Motion:
        """State at the end of a frame."""
        x, v, lengths = state
        lengths = self.grips.taken(lengths, x, self.hands[frame - 1])
        if lengths is not None:
            packed = packed | {"springs": self.grips.applied(packed["springs"], lengths)}
        x, v = simulate_frame(self.solver(), packed, x, v, self.hands[frame - 1], self.hands[frame], limit)
        return x, v, lengths

    def _simulate(
        self, state: _Motion, window: range, packed: Parameters, limit: AdjointLimit | None = None
    ) -> tuple[_Motion, torch.Tensor]:
        """State after the frames of `window`, and their mean loss."""
        losses = []
        for frame in window:
            state = self._frame(state, frame, packed, limit)
            losses.append(self.loss(frame, state[0]))
        return state, torch.stack(losses).mean()

    def _step(self, window: range) -> float:
        tensors = [tensor for tensor in self.parameters.parameters() if tensor.grad is not None]
        norm = torch.nn.utils.get_total_norm([tensor.grad for tensor in tensors])  # type: ignore[misc]
        if not bool(torch.isfinite(norm)):
            raise NonFinite(f"the gradient is not finite in frames {window.start} to {window.stop - 1}")
        if self.gradients is not None:
            gradient = watched(self.parameters).grad
            self.gradients.append(0.0 if gradient is None else float(gradient.abs().median()))
        self.optimizer.step()
        return float(norm)

    def restore(self, values: dict[str, np.ndarray], moments: dict[str, np.ndarray]) -> None:
        """Set parameters and Adam's state."""
        self.parameters.restore(values)
        restore_adam(self.optimizer, moments)


class PooledFit(TwinFit):
    """Epochs over several recordings of one object: one material; for each recording its own hands, start and frames.

    An epoch is one pass over each recording in turn, with the same parameters and the same state of Adam. Stiffness, dashpots, drag
    and contact are shared, and so is an estimated shape, as factors on the distances in each recording's rest shape; its
    displacement lives in that of the problem's own recording. Where a recording has other nodes, its shape is laid onto that of the
    problem's own, and the field is read at the midpoints of its springs there: the material is one, as a function of the place in
    the body. All recordings take as many substeps per frame as the one that needs most. Losses are means over the recordings, in
    one unit.
    """

    def __init__(self, problem: FitProblem, lane: Lane | None = None) -> None:
        alone, released = replace(problem, pool=(), leave_out=False), problem.quirks.frame_time_667
        moved = [move(problem.twin, seen, keep_frame_time=released) for seen in problem.pool]
        beside, parts = NO_POINTS, list[slice]()
        for seen, (twin, laid) in zip(problem.pool, moved, strict=True):
            if laid and (problem.kind != "field" or problem.fit.field.offsets):
                rule = "recordings of a pool must have the same nodes where each spring has a number of its own"
                raise InputError(
                    f"pool, {seen.scenario.name}", rule, "others", "Choose a field (model_b_pooled), or sample all alike."
                )
            first = len(problem.twin.topology.springs) + len(beside) if laid else 0
            parts.append(slice(first, first + len(twin.topology.springs)))
            if laid:
                beside = np.concatenate([beside, midpoints(np.concatenate([laid.points, laid.others]), twin.topology.springs)])
        super().__init__(alone, lane, beside)
        own = [] if problem.leave_out else [self._member(alone, self.parameters.part)]
        others = zip(problem.pool, moved, parts, strict=True)
        self._members = own + [self._member(replace(alone, twin=it[0], observations=seen), part) for seen, it, part in others]

    def _member(self, problem: FitProblem, part: slice) -> TwinFit:
        """The fit of one recording, which trains this one's parameters with this one's optimizer."""
        member = TwinFit(problem, self._lane)
        member.parameters = self.parameters.on(member.parameters, part)
        member.optimizer = self.optimizer
        # Frame 0 of each recording has a spacing of its own; a meter must weigh the same in all.
        member.loss_scale = self.loss_scale
        return member

    one_step = False
    """An epoch makes a step per recording at least."""

    @property
    def collision_overflow(self) -> int:
        """The sum over all recordings."""
        return super().collision_overflow if self._lane else sum(member.collision_overflow for member in self._members)

    def use_substeps(self, count: int) -> None:
        """Integrate all recordings with `count` substeps per frame from now on."""
        super().use_substeps(count)
        for member in self._members:
            member.use_substeps(count)

    def stable_parameters(self) -> Parameters:
        """The present parameters, packed, after seeing that they can be integrated on every recording. Raises NonFinite."""
        for member in self._members:
            member.stable_parameters()
        self.use_substeps(max(run.twin.simulation.substeps for run in [self, *self._members]))
        return self.parameters.pack(self.twin.simulation.substep)

    def epoch(self) -> dict[str, float]:
        """As for one recording, each in turn: the mean loss, the largest gradient of any step, all frames left out."""
        for member in self._members:
            member.gradients = self.gradients
        rows = [member.epoch() for member in self._members]
        return {
            "loss": sum(row["loss"] for row in rows) / len(rows),
            "gradient_norm": max(row["gradient_norm"] for row in rows),
            "frames_left_out": sum(row["frames_left_out"] for row in rows),
        }

    def tail_loss(self) -> float:
        """Mean loss of the held-back frames of all recordings, m^2. Raises NonFinite."""
        return sum(member.tail_loss() for member in self._members) / len(self._members)


def fit(
    problem: FitProblem,
    *,
    partial: Path | None = None,
    key: str = "",
    on_epoch: Callable[[Sequence[Mapping[str, Any]]], None] = lambda history: None,
    lane: Lane | None = None,
) -> FitResult:
    """Fit a twin. `partial` is where checkpoints go; one with the same `key` is continued from.

    `on_epoch` is given the history so far after every epoch and before its checkpoint; what it raises ends the fit. With a
    `lane` the simulation shares launches with other fits (batch.py). Raises NumericalFailure if no
    epoch could be completed.
    """
    import pandas as pd

    label = f"{'oracle ' * problem.oracle}fit {problem.observations.scenario.name}, {problem.kind}, seed {problem.seed}"
    share = 1 / len(lane.batch.lanes) if lane else 1.0
    loop = TrainingLoop("the fit", label, problem.fit.epochs, partial, key, share=share)
    run = (PooledFit if problem.pool else TwinFit)(problem, lane)
    state = _State.of(loop.restored) if loop.restored else _start(run, problem)
    overflow = state.overflow
    run.use_substeps(state.substeps)
    run.restore(state.values, state.moments)
    for epoch in loop:
        if len(state.rollbacks) >= MAX_ROLLBACKS:
            break
        row = _advance(run, state, problem, epoch)
        state.overflow = overflow + run.collision_overflow
        loop.record(row, f"loss {row['loss']:.3e} m^2" if not row["rolled_back"] else "rolled back")
        on_epoch(loop.history)
        loop.save(state.checkpoint)
    if not math.isfinite(state.best_loss):
        raise NumericalFailure(f"no epoch could be completed: {'; '.join(state.rollbacks)}")
    run.parameters.restore(state.best_values)
    run.use_substeps(state.best_substeps)
    best = run.parameters.as_twin(run.twin)
    history, figures = pd.DataFrame(loop.history), movement(run.parameters)
    if state.gradient_over_epsilon is not None:
        figures["gradient_over_epsilon"] = state.gradient_over_epsilon
    frames, counts = problem.frames, best.counts
    facts = {
        "best_epoch": state.best_epoch,
        "best_loss": state.best_loss,
        "epochs": len(history),
        "epochs_asked": problem.fit.epochs,
        "epochs_together": loop.epochs_together,
        "earlier_processor_seconds": round(loop.earlier_processor_seconds, 3),
        "rollbacks": state.rollbacks,
        "collision_overflow": state.overflow,
        "frames_left_out": round(int(history["frames_left_out"].sum()) / (len(history) * frames), 4),
        **figures,
        # Epochs that ran together with those of other fits count in the record of `fits`.
        "spring_updates": (len(history) - loop.epochs_together) * frames * counts["springs"] * counts["substeps"],
        **counts,
    }
    return FitResult(
        twin=best,
        history=history,
        course=history.set_index("epoch")[["loss", "tail_loss", "gradient_norm", "learning_rate"]],
        facts=facts,
        attempts=loop.attempts,
        earlier_seconds=loop.earlier_seconds,
    )


def _start(run: TwinFit, problem: FitProblem) -> _State:
    """The state before the first epoch."""
    values, substeps = run.parameters.copy(), problem.twin.simulation.substeps
    state = _State(values, {}, 1.0, [], -1, math.inf, values, substeps, substeps)
    if problem.fit.selection == "tail" and not run.one_step:
        # A start that cannot be simulated does not win; if no epoch can be completed either, `fit` says so.
        with contextlib.suppress(NonFinite):
            state.best_loss = run.tail_loss()
    return state


def _growth(values: np.ndarray, reference: np.ndarray) -> float:
    """The largest ratio of `values` to `reference` [S], both >= 0; infinite where something grew from nothing."""
    ratio = np.divide(values, reference, out=np.where(values > 0, np.inf, 0.0), where=reference > 0)
    return float(ratio.max(initial=0.0))


def _advance(run: TwinFit, state: _State, problem: FitProblem, epoch: int) -> dict[str, Any]:
    """Run one epoch, or roll it back, and update `state`; returns the epoch's row of the history.

    Accepted values can always be integrated with `state.substeps`.
    """
    row: dict[str, Any] = {"epoch": epoch, "rolled_back": False, "loss": None, "tail_loss": None, "gradient_norm": None}
    row["frames_left_out"] = 0
    run.set_rate(state.rate)
    row["learning_rate"] = run.optimizer.param_groups[0]["lr"]
    try:
        before = (state.values, state.substeps)
        run.gradients = [] if state.gradient_over_epsilon is None else None
        losses = run.epoch()
        run.stable_parameters()
        if run.gradients and (median := float(np.median(run.gradients))):
            state.gradient_over_epsilon = median / problem.fit.epsilon
        if problem.fit.selection == "tail" and not run.one_step:
            losses["tail_loss"] = run.tail_loss()
        state.values, state.moments = run.parameters.copy(), adam_arrays(run.optimizer)
        state.substeps = run.twin.simulation.substeps
        row |= losses
        loss = losses["tail_loss" if problem.fit.selection == "tail" else "loss"]
        if eligible(epoch, problem) and loss < state.best_loss:
            state.best_loss, state.best_epoch = loss, epoch - run.one_step
            state.best_values, state.best_substeps = before if run.one_step else (state.values, state.substeps)
    except NonFinite as failure:
        state.rollbacks.append(f"epoch {epoch}: {failure}")
        print(f"rolled back: {state.rollbacks[-1]}; the learning rates are halved")
        state.rate /= 2
        run.use_substeps(state.substeps)
        run.restore(state.values, state.moments)
        row["rolled_back"] = True
    return row


def eligible(epoch: int, problem: FitProblem) -> bool:
    """True for an epoch that may become the best: all of them, or with the released quirk every 20th and the last."""
    sparse = problem.quirks.sparse_checkpoints and epoch % RELEASED_CHECKPOINT_EPOCHS
    return not sparse or epoch == problem.fit.epochs - 1
