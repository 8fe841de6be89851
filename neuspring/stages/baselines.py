"""The steps of the baseline models: train one on the training frames, predict all frames. As the steps in `stages`.

A training that ends early, or a rollout that diverges, is recorded as a failure; what could be used up to there is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neuspring import config
from neuspring.baselines.results import Prediction, Trained
from neuspring.config import Config
from neuspring.config.baselines import TRAINING, Model
from neuspring.core.artifacts import Observations, SplatCentres
from neuspring.core.checkpoint import checkpoint_key
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.files import write_history
from neuspring.core.records import StageRecord, Stopwatch, digest_file
from neuspring.scores import metrics


@dataclass(frozen=True)
class Pictures:
    """What silhouettes are made of."""

    folder: Path
    """Of the capture."""
    masks: Sequence[Path]
    """Records of every camera, in the capture's order."""
    appearance_record: Path


def train(
    observations_path: Path, model: Model, settings: Config, seed: int, device: str, output: Path, pictures: Pictures | None = None
) -> None:
    """Training frames -> model.npz, history.parquet, train.json. Continues from a checkpoint that a killed job left.

    `settings` has the method's own in the model's section of `baselines`. Raises InputError where silhouettes are asked for
    without pictures, and for models without training. What cannot be trained is a failure, recorded without a model.
    """
    from neuspring.core.device import resolve_device

    if model not in TRAINING:
        raise InputError("--model", f"only {', '.join(TRAINING)} are trained", model)
    clock, device = Stopwatch(), resolve_device(device)
    observations = Observations.load(observations_path)
    inputs = {"observations": digest_file(observations_path)}
    if pictures:
        inputs |= {f"masks{k}": digest_file(path) for k, path in enumerate(pictures.masks)}
        inputs["appearance"] = digest_file(pictures.appearance_record)
    common: dict[str, Any] = {"inputs": inputs, "settings": _read(model, settings, seed), "device": device}
    partial = output.with_name("train.partial.npz")

    def failed(reason: str) -> None:
        clock.stage("train", "failed", reason=reason, **common).save(output)

    learned = StageRecord.load(pictures.appearance_record) if pictures else None
    if learned and learned.status == "failed":
        return failed(f"appearance: {learned.reason}")
    try:
        result = _trained(observations, model, settings, pictures, partial, common)
    except NumericalFailure as failure:
        return failed(str(failure))
    paths = {"model": output.with_name("model.npz"), "history": output.with_name("history.parquet")}
    result.model.save(paths["model"])
    columns = {str(name): result.history[name] for name in result.history if name != "step"}
    write_history(result.history["step"], columns, paths["history"])
    clock.stage(
        "train",
        "failed" if result.failure else "ok",
        paths,
        reason=result.failure,
        facts=result.facts,
        attempts=result.attempts,
        earlier_seconds=result.earlier_seconds,
        **common,
    ).save(output)
    return partial.unlink(missing_ok=True)


def _read(model: Model, settings: Config, seed: int) -> dict[str, Any]:
    """All settings that a training reads."""
    plain = config.plain(settings)
    found: dict[str, Any] = {"model": model, **plain["baselines"][model], "seed": seed}
    if model == "gs_dynamics":
        return found
    found["gravity"] = plain["simulation"]["gravity"]
    if settings.baselines.spring_gaus.supervision == "points":
        return found | {"losses": plain["losses"]}
    return found | {"backend": plain["images"]["backend"], "corner_pixels": plain["images"]["released_quirks"]["corner_pixels"]}


def _trained(
    observations: Observations, model: Model, settings: Config, pictures: Pictures | None, partial: Path, common: dict[str, Any]
) -> Trained[Any]:
    """Raises NumericalFailure where there is nothing to train."""
    device, seed = common["device"], common["settings"]["seed"]

    def key(**more: Any) -> str:
        return checkpoint_key(common["inputs"], common["settings"] | more, device, TRAINING[model])

    if model == "gs_dynamics":
        from neuspring.baselines.gs_dynamics import train as gs_dynamics

        return gs_dynamics.run(observations, settings.baselines.gs_dynamics, seed, device, partial, key())
    from neuspring.baselines.spring_gaus import setup
    from neuspring.baselines.spring_gaus import train as spring_gaus

    seen = None
    if pictures:
        seen = setup.Seen.of(pictures.folder, pictures.masks, _splats_of(pictures.appearance_record), settings, device)
    problem, facts = setup.problem(observations, seen, settings, seed, device)
    result: Trained[Any] = spring_gaus.run(problem, partial, key(vgg16=facts.get("vgg16") == "computed"))
    result.facts.update(facts)
    return result


