"""Coarse twins of one scene or several -> checkpoints of their fits, several in one launch (together.py)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from neuspring.core.records import Recorder
from neuspring.stages import fit as alone
from neuspring.stages.search import launch_size
from neuspring.stages.stage import Rows, Together, Written, stage
from neuspring.stages.together import RowsText, note, physics, rows_of, unfinished
from neuspring.twin.body import BODIES

if TYPE_CHECKING:
    from neuspring.twin.batch import Lane
    from neuspring.twin.fit import FitProblem, FitResult


@dataclass(frozen=True)
class FitJob:
    """A fit that is still to be done."""

    output: str
    problem: FitProblem
    checkpoint: Path
    key: str


def _in_step(rows: Rows) -> tuple[Any, ...] | None:
    """Frames per step, True for an oracle, which goes over all frames and not over those before the split alone, and the pool.

    None for a body that is fitted without gradients.
    """
    row, search = rows.method, rows.search
    if row is None or search is None or not BODIES[search.body].by_gradients:
        return None
    return *physics(rows), rows.config.fit.horizon, row.oracle, row.pool


@stage(
    output="{scenario}/fits-{launch}.json",
    together=Together(stage="fit", key=_in_step, alone=3, given=rows_of),
    gpu=True,
    memory_mb=16000,
    minutes=960,
)
def fits(rows: RowsText, run: Recorder, device: str = "auto", twins_per_launch: int | Literal["auto"] = "auto") -> Written:
    """Coarse twins of one scene or several -> checkpoints of their fits, several in one launch.

    At most `twins_per_launch` fits share launches (auto: as many as pay). Fits whose record is there already, from the same inputs
    and settings, are left alone, and so are those whose search failed. An error in one fit holds nobody up: it is named here, and
    its own `fit` meets it again.
    """
    from neuspring.physics.lanes import LANE_WIDTHS
    from neuspring.twin.batch import run_batch
    from neuspring.twin.fit import FitResult

    errors: dict[str, str] = {}
    given = unfinished(alone.fit, rows, device, errors)
    read = {output: {name: value for name, value in job.arguments.items() if name != "threads"} for output, job in given.items()}
    jobs = [FitJob(output, *alone.prepared(**arguments)) for output, arguments in read.items()]
    on_cpu = device == "cpu"
    batches = batched(jobs, launch_size(twins_per_launch) or (LANE_WIDTHS[-1] if on_cpu else len(jobs)), on_cpu)
    facts: dict[str, Any] = {"fits": list(given), "errors": errors, "spring_updates": 0}
    facts["batches"] = [[job.output for job in batch] for batch in batches]
    for batch in batches:
        results = run_batch([job.problem.twin for job in batch], device, [partial(_fit, job) for job in batch])
        for job, result in zip(batch, results, strict=True):
            if isinstance(result, FitResult):
                counts, epochs = result.twin.counts, result.facts["epochs_together"]
                facts["spring_updates"] += epochs * job.problem.frames * counts["springs"] * counts["substeps"]
            else:
                note(errors, job.output, result)
    return Written(facts=facts)


def batched(jobs: Sequence[FitJob], most: int, on_cpu: bool = True) -> list[list[FitJob]]:
    """Which fits share launches, at most so many: those of equal horizon, with as many frames and the same pool, are in step.

    A GPU is idle enough for those of equal horizon that are not. One alone shares with nobody.
    """
    from neuspring.twin.batch import physics_with

    alike: dict[tuple[Any, ...], list[FitJob]] = {}
    for job in jobs:
        problem = job.problem
        pool = tuple(seen.scenario.name for seen in problem.pool)
        in_step = (problem.frame_end, pool, problem.leave_out) if on_cpu else ()
        always = all(seen.controller_valid.all() for seen in (problem.observations, *problem.pool))
        alike.setdefault((physics_with(problem.twin, always), problem.fit.horizon, *in_step), []).append(job)
    batches = [each[first : first + most] for each in alike.values() for first in range(0, len(each), most)]
    return [batch for batch in batches if len(batch) > 1]


def _fit(job: FitJob, lane: Lane) -> FitResult:
    from neuspring.twin.fit import fit

    job.checkpoint.parent.mkdir(parents=True, exist_ok=True)
    return fit(job.problem, partial=job.checkpoint, key=job.key, lane=lane)
