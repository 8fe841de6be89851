"""Searches of several scenes -> their traces, several in one launch (together.py)."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from neuspring.core.records import Recorder
from neuspring.stages import search as alone
from neuspring.stages.stage import Job, Rows, Together, Written, stage
from neuspring.stages.together import RowsText, note, physics, rows_of, unfinished
from neuspring.twin.body import BODIES

if TYPE_CHECKING:
    from neuspring.twin.batch import SearchLane
    from neuspring.twin.body import Learned


def _alike(rows: Rows) -> tuple[Any, ...] | None:
    """None for a body whose search has no launches to share; those of one number of candidates end at about the same time."""
    search = rows.search
    return (*physics(rows), rows.config.search.rollouts) if search and BODIES[search.body].by_gradients else None


@stage(
    output="{scenario}/searches-{launch}.json",
    together=Together(stage="search", key=_alike, given=rows_of),
    gpu=True,
    memory_mb=16000,
    minutes=960,
)
def searches(rows: RowsText, run: Recorder, device: str = "auto", twins_per_launch: int | Literal["auto"] = "auto") -> Written:
    """Searches of several scenes -> their traces, several in one launch.

    Generations are simulated together (auto: all candidates of each search; else at most so many of each). Searches whose record is
    there already, from the same inputs and settings, are left alone. An error in one search holds nobody up.
    """
    from neuspring.twin.batch import run_searches

    errors: dict[str, str] = {}
    jobs = unfinished(alone.search, rows, device, errors)
    if jobs:
        works = [partial(_search, job, twins_per_launch) for job in jobs.values()]
        for output, result in zip(jobs, run_searches(device, works), strict=True):
            if isinstance(result, Exception):
                note(errors, output, result)
    return Written(facts={"searches": list(jobs), "errors": errors})


def _search(job: Job, twins_per_launch: int | Literal["auto"], lane: SearchLane) -> Learned:
    given = job.arguments
    options = alone.prepared(**given | {"threads": 1, "twins_per_launch": twins_per_launch}, lane=lane)
    return BODIES[given["body"]].search(given["observations"], given["pool"] or (), given["settings"], options)
