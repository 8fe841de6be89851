"""One trial of a sweep: search and fit with its settings, and the loss over the tail of the training frames.

Search and fit use the frames before the tail. The trial selects a twin with `fit.selection: tail`; its value is the twin's loss
over the tail, averaged over scenarios. Future frames are removed before anything is computed.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from filelock import FileLock

from neuspring import config
from neuspring.config import Config
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.provenance import code_digest
from neuspring.core.records import StageRecord, canonical, digest_file
from neuspring.extensions.tuning.space import SWEEP_SEED, Plan
from neuspring.stages.search import search as search_stage
from neuspring.twin.fit import FitProblem, NonFinite, fit, start_loss, tail_start


@dataclass(frozen=True)
class TrainingScene:
    """A scenario's training frames, and the file of the frames before its tail."""

    name: str
    training: Observations
    head: Path

    @classmethod
    def of(cls, path: Path, folder: Path) -> TrainingScene:
        """Read observations and write the frames before the tail to `folder`. Raises InputError."""
        observations = Observations.load(path)
        scenario = observations.scenario
        if scenario.train_end < 3:
            rule = "a sweep needs at least two training frames after frame 0"
            raise InputError(f"scenario {scenario.name}", rule, scenario.train_end - 1)
        target = folder / f"{scenario.name}.npz"
        cut(observations, tail_start(scenario.train_end)).save(target)
        return cls(scenario.name, cut(observations, scenario.train_end), target)

    @property
    def digest(self) -> str:
        """SHA-256 of the training frames."""
        parts = [np.ascontiguousarray(value).tobytes() for value in vars(self.training).values() if isinstance(value, np.ndarray)]
        return hashlib.sha256(b"".join([canonical(dataclasses.asdict(self.training.scenario)).encode(), *parts])).hexdigest()


def cut(observations: Observations, end: int) -> Observations:
    """The first `end` frames, all for training. Annotated tracks are removed, because only scores use them."""
    timed = [spec.name for spec in dataclasses.fields(Observations) if spec.metadata.get("shape", ("",))[0] == "T"]
    arrays = {name: getattr(observations, name)[:end] for name in timed}
    arrays["tracks"] = arrays["tracks"][:, :0]
    # Provenance, such as digests of files, depends on later frames.
    return replace(observations, scenario=replace(observations.scenario, frame_count=end, train_end=end, provenance={}), **arrays)


def value_of(trial: optuna.Trial, plan: Plan, scenes: Sequence[TrainingScene], folder: Path, device: str) -> float:
    """Search and fit every scenario with a trial's values; returns the mean loss of their tails, m^2.

    With one scenario, the loss of every epoch is reported to Optuna; with several, the loss of every scenario. Trials share the
    searches in `folder`, the folder of the sweep. Raises TrialPruned, NumericalFailure, and InputError for settings in conflict.
    """
    settings, clusters = plan.at({name: suggest(trial, name, plan) for name in plan.tune.space}, f"trial {trial.number}")
    losses = list[float]()

    def report(step: int, loss: float) -> None:
        trial.report(loss, step)
        if trial.should_prune():
            raise optuna.TrialPruned

    for scene in scenes:
        path = searched(scene, settings, clusters, device, folder)
        record = StageRecord.load(path)
        if record.status == "failed":
            raise NumericalFailure(f"{scene.name}, search: {record.reason}")
        problem = FitProblem(
            observations=scene.training,
            twin=Twin.load(record.file("twin", path)),
            fit=replace(settings.fit, selection="tail"),
            simulation=settings.simulation,
            losses=settings.losses,
            quirks=settings.released_quirks,
            device=device,
            kind=plan.method.fit or "springs",
            seed=SWEEP_SEED,
        )

        def report_epoch(history: Sequence[Mapping[str, Any]]) -> None:
            if len(scenes) == 1 and (loss := history[-1]["rollout_loss"]) is not None:
                report(history[-1]["epoch"], loss)

        try:
            losses.append(fit(problem, on_epoch=report_epoch).rollout_loss if plan.method.fit else start_loss(problem))
        except (NonFinite, NumericalFailure) as failure:
            raise NumericalFailure(f"{scene.name}, fit: {failure}") from failure
        if len(scenes) > 1:
            report(len(losses), losses[-1])
    return sum(losses) / len(losses)


def suggest(trial: optuna.Trial, name: str, plan: Plan) -> Any:
    """The trial's value of a setting."""
    dimension = plan.tune.space[name]
    low, high = dimension.low, dimension.high
    if dimension.choices or low is None or high is None:
        return trial.suggest_categorical(name, dimension.choices)
    if isinstance(plan.baseline[name], int):
        return trial.suggest_int(name, int(low), int(high), step=int(dimension.step or 1), log=dimension.log)
    return trial.suggest_float(name, low, high, step=dimension.step, log=dimension.log)


def searched(scene: TrainingScene, settings: Config, clusters: int, device: str, folder: Path) -> Path:
    """The record of a search on the frames before the tail; the first trial that needs the search runs it."""
    values = {name: config.plain(getattr(settings, name)) for name in ("search", "simulation", "losses", "released_quirks")}
    facts = [scene.name, digest_file(scene.head), values, clusters, device.partition(":")[0], code_digest("neuspring.twin.search")]
    record = folder / f"search-{hashlib.sha256(canonical(facts).encode()).hexdigest()[:16]}" / "search.json"
    record.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(record.with_name(".lock")):
        if not record.is_file():
            search_stage(
                observations=scene.head, settings=settings, clusters=clusters, seed=SWEEP_SEED, device=device, output=record
            )
    return record
