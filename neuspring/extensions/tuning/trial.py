"""One trial of a sweep: search and fit with its settings, judged by a tail of the training frames, which neither has seen.

The tail is the last fifth of a scenario's training frames. Search and fit see only the frames before it. After every
epoch of the fit its twin is rolled out over the tail. A trial's value is the mean loss over the tail of the twin that the method's
own rule (`fit.selection`) selects, averaged over scenarios. All frames after the training frames are cut off before anything is
computed.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neuspring import config
from neuspring.config import Config
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.provenance import code_digest
from neuspring.core.records import StageRecord, canonical, digest_file
from neuspring.extensions.tuning.space import SWEEP_SEED, Plan
from neuspring.stages.search import search as search_stage
from neuspring.twin.fit import RELEASED_CHECKPOINT_EPOCHS, FitProblem, NonFinite, TwinFit, fit, tail_start

Report = Callable[[int, float, str], None]
"""Receives a step, the mean loss of the scenarios begun so far, m^2, and what was just done."""


@dataclass(frozen=True)
class TrainingScene:
    """A scenario's training frames, and the file of those before its tail."""

    name: str
    training: Observations
    head: Path

    @classmethod
    def of(cls, path: Path, folder: Path) -> TrainingScene:
        """Read observations; the frames before the tail are written to `folder`. Raises InputError."""
        observations = Observations.load(path)
        scenario = observations.scenario
        if scenario.train_end < 3:
            rule = "a tail needs at least two training frames after frame 0"
            raise InputError(f"scenario {scenario.name}", rule, scenario.train_end - 1)
        head = cut(observations, tail_start(scenario.train_end))
        target = folder / f"{scenario.name}.npz"
        head.save(target)
        return cls(scenario.name, cut(observations, scenario.train_end), target)

    @property
    def digest(self) -> str:
        """SHA-256 of the training frames."""
        parts = [np.ascontiguousarray(value).tobytes() for value in vars(self.training).values() if isinstance(value, np.ndarray)]
        return hashlib.sha256(b"".join([canonical(dataclasses.asdict(self.training.scenario)).encode(), *parts])).hexdigest()


def cut(observations: Observations, end: int) -> Observations:
    """The first `end` frames, all for training, without annotated tracks, which are for scoring."""
    timed = [spec.name for spec in dataclasses.fields(Observations) if spec.metadata.get("shape", ("",))[0] == "T"]
    arrays = {name: getattr(observations, name)[:end] for name in timed}
    arrays["tracks"] = arrays["tracks"][:, :0]
    # The reader's notes, such as digests of files, depend on later frames.
    return replace(observations, scenario=replace(observations.scenario, frame_count=end, train_end=end, provenance={}), **arrays)


def run(
    plan: Plan,
    values: Mapping[str, Any],
    scenes: Sequence[TrainingScene],
    folder: Path,
    number: int,
    device: str,
    report: Report,
    losses: dict[str, float],
) -> None:
    """Search and fit every scenario with a trial's values; `losses` receives the loss of each one's tail, m^2.

    `folder` is the sweep's. Trials share the searches in it, and the fits continue from the checkpoints of trial `number`. Raises
    what `report` raises; NumericalFailure; InputError for settings that exclude each other or do not fit the data.
    """
    settings, clusters = plan.at(values, f"trial {number}")
    # The loss over the tail is needed after every epoch, whichever rule selects one.
    tailed = replace(settings, fit=replace(settings.fit, selection="tail"))
    for index, scene in enumerate(scenes):
        path = searched(scene, settings, clusters, SWEEP_SEED, device, folder)
        record = StageRecord.load(path)
        if record.status == "failed":
            raise NumericalFailure(f"{scene.name}, search: {record.reason}")
        twin = Twin.load(record.file("twin", path))
        problem = FitProblem(
            observations=scene.training,
            twin=twin,
            fit=tailed.fit,
            simulation=tailed.simulation,
            losses=tailed.losses,
            quirks=tailed.released_quirks,
            device=device,
            kind=plan.method.fit or "springs",
            seed=SWEEP_SEED,
        )

        def report_epoch(epoch: int, loss: float, name: str = scene.name, first: int = index * plan.epochs) -> None:
            mean = (sum(losses.values()) + loss) / (len(losses) + 1)
            report(first + epoch, mean, f"{name}, epoch {epoch}")

        try:
            if plan.method.fit is None:
                loss = TwinFit(problem).tail_loss()
                report_epoch(0, loss)
            else:
                key = _key(problem, record.files["twin"][1], device)
                loss = _fitted(problem, settings, folder / "trials" / str(number) / f"{scene.name}.partial.npz", key, report_epoch)
        except (NonFinite, NumericalFailure) as failure:
            raise NumericalFailure(f"{scene.name}, fit: {failure}") from failure
        losses[scene.name] = loss


def searched(scene: TrainingScene, settings: Config, clusters: int, seed: int, device: str, folder: Path) -> Path:
    """The record of a search on the frames before the tail. The first trial that needs the search makes it."""
    from filelock import FileLock

    values = {name: config.plain(getattr(settings, name)) for name in ("search", "simulation", "losses", "released_quirks")}
    facts = [
        scene.name,
        digest_file(scene.head),
        values,
        clusters,
        seed,
        device.partition(":")[0],
        code_digest("neuspring.twin.search"),
    ]
    place = folder / f"search-{hashlib.sha256(canonical(facts).encode()).hexdigest()[:16]}"
    place.mkdir(parents=True, exist_ok=True)
    record = place / "search.json"
    with FileLock(place / ".lock"):
        if not record.is_file():
            search_stage(observations=scene.head, settings=settings, clusters=clusters, seed=seed, device=device, output=record)
    return record


def _key(problem: FitProblem, twin: str, device: str) -> str:
    """Digest of everything that must be equal for a fit to continue from a checkpoint."""
    sections = [config.plain(part) for part in (problem.fit, problem.simulation, problem.losses, problem.quirks)]
    facts = [sections, problem.kind, problem.seed, twin, device.partition(":")[0], code_digest("neuspring.twin.fit")]
    return hashlib.sha256(canonical(facts).encode()).hexdigest()


def _fitted(problem: FitProblem, settings: Config, partial: Path, key: str, report: Callable[[int, float], None]) -> float:
    """The loss over the tail of the twin that `settings.fit.selection` selects."""
    by = "tail_loss" if settings.fit.selection == "tail" else "loss"
    least, selected, count = math.inf, math.inf, 0

    def see(history: Sequence[Mapping[str, Any]]) -> None:
        nonlocal least, selected, count
        for row in history[count:]:
            count += 1
            if row["rolled_back"]:
                continue
            last = row["epoch"] == settings.fit.epochs - 1
            sparse = settings.released_quirks.sparse_checkpoints and row["epoch"] % RELEASED_CHECKPOINT_EPOCHS and not last
            if row[by] < least and not sparse:
                least, selected = row[by], row["tail_loss"]
            if math.isfinite(selected):
                report(row["epoch"], selected)

    result = fit(problem, partial=partial, key=key, on_epoch=see)
    # A fit that was complete when its worker was killed has no further epoch.
    see(result.history.to_dict("records"))  # type: ignore[arg-type]
    if by == "tail_loss":
        # The start may be best.
        return float(result.facts["best_loss"])
    if not math.isfinite(selected):
        raise NumericalFailure(f"no epoch with a finite loss over the tail; rolled back: {'; '.join(result.facts['rollbacks'])}")
    return selected
