"""Stage `fit`: twin of a search -> fitted twin, with gradients through the simulator."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from neuspring.config import Config, SpringFieldSettings
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.core.records import Before, Recorder
from neuspring.stages.stage import Job, Rows, Written, physics, stage
from neuspring.twin.body import BODIES, FitTask, Learned, body_of, code

if TYPE_CHECKING:
    from neuspring.twin.fit import FitProblem


def _settled(rows: Rows) -> Config:
    """The configuration with default settings of the field for free springs, which have no field."""
    if rows.method is None or rows.method.fit != "springs":
        return rows.config
    return dataclasses.replace(rows.config, fit=dataclasses.replace(rows.config.fit, field=SpringFieldSettings()))


def _alike(rows: Rows) -> tuple[Any, ...] | None:
    """Key of fits that can share launches: physics, frames per step, oracle (it uses all frames) and pool.

    None for a body that is fitted without gradients.
    """
    row, search = rows.method, rows.search
    if row is None or search is None or not BODIES[search.body].by_gradients:
        return None
    return *physics(rows), rows.config.fit.horizon, row.oracle, row.pool


def _many(jobs: Sequence[Job]) -> list[Written | Exception]:
    """Run several fits of one body; fits with the same physics and horizon share launches."""
    tasks = []
    for job in jobs:
        problem, checkpoint, key = prepared(**{name: value for name, value in job.arguments.items() if name != "threads"})
        checkpoint.parent.mkdir(parents=True, exist_ok=True)
        tasks.append(FitTask(problem, checkpoint, key))
    results = body_of(tasks[0].problem.twin).fit_many(tasks)
    made: list[Written | Exception] = []
    for job, task, result in zip(jobs, tasks, results, strict=True):
        assert task.partial is not None
        made.append(result if isinstance(result, Exception) else written(job.record, result, task.partial))
    return made


@stage(
    output="{scenario}/{method}/{seed}/fit.json",
    reads=("fit", "simulation", "losses", "released_quirks"),
    code=lambda settings, given: code(),
    gpu=True,
    memory_mb=8000,
    minutes=480,
    when=lambda rows: bool(rows.method and rows.method.fit),
    given=lambda rows: {"kind": rows.method.fit, "oracle": rows.method.oracle} if rows.method else {},
    settled=_settled,
    alike=_alike,
    many=_many,
    least_on_cpu=3,
    shared=lambda config, row: (row.search, row.pool, row.fit, row.oracle, config.fit) if row.fit else None,
)
def fit(
    observations: Observations,
    search: Before,
    settings: Config,
    run: Recorder,
    pool: Sequence[Observations] = (),
    kind: Annotated[str, "springs: every spring; field: the neural spring field; or a kind of another body"] = "springs",
    oracle: Annotated[bool, "fit all frames, including future frames: the best that fitting can reach"] = False,
    device: str = "auto",
    threads: int = 1,
) -> Written:
    """Twin of a search -> fitted twin, with gradients: twin.npz, history.parquet (losses per epoch).

    The seed of the search initializes a field's weights. An `oracle` fits all frames, including future frames, and is recorded
    as such. With a `pool`, the twin is fitted on all of its recordings. A killed fit resumes from its checkpoint. Other bodies
    may be fitted without gradients, on `threads` cores; such a fit starts over.
    """
    problem, checkpoint, key = prepared(observations, search, settings, run, pool, kind, oracle, device)
    return written(run, body_of(problem.twin).fit(problem, partial=checkpoint, key=key, threads=threads), checkpoint)


def written(run: Recorder, result: Learned, checkpoint: Path) -> Written:
    """Write the files of a fit."""
    from neuspring.core.files import write_history

    files = run.beside(twin="twin.npz", history="history.parquet")
    result.twin.save(files["twin"])
    write_history(result.course.index, dict(result.course), files["history"])
    return Written(
        files=files, facts=result.facts, attempts=result.attempts, earlier_seconds=result.earlier_seconds, checkpoint=checkpoint
    )


def prepared(
    observations: Observations,
    search: Before,
    settings: Config,
    run: Recorder,
    pool: Sequence[Observations],
    kind: str,
    oracle: bool,
    device: str,
) -> tuple[FitProblem, Path, str]:
    """The fit problem, the path of its checkpoint and the checkpoint's key. The search must not have failed."""
    from neuspring.core.artifacts import Twin
    from neuspring.core.checkpoint import checkpoint_key
    from neuspring.twin.fit import FitProblem

    twin, seed = Twin.load(search.file("twin")), int(search.record.settings["seed"])
    if kind not in (kinds := body_of(twin).fits):
        raise InputError("--kind", f"must be one of {', '.join(kinds)} for this twin", kind)
    problem = FitProblem(
        observations=observations,
        pool=pool,
        twin=twin,
        fit=settings.fit,
        simulation=settings.simulation,
        losses=settings.losses,
        quirks=settings.released_quirks,
        device=device,
        kind=kind,
        seed=seed,
        oracle=oracle,
    )
    # Of the search, only its twin counts.
    inputs = {name: digest for name, digest in run.inputs.items() if name != "search"} | {"twin": search.record.files["twin"][1]}
    key = checkpoint_key(inputs, run.settings | {"seed": seed}, device, "neuspring.twin.fit")
    return problem, run.output.with_name("fit.partial.npz"), key
