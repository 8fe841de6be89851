"""Coarse twin -> fitted twin, by gradients through the simulator."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial as partial_of
from pathlib import Path

from neuspring.config import Config, Kind
from neuspring.config.select import select
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.checkpoint import checkpoint_key
from neuspring.core.device import resolve_device
from neuspring.core.errors import NumericalFailure
from neuspring.core.files import write_history
from neuspring.core.records import Recorder, StageRecord
from neuspring.stages import STAGES
from neuspring.stages import options as shared
from neuspring.twin.fit import FitProblem, fit
from neuspring.twin.hand_paths import with_hands
from neuspring.twin.losses import frames_seen
from neuspring.twin.pooled import PooledFit


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring fit`."""
    shared.add_observations(parser)
    shared.add_pool(parser)
    shared.add_record(parser, "search", "search.json to start from")
    shared.add_settings(parser)
    about = "train each spring, or the neural spring field"
    parser.add_argument("--kind", choices=("springs", "field"), default="springs", help=about)
    oracle = "fit all frames, the future included: no prediction, but what fitting could reach at best; the record says oracle"
    parser.add_argument("--oracle", action="store_true", help=oracle)
    shared.add_device(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring fit`."""
    run(
        a.observations,
        a.search,
        shared.read_settings(a.settings),
        a.kind,
        a.device,
        a.output,
        a.pool,
        a.leave_out,
        oracle=a.oracle,
    )


@dataclass(frozen=True)
class Prepared:
    """A fit before it runs."""

    problem: FitProblem
    partial: Path
    """Where its checkpoints lie."""
    key: str
    """What a checkpoint must match."""


def recorder(
    observations_path: Path,
    search_record: Path,
    settings: Config,
    kind: Kind,
    device: str,
    output: Path,
    pool: Sequence[Path] = (),
    leave_out: bool = False,
    *,
    oracle: bool = False,
) -> Recorder:
    """The recorder of a fit, which digests its inputs. What is off is not named: other digests stay."""
    own = {"kind": kind, "seed": StageRecord.load(search_record).settings["seed"]}
    own |= {name: True for name, on in (("leave_out", leave_out), ("oracle", oracle)) if on}
    return Recorder(
        "fit",
        output,
        inputs={"observations": observations_path, "search": search_record} | shared.pool_inputs(pool),
        settings=select(settings, STAGES["fit"].reads) | own,
        device=device,
    )


def prepared(record: Recorder, observations_path: Path, search_record: Path, settings: Config) -> Prepared:
    """What a fit starts from; the search must not have failed."""
    before = StageRecord.load(search_record)
    twin = Twin.load(before.file("twin", search_record))
    problem = FitProblem(
        with_hands(Observations.load(observations_path), twin),
        twin,
        settings.fit,
        settings.simulation,
        settings.losses,
        settings.released_quirks,
        record.device,
        record.settings["kind"],
        int(record.settings["seed"]),
        record.settings.get("oracle", False),
    )
    # What was read, the search by its twin alone.
    inputs = {"observations": record.inputs["observations"], "twin": before.files["twin"][1]}
    inputs |= {name: digest for name, digest in record.inputs.items() if name.startswith("pool")}
    key = checkpoint_key(inputs, record.settings, record.device, "neuspring.twin.fit")
    return Prepared(problem, record.output.with_name("fit.partial.npz"), key)


def run(
    observations_path: Path,
    search_record: Path,
    settings: Config,
    kind: Kind,
    device: str,
    output: Path,
    pool: Sequence[Path] = (),
    leave_out: bool = False,
    *,
    oracle: bool = False,
) -> None:
    """Write twin.npz, history.parquet (losses per epoch), and the record `output`.

    `kind` says what is trained: each spring by itself, or the neural spring field, whose first weights follow the search's seed.
    `oracle`: all frames are fitted, the future included, and the record says so. With a `pool` of other recordings' observations
    the twin is fitted on all; with `leave_out`, on those alone. A checkpoint that a killed fit left, or one that ran together with
    others (`fits`), is continued.
    """
    device = resolve_device(device)
    record = recorder(observations_path, search_record, settings, kind, device, output, pool, leave_out, oracle=oracle)
    before = StageRecord.load(search_record)
    if before.status == "failed":
        record.save(failure=f"search: {before.reason}")
        return
    ready = prepared(record, observations_path, search_record, settings)
    problem, partial = ready.problem, ready.partial
    fitted = [Observations.load(path) for path in pool]
    run_of = partial_of(PooledFit, pool=fitted, leave_out=leave_out) if pool or leave_out else None
    try:
        result = fit(problem, partial=partial, key=ready.key, run_of=run_of)
    except NumericalFailure as failure:
        record.save(failure=str(failure))
        return
    files = record.beside(twin="twin.npz", history="history.parquet")
    result.twin.save(files["twin"])
    columns = {name: result.history[name] for name in ("loss", "tail_loss", "gradient_norm", "learning_rate")}
    write_history(result.history["epoch"], columns, files["history"])
    counts = result.twin.counts
    # Those that ran together count in the record of `fits`.
    counted = [*([] if leave_out else [problem.observations]), *fitted]
    per_epoch = sum(frames_seen(observations, oracle=oracle) - 1 for observations in counted)
    frames = (len(result.history) - result.epochs_together) * per_epoch
    facts = {
        "best_epoch": result.best_epoch,
        "best_loss": result.best_loss,
        "epochs": len(result.history),
        "epochs_asked": problem.fit.epochs,
        "epochs_together": result.epochs_together,
        "rollbacks": result.rollbacks,
        "collision_overflow": result.collision_overflow,
        **result.figures,
        "spring_updates": frames * counts["springs"] * counts["substeps"],
        **counts,
    }
    record.save(files, facts, attempts=result.attempts, earlier_seconds=result.earlier_seconds)
    partial.unlink(missing_ok=True)
