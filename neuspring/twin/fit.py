"""The fit: Adam with gradients through the simulation, for free springs or a neural spring field.

An epoch is one pass over the training frames of each recording, from frame 0. Every `horizon` frames (released: 1; 0: all
training frames), one optimizer step uses the gradient through these frames, unless `solver.AdjointLimit` shortens it. The state
is then detached and continues with the new parameters. Therefore no twin has the mean loss of an epoch, and every ROLLOUT_EVERY
epochs a rollout from frame 0 measures the loss of a twin.

The result starts as the search's twin. A later twin replaces it if its rollout loss is lower by the fraction `plateau`, so no fit
is worse than its search. Rollouts count the frames that are trained on, or a held-back tail of the training frames. A fit ends
when the rollout loss no longer falls. Only an oracle (`FitProblem.oracle`) reads future frames. A non-finite loss or gradient
restores the parameters of the epoch's start, halves the learning rates and is reported.

Gradients are of the loss in squared node spacings (`loss_unit`), so a fit does not depend on the unit of length. Records are in
m^2.

A fit is a generator that yields requests for frames and gradients (batch.py), so several fits can share launches.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, fields
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
from neuspring.physics.lanes import LANE_WIDTH
from neuspring.physics.parameters import Parameters
from neuspring.physics.solver import AdjointLimit
from neuspring.twin.batch import FrameRequest, GradientRequest, SharedFrames, SimulatedTwin, lockstep, result_of, shared_physics
from neuspring.twin.body import FitTask, Learned, body_of
from neuspring.twin.losses import FrameLoss, frames_seen
from neuspring.twin.parameters import TwinParameters, movement, start_values, topology_spacing
from neuspring.twin.rollout import initial_velocity
from neuspring.twin.transfer import move

if TYPE_CHECKING:
    import pandas as pd


BETAS = (0.9, 0.99)
"""Adam's decay rates of the first and the second moment, as released."""
ADJOINT_LIMIT = 100.0
"""Largest adjoint of the state, as a multiple of what the losses add to it, beyond which a gradient stops
(`solver.AdjointLimit`)."""
TAIL_FRACTION = 0.2
"""Fraction of the training frames that `fit.selection: tail` holds back, as in sweeps."""
ROLLOUT_EVERY = 5
"""Epochs between two rollouts. Fits that share launches roll out in the same epochs."""
PLATEAU_EPOCHS = 40
"""Epochs without a better twin after which a fit has converged."""
MOST_GROWTH = 3.0
"""Largest growth of the substeps due to dashpots alone, and due to stiffness alone; both together cause less than fivefold
growth. Without a limit, a few stiff springs would determine the cost of all."""
MAX_ROLLBACKS = 5
RELEASED_CHECKPOINT_EPOCHS = 20


_Motion = tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]
"""x [N, 3] m, v [N, 3] m/s, and rest lengths of grasps that began after frame 0 (controllers.py)."""


class NonFinite(ArithmeticError):
    """A loss or gradient is not finite. The text names the frames."""


@dataclass(frozen=True, kw_only=True)
class FitProblem:
    """All inputs of a fit."""

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
    """Seed of the field's initial weights."""
    oracle: bool = False
    """Fit all frames, future frames included: not a prediction, but the limit of fitting."""
    pool: Sequence[Observations] = ()
    """Other recordings of the object. The fit trains one material on these and `observations`."""

    def __post_init__(self) -> None:
        body = body_of(self.twin)
        body.require_pool(self.observations, self.pool)
        if self.kind not in body.fits:
            raise InputError("fit, kind", f"a {body.name} has the fits {' and '.join(body.fits)}", self.kind, "Choose one.")
        if self.oracle and self.fit.selection == "tail":
            raise InputError("fit.selection", "an oracle fits all frames, so it cannot hold back a tail", "tail", "Use rollout.")

    @property
    def frame_end(self) -> int:
        """Number of frames that the fit reads, from frame 0 on: the training frames; all frames for an oracle."""
        return frames_seen(self.observations, oracle=self.oracle)

    @property
    def frames(self) -> int:
        """Number of frames that an epoch passes over, on all recordings."""
        return sum(frames_seen(seen, oracle=self.oracle) - 1 for seen in (self.observations, *self.pool))


