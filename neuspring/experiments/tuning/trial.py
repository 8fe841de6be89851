"""One trial of a study: search and fit with its settings, judged by the tail of the training frames, which neither has seen.

The last `fit.tail_fraction` of a scenario's training frames are held back. The search sees the frames before them only; the fit
trains on those, and after every epoch its twin is rolled out over the tail. A trial's value is the tail's mean loss of the twin
that the method's own rule (`fit.selection`) would choose, averaged over scenarios. Everything after the training frames is cut
off before anything is computed.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from neuspring import config
from neuspring.config import Config
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.files import write_text
from neuspring.core.provenance import code_digest
from neuspring.core.records import StageRecord, canonical, digest_file
from neuspring.experiments.tuning.space import Plan
from neuspring.stages import search as search_stage
from neuspring.twin.fit import RELEASED_CHECKPOINT_EPOCHS, FitProblem, NonFinite, TwinFit, fit

Report = Callable[[int, float, str], None]
"""Receives a step, the mean loss of the scenarios begun so far, m^2, and what was just done."""


@dataclass(frozen=True)
class Scene:
    """A scenario's training frames, and the file of those before its tail."""

    name: str
    training: Observations
    head: Path

    @classmethod
    def of(cls, path: Path, tail_fraction: float, folder: Path) -> Scene:
        """Read observations; the frames before the tail are written to `folder`. Raises InputError."""
        observations = Observations.load(path)
        scenario = observations.scenario
        if scenario.train_end < 3:
            rule = "a held-back tail needs at least two training frames after frame 0"
            raise InputError(f"scenario {scenario.name}", rule, scenario.train_end - 1)
        head = cut(observations, head_end(scenario.train_end, tail_fraction))
        target = folder / f"{scenario.name}.npz"
        head.save(target)
        return cls(scenario.name, cut(observations, scenario.train_end), target)

    @property
    def digest(self) -> str:
        """SHA-256 of the training frames."""
        parts = [np.ascontiguousarray(value).tobytes() for value in vars(self.training).values() if isinstance(value, np.ndarray)]
        return hashlib.sha256(b"".join([canonical(dataclasses.asdict(self.training.scenario)).encode(), *parts])).hexdigest()


def cut(observations: Observations, end: int) -> Observations:
    """The first `end` frames, all for training. Annotated tracks are for scoring and left out."""
    timed = [spec.name for spec in dataclasses.fields(Observations) if spec.metadata.get("shape", ("",))[0] == "T"]
    arrays = {name: getattr(observations, name)[:end] for name in timed}
    arrays["tracks"] = arrays["tracks"][:, :0]
    # What the reader noted, such as digests of files, depends on later frames.
    return replace(observations, scenario=replace(observations.scenario, frame_count=end, train_end=end, provenance={}), **arrays)


def head_end(train_end: int, tail_fraction: float) -> int:
    """The first held-back frame: that of `TwinFit`, which a test compares."""
    return train_end - min(max(round(tail_fraction * (train_end - 1)), 1), train_end - 2)


@dataclass
class Outcome:
    """What a trial found so far."""

    losses: dict[str, float] = field(default_factory=dict)
    """Scenario -> loss of its tail, m^2."""
    seconds: dict[str, float] = field(default_factory=lambda: {"search": 0.0, "fit": 0.0})
    """Wall time; searches that an earlier trial made take none."""

    @contextlib.contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Count what is done inside."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] += time.perf_counter() - began

    @property
    def value(self) -> float:
        """The mean over scenarios, m^2."""
        return sum(self.losses.values()) / len(self.losses)


