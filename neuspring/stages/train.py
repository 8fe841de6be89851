"""Training frames -> the model of a baseline."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuspring import config
from neuspring.baselines import BASELINES, Pictures, TrainingRequest
from neuspring.config import Config
from neuspring.config.select import select
from neuspring.core.artifacts import Observations
from neuspring.core.checkpoint import checkpoint_key
from neuspring.core.device import resolve_device
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.files import write_history
from neuspring.core.records import Recorder, StageRecord
from neuspring.stages import options as shared

TRAINED = tuple(name for name, baseline in BASELINES.items() if baseline.trained)


@dataclass(frozen=True)
class PictureRecords:
    """What silhouettes are made of."""

    folder: Path
    """Of the capture."""
    masks: Sequence[Path]
    """Records of every camera, in the capture's order."""
    appearance: Path


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring train`."""
    shared.add_observations(parser)
    parser.add_argument("--model", required=True, choices=TRAINED)
    shared.add_capture(parser, required=False, help="capture.json, where silhouettes are trained on")
    shared.add_masks(parser, required=False)
    shared.add_record(parser, "appearance", "appearance.json of the splats that the model moves", required=False)
    shared.add_settings(parser)
    shared.add_seed(parser)
    shared.add_device(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring train`."""
    pictures = None
    if a.capture:
        if not (a.masks and a.appearance):
            raise InputError("--capture", "silhouettes need --masks and --appearance too", a.capture)
        pictures = PictureRecords(a.capture.parent, a.masks, a.appearance)
    run(a.observations, a.model, shared.read_settings(a.settings), a.seed, a.device, a.output, pictures)


def run(
    observations_path: Path,
    model: str,
    settings: Config,
    seed: int,
    device: str,
    output: Path,
    pictures: PictureRecords | None = None,
) -> None:
    """Write model.npz, history.parquet and the record `output`. A checkpoint that a killed training left is continued.

    `settings` has the method's own in the model's section of `baselines`. A training that ends early is recorded as a failure, with
    its last usable model; one that cannot begin, without a model. Raises InputError where silhouettes are asked for without
    pictures, and for models that are not trained.
    """
    if model not in TRAINED:
        raise InputError("--model", f"only {', '.join(TRAINED)} are trained", model)
    device = resolve_device(device)
    inputs = {"observations": observations_path}
    if pictures:
        inputs |= {f"masks{index}": path for index, path in enumerate(pictures.masks)} | {"appearance": pictures.appearance}
    record = Recorder("train", output, inputs=inputs, settings=_settings(model, settings, seed), device=device)
    partial = output.with_name("train.partial.npz")
    appearance = StageRecord.load(pictures.appearance) if pictures else None
    if appearance and appearance.status == "failed":
        record.save(failure=f"appearance: {appearance.reason}")
        return

    def key(**facts: Any) -> str:
        return checkpoint_key(record.inputs, record.settings | facts, device, BASELINES[model].training.partition(":")[0])

    request = TrainingRequest(
        observations=Observations.load(observations_path),
        settings=settings,
        seed=seed,
        device=device,
        partial=partial,
        key=key,
        pictures=Pictures(pictures.folder, pictures.masks, appearance.file("splats", pictures.appearance))
        if pictures and appearance
        else None,
    )
    try:
        result = BASELINES[model].train(request)
    except NumericalFailure as failure:
        record.save(failure=str(failure))
        return
    files = record.beside(model="model.npz", history="history.parquet")
    result.model.save(files["model"])
    columns = {str(name): result.history[name] for name in result.history if name != "step"}
    write_history(result.history["step"], columns, files["history"])
    record.save(files, result.facts, failure=result.failure, attempts=result.attempts, earlier_seconds=result.earlier_seconds)
    partial.unlink(missing_ok=True)


def _settings(model: str, settings: Config, seed: int) -> dict[str, Any]:
    """All settings that a training reads, for its record."""
    baseline = BASELINES[model]
    section = getattr(settings.baselines, baseline.section)
    values: dict[str, Any] = {"model": model, **config.plain(section), "seed": seed}
    for name, value in select(settings, baseline.reads(section)).items():
        # Single values stand under their own name: gravity, backend, corner_pixels.
        values |= {name: value} if name == "losses" else _leaves(value)
    return values


def _leaves(values: dict[str, Any]) -> dict[str, Any]:
    leaves: dict[str, Any] = {}
    for name, value in values.items():
        leaves |= _leaves(value) if isinstance(value, dict) else {name: value}
    return leaves