@dataclass(frozen=True, kw_only=True)
class FitResult(Learned):
    """The best twin, and the history: one row per epoch (epoch, loss, rollout_loss, gradient_norm, rolled_back, learning_rate).

    Gradients are of the loss in its unit (`fit.loss_unit`). Facts:

    - best_epoch: the epoch whose end is the result; -1: the search's twin
    - rollout_loss, m^2: of the result
    - running_loss, m^2: mean loss during the best epoch
    - search_loss, m^2: rollout of the search's twin
    - converged, rollbacks, and the shares of `movement`
    """

    history: pd.DataFrame

    @property
    def rollout_loss(self) -> float:
        """Mean loss of the result's rollout, m^2, over the frames that are trained on or the held-back tail."""
        return float(self.facts["rollout_loss"])


@dataclass
class _State:
    """All that a fit needs to resume, besides its history."""

    values: dict[str, np.ndarray]
    moments: dict[str, np.ndarray]
    rate: float
    rollbacks: list[str]
    search_loss: float
    best_epoch: int
    best_loss: float
    best_values: dict[str, np.ndarray]
    best_substeps: int
    substeps: int
    overflow: int = 0

    def converged(self, epochs: int, plateau: float) -> bool:
        """True if the last PLATEAU_EPOCHS of `epochs` epochs found no better twin."""
        return plateau > 0 and epochs > self.best_epoch + PLATEAU_EPOCHS

    def checkpoint(self) -> Checkpoint:
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in FIT_ARRAYS}
        return Checkpoint({name: getattr(self, name) for name in FIT_ARRAYS}, plain)

    @classmethod
    def of(cls, checkpoint: Checkpoint) -> _State:
        arrays: dict[str, Any] = {name: dict(checkpoint.arrays[name]) for name in FIT_ARRAYS}
        return cls(**arrays, **checkpoint.values)


FIT_ARRAYS = ("values", "moments", "best_values")
"""Fields of a state that contain arrays."""


def tail_start(train_end: int) -> int:
    """First held-back frame of `train_end` training frames. At least one frame is trained on, and at least one is held back."""
    return train_end - min(max(round(TAIL_FRACTION * (train_end - 1)), 1), train_end - 2)


