"""Coarse twin -> fitted twin, by gradients through the simulator."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from neuspring.config import Config, Kind, SpringField
from neuspring.core.artifacts import Observations
from neuspring.core.records import Before, Recorder
from neuspring.stages.stage import Rows, Written, stage

if TYPE_CHECKING:
    from neuspring.twin.fit import FitProblem


def _settled(rows: Rows) -> Config:
    """The configuration; free springs have no field."""
    if rows.method is None or rows.method.fit != "springs":
        return rows.config
    return dataclasses.replace(rows.config, fit=dataclasses.replace(rows.config.fit, field=SpringField()))


@stage(
    output="{scenario}/{method}/{seed}/fit.json",
    reads=("fit", "simulation", "losses", "released_quirks"),
    gpu=True,
    memory_mb=8000,
    minutes=480,
    when=lambda rows: bool(rows.method and rows.method.fit),
    given=lambda rows: {"kind": rows.method.fit, "oracle": rows.method.oracle} if rows.method else {},
    settled=_settled,
    shared=lambda config, row: (row.search, row.pool, row.fit, row.oracle, config.fit) if row.fit else None,
)
def fit(
    observations: Observations,
    search: Before,
    settings: Config,
    run: Recorder,
    pool: Sequence[Observations] = (),
    leave_out: bool = False,
    kind: Annotated[Kind, "train each spring, the neural spring field, or a rod"] = "springs",
    oracle: Annotated[bool, "fit all frames, the future included: what fitting could reach at best"] = False,
    device: str = "auto",
    threads: int = 1,
) -> Written:
    """Coarse twin -> fitted twin, by gradients: twin.npz, history.parquet (losses per epoch).

    A field's first weights follow the search's seed. An `oracle` fits all frames, the future included, and the record says so. With
    a `pool` of other recordings the twin is fitted on all; with `leave_out`, on those alone. A checkpoint that a killed fit left,
    or one that ran together with others (`fits`), is continued. A rod has Levenberg-Marquardt in place of gradients, on `threads`
    cores, and begins anew.
    """
    from neuspring.core.files import write_history
    from neuspring.twin.fit import fit as fit_twin
    from neuspring.twin.losses import frames_seen

    problem, checkpoint, key = prepared(observations, search, settings, run, pool, leave_out, kind, oracle, device)
    if kind == "rod":
        return _rod(problem, run, threads)
    result = fit_twin(problem, partial=checkpoint, key=key)
    files = run.beside(twin="twin.npz", history="history.parquet")
    result.twin.save(files["twin"])
    columns = {name: result.history[name] for name in ("loss", "tail_loss", "gradient_norm", "learning_rate")}
    write_history(result.history["epoch"], columns, files["history"])
    counts = result.twin.counts
    # Those that ran together count in the record of `fits`.
    counted = [*([] if leave_out else [problem.observations]), *pool]
    per_epoch = sum(frames_seen(one, oracle=oracle) - 1 for one in counted)
    frames = (len(result.history) - result.epochs_together) * per_epoch
    facts = {
        "best_epoch": result.best_epoch,
        "best_loss": result.best_loss,
        "epochs": len(result.history),
        "epochs_asked": problem.fit.epochs,
        "epochs_together": result.epochs_together,
        "earlier_processor_seconds": round(result.earlier_processor_seconds, 3),
        "rollbacks": result.rollbacks,
        "collision_overflow": result.collision_overflow,
        "frames_left_out": round(result.frames_left_out / (len(result.history) * per_epoch), 4),
        **result.figures,
        "spring_updates": frames * counts["springs"] * counts["substeps"],
        **counts,
    }
    return Written(
        files=files, facts=facts, attempts=result.attempts, earlier_seconds=result.earlier_seconds, checkpoint=checkpoint
    )


def _rod(problem: FitProblem, run: Recorder, threads: int) -> Written:
    """The fit of a rod."""
    from neuspring.core.files import write_history
    from neuspring.twin.rod_fit import fit_rod

    read = (problem.observations, problem.pool, problem.twin, problem.fit.rod)
    result = fit_rod(*read, leave_out=problem.leave_out, oracle=problem.oracle, device=problem.device, threads=threads)
    files = run.beside(twin="twin.npz", history="history.parquet")
    result.twin.save(files["twin"])
    columns = {name: result.history[name] for name in ("loss", "gradient_norm", "learning_rate")}
    write_history(result.history.index, columns, files["history"])
    facts = {"best_loss": result.value, "steps": len(result.history), "rollouts": result.rollouts, "collision_overflow": 0}
    return Written(files=files, facts=facts | result.facts | result.twin.counts)


def prepared(
    observations: Observations,
    search: Before,
    settings: Config,
    run: Recorder,
    pool: Sequence[Observations],
    leave_out: bool,
    kind: Kind,
    oracle: bool,
    device: str,
) -> tuple[FitProblem, Path, str]:
    """A fit before it runs, where its checkpoints lie, and what a checkpoint must match. The search must not have failed."""
    from neuspring.core.artifacts import Twin
    from neuspring.core.checkpoint import checkpoint_key
    from neuspring.twin.fit import FitProblem

    twin, seed = Twin.load(search.file("twin")), int(search.record.settings["seed"])
    problem = FitProblem(
        observations,
        twin,
        settings.fit,
        settings.simulation,
        settings.losses,
        settings.released_quirks,
        device,
        kind,
        seed,
        oracle,
        pool,
        leave_out,
    )
    # What was read, the search by its twin alone.
    inputs = {name: digest for name, digest in run.inputs.items() if name != "search"} | {"twin": search.record.files["twin"][1]}
    key = checkpoint_key(inputs, run.settings | {"seed": seed}, device, "neuspring.twin.fit")
    return problem, run.output.with_name("fit.partial.npz"), key
