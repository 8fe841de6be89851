"""Observations -> coarse twin, by CMA-ES."""

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
    """The configuration; a body of one region has none to tie."""
    if rows.search is None or rows.search.clusters != 1:
        return rows.config
    return dataclasses.replace(rows.config, search=dataclasses.replace(rows.config.search, tied_rollouts=Search().tied_rollouts))


def _given(rows: Rows) -> dict[str, Any]:
    if rows.search is None:
        return {}
    return {"clusters": rows.search.clusters, "body": rows.search.body}


def _alike(rows: Rows) -> tuple[Any, ...] | None:
    """None for a body whose search has no launches to share; those of one number of candidates end at about the same time."""
    search = rows.search
    return (*physics(rows), search.body, rows.config.search.rollouts) if search and BODIES[search.body].by_gradients else None


def _many(jobs: Sequence[Job]) -> list[Written | Exception]:
    """Several searches of one body, whose generations share launches."""
    tasks = []
    for job in jobs:
        given = job.arguments
        names = ("settings", "run", "clusters", "seed", "device", "twins_per_launch")
        options = prepared(**{name: given[name] for name in names}, threads=1)
        tasks.append(SearchTask(given["observations"], given["pool"] or (), given["settings"], options))
    results = BODIES[jobs[0].arguments["body"]].search_many(tasks)
    return [one if isinstance(one, Exception) else written(job.record, one) for job, one in zip(jobs, results, strict=True)]


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
    body: Annotated[str, "lattice, or a package's own"] = "lattice",
    seed: int = 0,
    device: str = "auto",
    threads: int = 1,
    twins_per_launch: int | Literal["auto"] = "auto",
) -> Written:
    """Observations -> coarse twin, by CMA-ES: twin.npz, trace.parquet (every candidate with cost and variables), history.parquet.

    `clusters` regions of the topology have values of their own (1: uniform). At most `twins_per_launch` candidates share a launch
    (auto: as many as pay), and `threads` launches run at the same time on a CPU; neither changes a number there. A trace of the
    same search is continued, so a larger `search.rollouts` costs only the difference. With a `pool` of other recordings a
    candidate's cost is the mean over all. A `body` of a package
    may search in another way, and have other rows in its trace.
    """
    options = prepared(settings, run, clusters, seed, device, threads, twins_per_launch)
    return written(run, BODIES[body].search(observations, pool, settings, options))


def written(run: Recorder, result: Learned) -> Written:
    """The files of a search."""
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
    """The way a search runs, where its trace lies, and what one must match to be continued. Raises InputError."""
    from neuspring.core.checkpoint import checkpoint_key

    if threads < 1:
        raise InputError("--threads", "must be at least 1", threads)
    # The budget is not part of the key: a search with a larger one begins with the same candidates.
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
    """Twins that share a launch at most; 0: as many as are fast on the device. Raises InputError."""
    if twins_per_launch == "auto":
        return 0
    if not isinstance(twins_per_launch, int) or twins_per_launch < 1:
        raise InputError("--twins-per-launch", "must be auto or an integer of at least 1", twins_per_launch)
    return twins_per_launch
