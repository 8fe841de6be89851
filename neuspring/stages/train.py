"""Stage `train`: training frames -> the model of a baseline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from neuspring.baselines import BASELINES, Pictures, TrainingRequest, without_pictures
from neuspring.config import Config
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError
from neuspring.core.records import Before, Recorder
from neuspring.data.capture import Capture
from neuspring.stages.stage import Rows, Written, paths, stage


def _reads(settings: Config, given: Any) -> tuple[str, ...]:
    if (baseline := BASELINES.get(given["model"])) is None:
        return ()
    return (*([f"baselines.{baseline.section}"] if baseline.section else []), *baseline.reads(baseline.settings(settings)))


def _stamp(rows: Rows) -> str:
    """Available optional weights, for models that are trained on images."""
    baseline = BASELINES[rows.method.model or ""] if rows.method else None
    return baseline.features() if baseline and baseline.pictured(rows.config) else ""


@stage(
    output="{scenario}/{method}/{seed}/train.json",
    reads=_reads,
    code=lambda settings, given: BASELINES[given["model"]].modules if given["model"] in BASELINES else (),
    gpu=True,
    memory_mb=8000,
    minutes=480,
    when=lambda rows: bool(rows.method and rows.method.model and BASELINES[rows.method.model].trained),
    without=lambda rows: without_pictures(rows.method, rows.config),
    given=lambda rows: {"model": rows.method and rows.method.model},
    stamp=_stamp,
)
def train(
    observations: Observations,
    model: str,
    settings: Config,
    run: Recorder,
    capture: Capture | None = None,
    masks: Sequence[Before] = (),
    appearance: Before | None = None,
    seed: int = 0,
    device: str = "auto",
) -> Written:
    """Observations -> trained model of a baseline: model.npz, history.parquet.

    A killed training resumes from its checkpoint. `settings` contains the method's settings in the model's section of
    `baselines`. Training on silhouettes also requires capture, masks and splats. A training that ends early is recorded as a
    failure with its last usable model; one that cannot start is recorded without a model.

    Raises InputError for silhouettes without masks or splats, and for models without training.
    """
    from neuspring.core.checkpoint import checkpoint_key
    from neuspring.core.files import write_history

    trained = [name for name, baseline in BASELINES.items() if baseline.trained]
    if model not in trained:
        raise InputError("--model", f"must be a model with training: {', '.join(trained)}", model)
    pictures = None
    if capture is not None:
        if not (masks and appearance):
            raise InputError("--capture", "requires --masks and --appearance", capture.folder)
        pictures = Pictures(capture.folder, paths(masks), appearance.file("splats"))

    def key(**facts: Any) -> str:
        return checkpoint_key(run.inputs, run.settings | facts, device, BASELINES[model].training.partition(":")[0])

    checkpoint = run.output.with_name("train.partial.npz")
    result = BASELINES[model].train(
        TrainingRequest(
            observations=observations, settings=settings, seed=seed, device=device, partial=checkpoint, key=key, pictures=pictures
        )
    )
    files = run.beside(model="model.npz", history="history.parquet")
    result.model.save(files["model"])
    columns = {str(name): result.history[name] for name in result.history if name != "step"}
    write_history(result.history["step"], columns, files["history"])
    return Written(
        files=files,
        facts=result.facts,
        failure=result.failure,
        attempts=result.attempts,
        earlier_seconds=result.earlier_seconds,
        checkpoint=checkpoint,
    )
