"""Coarse twins of one scenario -> checkpoints of their fits, several in one launch.

Fits of one scenario (rows and seeds) take much less time together than one after the other. Each leaves the checkpoint that it
would leave alone, and `fit` then continues from there: to its end, if nothing went wrong. So this stage makes no result of its own.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from neuspring import config
from neuspring.config.parse import json_value
from neuspring.config.settings import read_settings
from neuspring.core.artifacts import Observations
from neuspring.core.records import Recorder, StageRecord
from neuspring.stages import fit as alone
from neuspring.stages.search import launch_size
from neuspring.stages.stage import Job, Member, Rows, Together, Written, stage
from neuspring.twin.body import BODIES

if TYPE_CHECKING:
    from neuspring.twin.batch import Lane
    from neuspring.twin.fit import FitProblem, FitResult


@dataclass(frozen=True, kw_only=True)
class FitRow:
    """The fits of one row of the method table: the arguments of their `neuspring fit`."""

    fits: dict[str, str]
    """Record to write -> search.json to start from."""
    kind: str = "springs"
    settings: str = "{}"
    oracle: bool = False
    pool: tuple[str, ...] = ()
    leave_out: bool = False


@dataclass(frozen=True)
class FitJob:
    """A fit that is still to be done."""

    output: str
    problem: FitProblem
    checkpoint: Path
    key: str


def _in_step(rows: Rows) -> tuple[int, bool, str | None] | None:
    """Frames per step, True for an oracle, which goes over all frames and not over those before the split alone, and the pool.

    None for a body that is fitted without gradients.
    """
    row, search = rows.method, rows.search
    if row is None or search is None or not BODIES[search.body].by_gradients:
        return None
    return rows.config.fit.horizon, row.oracle, row.pool


def _rows(members: Sequence[Member]) -> dict[str, str]:
    rows: dict[str, dict[str, Any]] = {}
    for one in members:
        row = {name: one.options[name] for name in ("kind", "oracle", "leave_out")} | {"settings": one.settings, "fits": {}}
        row["pool"] = one.inputs.get("pool", [])
        rows.setdefault(one.method, row)["fits"][one.output] = one.inputs["search"]
    return {"rows": json.dumps(list(rows.values()), sort_keys=True)}


@stage(
    output="{scenario}/fits.json",
    together=Together(stage="fit", key=_in_step, least=3, given=_rows),
    gpu=True,
    memory_mb=16000,
    minutes=960,
)
def fits(
    observations: Observations,
    rows: Annotated[str, 'JSON list [{"fits": {fit.json: search.json}, "settings": as of `fit`, and options of `fit`}, ...]'],
    run: Recorder,
    device: str = "auto",
    twins_per_launch: int | Literal["auto"] = "auto",
) -> Written:
    """Coarse twins of a scenario -> checkpoints of their fits, several in one launch.

    At most `twins_per_launch` fits share launches (auto: as many as pay). Fits whose record is there already, from the same inputs
    and settings, are left alone, and so are those whose search failed. An error in one fit holds nobody up: it is named here, and
    its own `fit` meets it again.
    """
    from neuspring.physics.lanes import LANE_WIDTHS
    from neuspring.twin.batch import run_batch
    from neuspring.twin.fit import FitResult

    asked = [config.parse(FitRow, row, f"--rows, entry {place}") for place, row in enumerate(json_value("--rows", rows, list))]
    jobs = [job for row in asked for job in _jobs(run.input_paths["observations"], row, device)]
    facts: dict[str, Any] = {"fits": sum(len(row.fits) for row in asked), "errors": {}, "spring_updates": 0}
    batches = batched(jobs, launch_size(twins_per_launch) or (LANE_WIDTHS[-1] if device == "cpu" else len(jobs)))
    facts["batches"] = [[job.output for job in batch] for batch in batches]
    for batch in batches:
        results = run_batch([job.problem.twin for job in batch], device, [partial(_fit, job) for job in batch])
        for job, result in zip(batch, results, strict=True):
            if isinstance(result, FitResult):
                counts, epochs = result.twin.counts, result.facts["epochs_together"]
                facts["spring_updates"] += epochs * job.problem.frames * counts["springs"] * counts["substeps"]
            else:
                facts["errors"][job.output] = f"{type(result).__name__}: {result}"
                print(f"{job.output}: {facts['errors'][job.output]}; its own job goes on from its last checkpoint")
    return Written(facts=facts)


def _jobs(observations: Path, row: FitRow, device: str) -> Iterator[FitJob]:
    given: dict[str, Any] = {name: getattr(row, name) for name in ("kind", "oracle", "pool", "leave_out")}
    given |= {"settings": read_settings(row.settings), "device": device}
    for output, search in row.fits.items():
        job = alone.fit.job(output=Path(output), observations=observations, search=Path(search), **given)
        if not (job.failed or _is_done(job)):
            read = {name: value for name, value in job.arguments.items() if name != "threads"}
            yield FitJob(output, *alone.prepared(**read))


def batched(jobs: Sequence[FitJob], most: int) -> list[list[FitJob]]:
    """Which fits share launches, at most so many: those of equal horizon, with as many frames and the same pool, are in step.

    One alone shares with nobody.
    """
    in_step: dict[tuple[Any, ...], list[FitJob]] = {}
    for job in jobs:
        problem = job.problem
        pool = tuple(seen.scenario.name for seen in problem.pool)
        in_step.setdefault((problem.fit.horizon, problem.frame_end, pool, problem.leave_out), []).append(job)
    batches = [alike[first : first + most] for alike in in_step.values() for first in range(0, len(alike), most)]
    return [batch for batch in batches if len(batch) > 1]


def _fit(job: FitJob, lane: Lane) -> FitResult:
    from neuspring.twin.fit import fit

    job.checkpoint.parent.mkdir(parents=True, exist_ok=True)
    return fit(job.problem, partial=job.checkpoint, key=job.key, lane=lane)


def _is_done(job: Job) -> bool:
    """True where the fit's record is there, made of the same inputs and settings."""
    own = job.record
    if own is None or not own.output.is_file():
        return False
    record = StageRecord.load(own.output)
    return (record.inputs, record.settings) == (own.inputs, json.loads(json.dumps(own.settings)))
