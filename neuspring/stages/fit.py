"""Coarse twin -> fitted twin, by gradients through the simulator."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
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


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring fit`."""
    shared.add_observations(parser)
    shared.add_record(parser, "search", "search.json to start from")
    shared.add_settings(parser)
    about = "train each spring, or the neural spring field"
    parser.add_argument("--kind", choices=("springs", "field"), default="springs", help=about)
    shared.add_device(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring fit`."""
    run(a.observations, a.search, shared.read_settings(a.settings), a.kind, a.device, a.output)


def run(observations_path: Path, search_record: Path, settings: Config, kind: Kind, device: str, output: Path) -> None:
    """Write twin.npz, history.parquet (losses per epoch), and the record `output`.

    `kind` says what is trained: each spring by itself, or the neural spring field, whose first weights follow the search's seed.
    A checkpoint that a killed fit left is continued.
    """
    before, device = StageRecord.load(search_record), resolve_device(device)
    seed = before.settings["seed"]
    record = Recorder(
        "fit",
        output,
        inputs={"observations": observations_path, "search": search_record},
        settings=select(settings, STAGES["fit"].reads) | {"kind": kind, "seed": seed},
        device=device,
    )
    if before.status == "failed":
        record.save(failure=f"search: {before.reason}")
        return
    problem = FitProblem(
        Observations.load(observations_path),
        Twin.load(before.file("twin", search_record)),
        settings.fit,
        settings.simulation,
        settings.losses,
        settings.released_quirks,
        device,
        kind,
        int(seed),
    )
    inputs = {"observations": record.inputs["observations"], "twin": before.files["twin"][1]}
    key = checkpoint_key(inputs, record.settings, device, "neuspring.twin.fit")
    partial = output.with_name("fit.partial.npz")
    try:
        result = fit(problem, partial=partial, key=key)
    except NumericalFailure as failure:
        record.save(failure=str(failure))
        return
    files = record.beside(twin="twin.npz", history="history.parquet")
    result.twin.save(files["twin"])
    columns = {name: result.history[name] for name in ("loss", "tail_loss", "gradient_norm", "learning_rate")}
    write_history(result.history["epoch"], columns, files["history"])
    counts = result.twin.counts
    frames = len(result.history) * (problem.observations.scenario.train_end - 1)
    facts = {
        "best_epoch": result.best_epoch,
        "best_loss": result.best_loss,
        "epochs": len(result.history),
        "rollbacks": result.rollbacks,
        "collision_overflow": result.collision_overflow,
        "spring_updates": frames * counts["springs"] * counts["substeps"],
        **counts,
    }
    record.save(files, facts, attempts=result.attempts, earlier_seconds=result.earlier_seconds)
    partial.unlink(missing_ok=True)