class FitRecording:
    """A recording of a fit: its twin, controllers, start and losses."""

    def __init__(self, problem: FitProblem, observations: Observations, twin: Twin) -> None:
        """`twin`: the problem's twin, in frame 0 of the recording."""
        settings, device = problem.fit, problem.device
        end = frames_seen(observations, oracle=problem.oracle)
        if settings.selection == "tail" and end < 3:
            raise InputError("fit.selection", "tail requires at least two training frames after frame 0", end - 1, "Use rollout.")
        self.fitted_end = tail_start(end) if settings.selection == "tail" else end
        self.horizon = settings.horizon or self.fitted_end - 1
        self.source = SimulatedTwin(twin, device, self.horizon)
        self.start = start_values(twin, device)
        """Physical values of the twin before the fit, with the rest lengths of this recording."""
        self.loss = FrameLoss.of(
            *(observations, problem.losses, device), frozen_counts=problem.quirks.frozen_loss_denominators, oracle=problem.oracle
        )
        hands = torch.tensor(observations.controller_points[:end], device=device)
        self.hands = waypoints(hands, observations.controller_valid)
        graph = twin.topology
        self.grips = ControllerSprings(graph.springs, len(graph.nodes), device)
        velocity = initial_velocity(observations, twin.simulation.initial_velocity)
        self.rest: _Motion = (torch.tensor(graph.nodes, device=device), _tensor(velocity, device), None)
        self.safety = problem.simulation.safety
        may_grow = problem.simulation.substeps == "auto" and not problem.quirks.frame_time_667
        self.most_substeps = stability.MAX_SUBSTEPS if may_grow else 0
        self._known: tuple[stability.Spectrum, np.ndarray, np.ndarray] | None = None
        """The last computed spectrum, and its stiffness and dashpots."""

    @property
    def twin(self) -> Twin:
        """The twin, with the current number of substeps."""
        return self.source.twin

    @property
    def judged(self) -> range:
        """The frames that select the twin: the held-back tail, or without a tail those that are trained on."""
        return range(self.fitted_end if self.fitted_end < len(self.hands) else 1, len(self.hands))

    def use_substeps(self, count: int) -> None:
        """Integrate with `count` substeps per frame from now on."""
        if count != self.twin.simulation.substeps:
            self.source.replace(stability.with_substeps(self.twin, count))

    def stable(self, parameters: TwinParameters) -> Parameters:
        """Pack the current parameters and ensure that they can be integrated.

        Raises the number of substeps if necessary. Raises NonFinite if the stability bound is exceeded and the number may not
        grow (a fixed count, the released 667, `MAX_SUBSTEPS`).
        """
        packed = parameters.pack(self.twin.simulation.substep, self.start)
        springs = packed["springs"].detach().double().cpu().numpy()
        if not np.isfinite(springs).all():
            raise NonFinite("a spring's stiffness, rest length or dashpot is not finite")
        count = self._needed_substeps(springs[:, 0] * np.abs(springs[:, 1]), springs[:, 2])
        if count <= self.twin.simulation.substeps:
            return packed
        self.use_substeps(count)
        return parameters.pack(self.twin.simulation.substep, self.start)

    def _needed_substeps(self, stiffness: np.ndarray, dashpot: np.ndarray) -> int:
        """Substeps per frame for stiffness Y / l0 [S] and dashpots [S]. Raises NonFinite."""
        simulation = self.twin.simulation
        # The parameters use the other half of the safety margin until the next check.
        enough = stability.STABILITY_LIMIT * (1 + self.safety) / 2
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
        count = stability.smallest_safe_substeps(spectrum, simulation.frame_time, self.safety)
        if count <= self.most_substeps:
            return count
        if spectrum.load(simulation.substep) >= stability.STABILITY_LIMIT:
            raise NonFinite(f"stiffness grew beyond what {simulation.substeps} substeps per frame can integrate")
        return simulation.substeps

    def frame(
        self, state: _Motion, frame: int, packed: Parameters, limit: AdjointLimit | None = None
    ) -> Generator[Any, Any, _Motion]:
        """Simulate a frame; return the state at its end."""
        x, v, lengths = state
        begin, end = self.hands[frame - 1], self.hands[frame]
        lengths = self.grips.taken(lengths, x, begin)
        if lengths is not None:
            packed = packed | {"springs": self.grips.applied(packed["springs"], lengths)}
        x, v = yield FrameRequest(self.source, packed, x, v, begin, end, limit)
        return x, v, lengths

    def simulate(
        self, state: _Motion, window: range, packed: Parameters, limit: AdjointLimit | None = None
    ) -> Generator[Any, Any, tuple[_Motion, torch.Tensor]]:
        """Simulate the frames of `window`; return the state at their end and their mean loss, m^2."""
        losses = []
        for frame in window:
            state = yield from self.frame(state, frame, packed, limit)
            losses.append(self.loss(frame, state[0]))
        return state, torch.stack(losses).mean()


def _tensor(values: np.ndarray, device: str) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float32, device=device)