def predict(
    observations_path: Path, model: Model, train_record: Path | None, appearance_record: Path | None, device: str, output: Path
) -> None:
    """A model and the controllers of all frames -> trajectory.npz, centres.npz (of models with splats of their own), rollout.json.

    What was trained with a failure is rolled out too, and remains a failure.
    """
    from neuspring.core.device import resolve_device

    clock, device = Stopwatch(), resolve_device(device)
    observations = Observations.load(observations_path)
    records = {"train": train_record, "appearance": appearance_record}
    given = {name: path for name, path in records.items() if path}
    stages = {name: StageRecord.load(path) for name, path in given.items()}
    common: dict[str, Any] = {
        "inputs": {"observations": digest_file(observations_path)} | {name: digest_file(path) for name, path in given.items()},
        "settings": {"model": model},
        "device": device,
    }
    missing = next((f"{name}: {record.reason}" for name, record in stages.items() if not _usable(record)), None)
    if missing:
        clock.stage("rollout", "failed", reason=missing, **common).save(output)
        return
    found = _prediction(model, observations, train_record, appearance_record, device)
    paths = {"trajectory": output.with_name("trajectory.npz")}
    found.trajectory.save(paths["trajectory"])
    facts = {"frames": len(found.trajectory.positions), **found.facts}
    if found.centres is not None:
        paths["centres"] = output.with_name("centres.npz")
        SplatCentres(positions=found.centres).save(paths["centres"])
        facts |= _scores_of_centres(found.centres, observations)
    trained = stages["train"].reason if "train" in stages else ""
    reasons = [f"train: {trained}"] if trained else []
    reasons += [f"rollout: {found.trajectory.reason}"] if found.trajectory.reason else []
    clock.stage("rollout", "failed" if reasons else "ok", paths, reason="; ".join(reasons), facts=facts, **common).save(output)


def _usable(record: StageRecord) -> bool:
    """Whether a stage left what the prediction needs: a failed training has its last usable model."""
    return record.status == "ok" or "model" in record.files


def _prediction(
    model: Model, observations: Observations, train_record: Path | None, appearance_record: Path | None, device: str
) -> Prediction:
    if model == "static":
        from neuspring.baselines.untrained import static

        return static(observations)
    if model == "controller_lbs":
        from neuspring.baselines.untrained import controller_lbs

        return controller_lbs(observations, device)
    if train_record is None:
        raise InputError("--train", f"model {model} is trained first", None, "Name its train.json.")
    path = StageRecord.load(train_record).file("model", train_record)
    if model == "gs_dynamics":
        from neuspring.baselines.gs_dynamics import predict as gs_dynamics
        from neuspring.baselines.gs_dynamics.model import GsDynamicsModel

        return gs_dynamics.predict(GsDynamicsModel.load(path), observations, device)
    from neuspring.baselines.spring_gaus import predict as spring_gaus
    from neuspring.baselines.spring_gaus.model import SpringGausModel
    from neuspring.splats.model import Splats

    splats = _splats_of(appearance_record) if appearance_record else None
    centres = None if splats is None else Splats.load(splats).means
    return spring_gaus.predict(SpringGausModel.load(path), observations, centres, device)


def _splats_of(record: Path) -> Path:
    return StageRecord.load(record).file("splats", record)


def _scores_of_centres(centres: np.ndarray, observations: Observations) -> dict[str, float]:
    """Chamfer distance, m, of the splats' centres [F, G, 3] themselves, all of them, in the tasks that they reach.

    The released evaluation takes the first of them in storage order, which is an arbitrary part.
    """
    found = {}
    for task in metrics.TASKS:
        frames = metrics.task_frames(observations.scenario, task)
        if not len(frames) or frames[-1] >= len(centres):
            continue
        points, visible = observations.object_points, observations.object_visibility
        values = [metrics.visible_to_surface(centres[t], points[t], visible[t], centres.shape[1]) for t in frames]
        if np.isfinite(values).any():
            found[f"centres_chamfer_{task}"] = float(np.nanmean(values))
    return found
