"""Stage `search`: observations -> twin, with CMA-ES."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from neuspring.config import Config, Search
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.core.records import Recorder
from neuspring.stages.stage import Job, Rows, Written, physics, stage
from neuspring.twin.body import BODIES, Learned, SearchOptions, SearchTask, code

READS = ("search", "simulation", "losses", "released_quirks")


def _settled(rows: Rows) -> Config:
    """The configuration with default `tied_rollouts` for one region, which has no regions to tie."""
    if rows.search is None or rows.search.clusters != 1:
        return rows.config
    return dataclasses.replace(rows.config, search=dataclasses.replace(rows.config.search, tied_rollouts=Search().tied_rollouts))


def _given(rows: Rows) -> dict[str, Any]:
    if rows.search is None:
        return {}
    return {"clusters": rows.search.clusters, "body": rows.search.body}


def _alike(rows: Rows) -> tuple[Any, ...] | None:
    """Key of searches that can share launches; with equal budgets they end at about the same time.

    None for a body whose search has no launches.
    """
    search = rows.search
    return (*physics(rows), search.body, rows.config.search.rollouts) if search and BODIES[search.body].by_gradients else None


def _many(jobs: Sequence[Job]) -> list[Written | Exception]:
    """Run several searches of one body, whose generations share launches."""
    tasks = []
    for job in jobs:
        given = job.arguments
        names = ("settings", "run", "clusters", "seed", "device", "twins_per_launch")
        options = prepared(**{name: given[name] for name in names}, threads=1)
        tasks.append(SearchTask(given["observations"], given["pool"] or (), given["settings"], options))
    results = BODIES[jobs[0].arguments["body"]].search_many(tasks)
    return [made if isinstance(made, Exception) else written(job.record, made) for job, made in zip(jobs, results, strict=True)]


@stage(
    output="{scenario}/search-{search}/{seed}/search.json",
    reads=lambda settings, given: (*READS, *BODIES[given["body"]].reads),
    code=lambda settings, given: code(given["body"]),
    gpu=True,
    memory_mb=8000,
    minutes=240,
    when=lambda rows: rows.search is not None,
    given=_given,
    settled=_settled,
    alike=_alike,
    many=_many,
)
def search(
    observations: Observations,
    settings: Config,
    run: Recorder,
    pool: Sequence[Observations] = (),
    clusters: int = 1,
    body: Annotated[str, "lattice, or the body of a package"] = "lattice",
    seed: int = 0,
    device: str = "auto",
    threads: int = 1,
    twins_per_launch: int | Literal["auto"] = "auto",
) -> Written:
    """Observations -> twin, with CMA-ES: twin.npz, trace.parquet (all candidates with cost and variables), history.parquet.

    - `clusters`: number of regions with their own values; 1: uniform.
    - `twins_per_launch`: maximum number of candidates per launch; auto: the fastest number. On a CPU, `threads` launches run at
      the same time, and neither option changes a result.
    - `pool`: other recordings; the cost of a candidate is the mean over all recordings.
    - `body`: the body of a package may use another search and other columns in its trace.

    The search resumes from its trace, so increasing `search.rollouts` costs only the additional rollouts.
    """
    options = prepared(settings, run, clusters, seed, device, threads, twins_per_launch)
    return written(run, BODIES[body].search(observations, pool, settings, options))


def written(run: Recorder, result: Learned) -> Written:
    """Write the files of a search."""
    from neuspring.core.files import write_history

    files = run.beside(twin="twin.npz", trace="trace.parquet", history="history.parquet")
    result.twin.save(files["twin"])
    write_history(result.course.index, dict(result.course), files["history"])
    return Written(files=files, facts=result.facts, attempts=result.attempts, earlier_seconds=result.earlier_seconds)


def prepared(
    settings: Config,
    run: Recorder,
    clusters: int,
    seed: int,
    device: str,
    threads: int,
    twins_per_launch: int | Literal["auto"],
) -> SearchOptions:
    """Options of a search, with the path of its trace and the trace's key. Raises InputError."""
    from neuspring.core.checkpoint import checkpoint_key

    if threads < 1:
        raise InputError("--threads", "must be at least 1", threads)
    # The key excludes the budget: a search with a larger budget starts with the same candidates.
    without_budget = {name: value for name, value in run.settings["search"].items() if name != "rollouts"}
    return SearchOptions(
        clusters=clusters,
        seed=seed,
        device=device,
        threads=threads,
        together=launch_size(twins_per_launch),
        record=run.beside(trace="trace.parquet")["trace"],
        key=checkpoint_key(run.inputs, run.settings | {"search": without_budget}, device, "neuspring.twin.search"),
    )


def launch_size(twins_per_launch: int | Literal["auto"]) -> int:
    """Maximum number of twins per launch; 0: the fastest number on the device. Raises InputError."""
    if twins_per_launch == "auto":
        return 0
    if not isinstance(twins_per_launch, int) or twins_per_launch < 1:
        raise InputError("--twins-per-launch", "must be auto or an integer of at least 1", twins_per_launch)
    return twins_per_launch