class TwinFit:
    """Runs epochs over one or several recordings of an object, with one material and one state of Adam.

    Recordings share stiffness, dashpots, drag and contact. Each has its own controllers, start, frames and rest lengths. The
    recordings take turns. Losses are means over the recordings.
    """

    def __init__(self, problem: FitProblem) -> None:
        self.problem, settings = problem, problem.fit
        self.parameters = TwinParameters(problem.twin, settings, problem.kind, problem.device, problem.seed)
        released, lengths = problem.quirks.frame_time_667, problem.simulation.rest_lengths
        moved = [(seen, move(problem.twin, seen, keep_frame_time=released, rest_lengths=lengths)) for seen in problem.pool]
        self.recordings = [FitRecording(problem, *pair) for pair in [(problem.observations, problem.twin), *moved]]
        if self.recordings[0].most_substeps:
            spectrum = stability.twin_spectrum(problem.twin)
            dampers = 2 * spectrum.damping / (problem.twin.simulation.substep * spectrum.stiffness)
            self.parameters.stiffness_growth = MOST_GROWTH**2 * (1 + dampers)
            self.parameters.dashpot_growth = MOST_GROWTH
        self.trained = list(self.parameters.parameters())
        self.optimizer = torch.optim.Adam(self.parameters.groups(), betas=BETAS, eps=settings.epsilon)
        self.loss_scale = 1.0 if settings.loss_unit == "meter" else topology_spacing(problem.twin.topology) ** -2
        """Loss units per m^2."""

    @property
    def twin(self) -> Twin:
        """The twin on the problem's own recording, with the current number of substeps."""
        return self.recordings[0].twin

    @property
    def collision_overflow(self) -> int:
        """Collision candidates that exceeded the list, summed over all solvers so far."""
        return sum(recording.source.collision_overflow for recording in self.recordings)

    def use_substeps(self, count: int) -> None:
        """Integrate all recordings with `count` substeps per frame from now on."""
        for recording in self.recordings:
            recording.use_substeps(count)

    def require_stable(self) -> None:
        """Use as many substeps as the most demanding recording requires. Raises NonFinite."""
        for recording in self.recordings:
            recording.stable(self.parameters)
        self.use_substeps(max(recording.twin.simulation.substeps for recording in self.recordings))

    def set_rate(self, rate: float) -> None:
        """Set the learning rates to those of the settings times `rate`, which rollbacks halve and decay reduces."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group["base_rate"]

    def epoch(self) -> Generator[Any, Any, dict[str, float]]:
        """Pass once over the frames that are trained on, each recording in turn. Raises NonFinite.

        Returns `loss`, the mean frame loss while parameters change, m^2; `gradient_norm`, the largest norm of a step; and
        `frames_left_out`, the number of frames that `solver.AdjointLimit` omits.
        """
        rows = []
        for recording in self.recordings:
            rows.append((yield from self._pass(recording)))
        return {
            "loss": sum(row["loss"] for row in rows) / len(rows),
            "gradient_norm": max(row["gradient_norm"] for row in rows),
            "frames_left_out": sum(row["frames_left_out"] for row in rows),
        }

    def _pass(self, recording: FitRecording) -> Generator[Any, Any, dict[str, float]]:
        state, end, horizon = recording.rest, recording.fitted_end, recording.horizon
        total, largest, left_out = 0.0, 0.0, 0
        for start in range(1, end, horizon):
            window = range(start, min(start + horizon, end))
            packed = recording.stable(self.parameters)
            # A window of one frame has no limit, as released.
            limit = AdjointLimit(ADJOINT_LIMIT, recording.twin.simulation.frame_time) if horizon > 1 else None
            state, mean = yield from recording.simulate(state, window, packed, limit)
            if not bool(torch.isfinite(mean)):
                raise NonFinite(f"the loss is not finite in frames {window.start} to {window.stop - 1}")
            gradients = [None] * len(self.trained)
            if mean.requires_grad:
                gradients = yield GradientRequest(self.loss_scale * mean, self.trained)
            left_out += limit.left_out if limit is not None else 0
            total += float(mean.detach()) * len(window)
            x, v, lengths = state
            state = (x.detach(), v.detach(), None if lengths is None else lengths.detach())
            largest = max(largest, self._step(window, gradients))
        return {"loss": total / (end - 1), "gradient_norm": largest, "frames_left_out": left_out}

    def rollout_loss(self) -> Generator[Any, Any, float]:
        """Mean loss of the `judged` frames of all recordings, m^2, in rollouts of the current values. Raises NonFinite."""
        losses = []
        for recording in self.recordings:
            packed = {name: value.detach() for name, value in recording.stable(self.parameters).items()}
            state = recording.rest
            for frame in range(1, recording.judged.start):
                state = yield from recording.frame(state, frame, packed)
            _, mean = yield from recording.simulate(state, recording.judged, packed)
            losses.append(float(mean.detach()))
            if not math.isfinite(losses[-1]):
                raise NonFinite("the loss of a rollout is not finite")
        return sum(losses) / len(losses)

    def _step(self, window: range, gradients: Sequence[torch.Tensor | None]) -> float:
        for tensor, gradient in zip(self.trained, gradients, strict=True):
            tensor.grad = gradient
        norm = torch.nn.utils.get_total_norm([gradient for gradient in gradients if gradient is not None])
        if not bool(torch.isfinite(norm)):
            raise NonFinite(f"the gradient is not finite in frames {window.start} to {window.stop - 1}")
        self.optimizer.step()
        return float(norm)

    def restore(self, values: dict[str, np.ndarray], moments: dict[str, np.ndarray]) -> None:
        """Set parameters and Adam's state."""
        self.parameters.restore(values)
        restore_adam(self.optimizer, moments)