def run(
    plan: Plan,
    values: Mapping[str, Any],
    scenes: Sequence[Scene],
    folder: Path,
    slot: int,
    device: str,
    report: Report,
    outcome: Outcome,
) -> None:
    """Search and fit every scenario with a trial's values, and put what was found into `outcome`. What `report` raises ends it.

    `folder` is the study's: searches in it are shared by trials, checkpoints of the slot's fits are continued from. Raises
    NumericalFailure and, for settings that exclude each other or the data, InputError.
    """
    settings, clusters = plan.at(values, f"trial {slot}")
    # Whatever selects the epoch, every epoch's loss of the tail is wanted.
    tailed = replace(settings, fit=replace(settings.fit, selection="tail"))
    for index, scene in enumerate(scenes):
        with outcome.timed("search"):
            path = searched(scene, settings, clusters, plan.tune.seed, device, folder)
        record = StageRecord.load(path)
        if record.status == "failed":
            raise NumericalFailure(f"{scene.name}, search: {record.reason}")
        twin = Twin.load(record.file("twin", path))
        sections = (tailed.fit, tailed.simulation, tailed.losses, tailed.released_quirks)
        problem = FitProblem(scene.training, twin, *sections, device, plan.method.fit or "springs", plan.tune.seed)

        def said(epoch: int, loss: float, name: str = scene.name, first: int = index * plan.epochs) -> None:
            mean = (sum(outcome.losses.values()) + loss) / (len(outcome.losses) + 1)
            report(first + epoch, mean, f"{name}, epoch {epoch}")

        try:
            with outcome.timed("fit"):
                if plan.method.fit is None:
                    loss = TwinFit(problem).tail_loss()
                    said(0, loss)
                else:
                    key = _key(problem, record.files["twin"][1], device)
                    loss = _fitted(problem, settings, checkpoint(folder, slot, scene.name), key, said)
        except (NonFinite, NumericalFailure) as failure:
            raise NumericalFailure(f"{scene.name}, fit: {failure}") from failure
        outcome.losses[scene.name] = loss


def searched(scene: Scene, settings: Config, clusters: int, seed: int, device: str, folder: Path) -> Path:
    """The record of a search on the frames before the tail, made by the first trial that needs it."""
    from filelock import FileLock

    values = {name: config.plain(getattr(settings, name)) for name in ("search", "simulation", "losses", "released_quirks")}
    if clusters == 1:
        for name in ("clusters", "tied_rollouts", "freed_sigma"):
            del values["search"][name]
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
            write_text(
                place / "settings.json", json.dumps({"scenario": scene.name, "clusters": clusters, **values}, indent=1) + "\n"
            )
            search_stage.run(scene.head, settings, clusters, seed, device, record)
    return record


def checkpoint(folder: Path, slot: int, scene: str) -> Path:
    """Where a slot's fit can be continued from."""
    return folder / "trials" / str(slot) / f"{scene}.partial.npz"


def _key(problem: FitProblem, twin: str, device: str) -> str:
    """What a checkpoint must match to be continued from."""
    sections = [config.plain(part) for part in (problem.fit, problem.simulation, problem.losses, problem.quirks)]
    facts = [sections, problem.kind, problem.seed, twin, device.partition(":")[0], code_digest("neuspring.twin.fit")]
    return hashlib.sha256(canonical(facts).encode()).hexdigest()


def _fitted(problem: FitProblem, settings: Config, partial: Path, key: str, said: Callable[[int, float], None]) -> float:
    """The tail's loss of the twin that `settings.fit.selection` chooses."""
    by = "tail_loss" if settings.fit.selection == "tail" else "loss"
    least, chosen, seen = math.inf, math.inf, 0

    def see(history: Sequence[Mapping[str, Any]]) -> None:
        nonlocal least, chosen, seen
        for row in history[seen:]:
            seen += 1
            if row["rolled_back"]:
                continue
            last = row["epoch"] == settings.fit.epochs - 1
            sparse = settings.released_quirks.sparse_checkpoints and row["epoch"] % RELEASED_CHECKPOINT_EPOCHS and not last
            if row[by] < least and not sparse:
                least, chosen = row[by], row["tail_loss"]
            if math.isfinite(chosen):
                said(row["epoch"], chosen)

    result = fit(problem, partial=partial, key=key, on_epoch=see)
    # A fit that was complete when its worker was killed has no further epoch.
    see(result.history.to_dict("records"))  # type: ignore[arg-type]
    if by == "tail_loss":
        # The start may be best.
        return result.best_loss
    if not math.isfinite(chosen):
        raise NumericalFailure(f"no epoch with a finite loss of the held-back frames; rolled back: {'; '.join(result.rollbacks)}")
    return chosen