OnEpoch = Callable[[Sequence[Mapping[str, Any]]], None]
"""Function of the history so far, called after every epoch and before its checkpoint. An exception ends the fit."""


def fit(problem: FitProblem, *, partial: Path | None = None, key: str = "", on_epoch: OnEpoch = lambda history: None) -> FitResult:
    """Fit a twin.

    `partial` is the file of checkpoints; the fit resumes from a checkpoint with the same `key`. Raises NumericalFailure if no
    epoch could be completed, and the exceptions of `on_epoch`.
    """
    result: FitResult = result_of(lockstep([_course(FitTask(problem, partial, key), on_epoch)], SharedFrames().serve))
    return result


def fit_many(tasks: Sequence[FitTask], most: int = 0) -> list[FitResult | Exception]:
    """Fit several twins; return the result of each task, or the exception that ended it.

    At most `most` fits share launches (0: `LANE_WIDTH` on a CPU, all on a GPU). Fits that share launches have the same physics
    and horizon. On a CPU they also have the same number of frames and the same pool, so that no fit waits for another.
    """
    alike: dict[tuple[Any, ...], list[int]] = {}
    for number, task in enumerate(tasks):
        problem, on_cpu = task.problem, task.problem.device == "cpu"
        pool = tuple(seen.scenario.name for seen in problem.pool)
        always = all(seen.controller_valid.all() for seen in (problem.observations, *problem.pool))
        in_step = (problem.frame_end, pool) if on_cpu else ()
        key = (problem.device, shared_physics(problem.twin, always), problem.fit.horizon, *in_step)
        alike.setdefault(key, []).append(number)
    results: list[FitResult | Exception] = [NumericalFailure("not fitted")] * len(tasks)
    for numbers in alike.values():
        size = most or (LANE_WIDTH if tasks[numbers[0]].problem.device == "cpu" else len(numbers))
        for first in range(0, len(numbers), size):
            batch = numbers[first : first + size]
            courses = [_course(tasks[number], share=1 / len(batch)) for number in batch]
            for number, result in zip(batch, lockstep(courses, SharedFrames().serve), strict=True):
                results[number] = result
    return results


def start_loss(problem: FitProblem) -> float:
    """The loss of a rollout before any epoch, m^2. Raises NonFinite."""
    loss: float = result_of(lockstep([TwinFit(problem).rollout_loss()], SharedFrames().serve))
    return loss


def _course(task: FitTask, on_epoch: OnEpoch = lambda history: None, share: float = 1.0) -> Generator[Any, Any, FitResult]:
    """A fit as a generator of requests for frames and gradients. `share` is the fraction of the time that counts for this fit."""
    import pandas as pd

    problem = task.problem
    label = f"{'oracle ' * problem.oracle}fit {problem.observations.scenario.name}, {problem.kind}, seed {problem.seed}"
    loop = TrainingLoop("the fit", label, problem.fit.epochs, task.partial, task.key, share=share)
    run = TwinFit(problem)
    state = _State.of(loop.restored) if loop.restored else (yield from _start(run, problem))
    overflow = state.overflow
    run.use_substeps(state.substeps)
    run.restore(state.values, state.moments)
    for epoch in loop:
        if len(state.rollbacks) >= MAX_ROLLBACKS or state.converged(len(loop.history), problem.fit.plateau):
            break
        row = yield from _advance(run, state, problem, epoch)
        state.overflow = overflow + run.collision_overflow
        loop.record(row, f"loss {row['loss']:.3e} m^2" if not row["rolled_back"] else "rolled back")
        on_epoch(loop.history)
        loop.save(state.checkpoint)
    if not math.isfinite(state.best_loss):
        raise NumericalFailure(f"no epoch could be completed: {'; '.join(state.rollbacks)}")
    run.parameters.restore(state.best_values)
    run.use_substeps(state.best_substeps)
    loss = state.best_loss
    if problem.fit.selection == "training_loss":
        loss = yield from _rollout_or_infinite(run)
    best = run.parameters.as_twin(run.twin)
    history, figures = pd.DataFrame(loop.history), movement(run.parameters)
    frames, counts = problem.frames, best.counts
    facts = {
        "best_epoch": state.best_epoch,
        # Records cannot contain infinite numbers.
        "search_loss": state.search_loss if math.isfinite(state.search_loss) else None,
        "running_loss": loop.history[state.best_epoch]["loss"] if state.best_epoch >= 0 else None,
        "rollout_loss": loss if math.isfinite(loss) else None,
        "converged": state.converged(len(history), problem.fit.plateau),
        "epochs": len(history),
        "epochs_asked": problem.fit.epochs,
        "rollbacks": state.rollbacks,
        "collision_overflow": state.overflow,
        "frames_left_out": round(int(history["frames_left_out"].sum()) / (len(history) * frames), 4),
        **figures,
        "spring_updates": len(history) * frames * counts["springs"] * counts["substeps"],
        **counts,
    }
    course = history.set_index("epoch")[["loss", "rollout_loss", "gradient_norm", "learning_rate"]]
    # Row -1 is the rollout of the search's twin, before epoch 0.
    course.loc[-1, "rollout_loss"] = facts["search_loss"]
    return FitResult(
        twin=best,
        history=history,
        course=course.sort_index(),
        facts=facts,
        attempts=loop.attempts,
        earlier_seconds=loop.earlier_seconds,
    )


def _start(run: TwinFit, problem: FitProblem) -> Generator[Any, Any, _State]:
    """The state before the first epoch."""
    values, substeps = run.parameters.copy(), problem.twin.simulation.substeps
    # An infinite loss cannot win. If no epoch can be completed either, `fit` raises.
    loss = yield from _rollout_or_infinite(run)
    best = math.inf if problem.fit.selection == "training_loss" else loss
    return _State(values, {}, 1.0, [], loss, -1, best, values, substeps, substeps)


def _rollout_or_infinite(run: TwinFit) -> Generator[Any, Any, float]:
    """The loss of a rollout, m^2; infinite if it is not finite."""
    with contextlib.suppress(NonFinite):
        return (yield from run.rollout_loss())
    return math.inf


def _growth(values: np.ndarray, reference: np.ndarray) -> float:
    """The largest ratio of `values` to `reference` [S], both >= 0; infinite if a value grew from 0."""
    return float((values / np.maximum(reference, 1e-300)).max(initial=0.0))


def _advance(run: TwinFit, state: _State, problem: FitProblem, epoch: int) -> Generator[Any, Any, dict[str, Any]]:
    """Run one epoch, or roll it back, and update `state`; return the epoch's row of the history.

    Accepted values can be integrated with `state.substeps`.
    """
    row: dict[str, Any] = {"epoch": epoch, "rolled_back": False, "loss": None, "rollout_loss": None, "gradient_norm": None}
    row["frames_left_out"] = 0
    run.set_rate(state.rate / (1 + epoch / (problem.fit.decay_epochs or math.inf)))
    row["learning_rate"] = run.optimizer.param_groups[0]["lr"]
    try:
        losses = yield from run.epoch()
        run.require_stable()
        released = problem.fit.selection == "training_loss"
        if not released and ((epoch + 1) % ROLLOUT_EVERY == 0 or epoch == problem.fit.epochs - 1):
            losses["rollout_loss"] = yield from run.rollout_loss()
        state.values, state.moments = run.parameters.copy(), adam_arrays(run.optimizer)
        state.substeps = run.twin.simulation.substeps
        row |= losses
        loss = losses["loss"] if released else losses.get("rollout_loss", math.inf)
        # Rollout losses scatter, so a later twin must be better by more than the scatter.
        least = 0.0 if released else problem.fit.plateau
        if eligible(epoch, problem) and loss < (1 - least) * state.best_loss:
            state.best_loss, state.best_epoch = loss, epoch
            state.best_values, state.best_substeps = state.values, state.substeps
    except NonFinite as failure:
        state.rollbacks.append(f"epoch {epoch}: {failure}")
        print(f"rolled back: {state.rollbacks[-1]}; the learning rates are halved")
        state.rate /= 2
        run.use_substeps(state.substeps)
        run.restore(state.values, state.moments)
        row["rolled_back"] = True
    return row


def eligible(epoch: int, problem: FitProblem) -> bool:
    """True if the epoch may become the best: any epoch, or with the released quirk every 20th and the last."""
    sparse = problem.quirks.sparse_checkpoints and epoch % RELEASED_CHECKPOINT_EPOCHS
    return not sparse or epoch == problem.fit.epochs - 1
