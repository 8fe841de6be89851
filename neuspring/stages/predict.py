"""The model of a baseline and the controllers of all frames -> trajectory."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

import numpy as np

from neuspring.baselines import BASELINES
from neuspring.core.artifacts import Observations, SplatCenters
from neuspring.core.device import resolve_device
from neuspring.core.errors import InputError
from neuspring.core.records import Recorder, StageRecord
from neuspring.scores import metrics
from neuspring.splats.model import Splats
from neuspring.stages import options as shared


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring predict`."""
    shared.add_observations(parser)
    parser.add_argument("--model", required=True, choices=tuple(BASELINES))
    shared.add_record(parser, "train", "train.json, of models that are trained", required=False)
    shared.add_record(parser, "appearance", "appearance.json of the splats that the model moves", required=False)
    shared.add_device(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring predict`."""
    run(a.observations, a.model, a.train, a.appearance, a.device, a.output)


def run(
    observations_path: Path, model: str, train_record: Path | None, appearance_record: Path | None, device: str, output: Path
) -> None:
    """Write trajectory.npz, centers.npz (of models with splats of their own) and the record `output`.

    A model whose training failed is rolled out too, and the run remains a failure. Raises InputError if the record of a training
    is missing.
    """
    device = resolve_device(device)
    records = {"train": train_record, "appearance": appearance_record}
    paths = {name: path for name, path in records.items() if path}
    before = {name: StageRecord.load(path) for name, path in paths.items()}
    record = Recorder(
        "rollout", output, inputs={"observations": observations_path} | paths, settings={"model": model}, device=device
    )
    for name, stage in before.items():
        # A failed training may have left its last usable model.
        if stage.status == "failed" and "model" not in stage.files:
            record.save(failure=f"{name}: {stage.reason}")
            return
    if BASELINES[model].trained and train_record is None:
        raise InputError("--train", f"model {model} is trained first", None, "Name its train.json.")
    observations = Observations.load(observations_path)
    learned = before["train"].file("model", train_record) if train_record else None
    splats = Splats.load(before["appearance"].file("splats", appearance_record)).means if appearance_record else None
    prediction = BASELINES[model].predict(observations, learned, splats, device)
    trajectory = prediction.trajectory
    files = record.beside(trajectory="trajectory.npz")
    trajectory.save(files["trajectory"])
    facts = {"frames": len(trajectory.positions), **prediction.facts}
    if prediction.centers is not None:
        files |= record.beside(centers="centers.npz")
        SplatCenters(positions=prediction.centers).save(files["centers"])
        facts |= _scores_of_centers(prediction.centers, observations)
    reasons = [f"train: {before['train'].reason}"] if "train" in before and before["train"].reason else []
    reasons += [f"rollout: {trajectory.reason}"] if trajectory.reason else []
    record.save(files, facts, failure="; ".join(reasons))


def _scores_of_centers(centers: np.ndarray, observations: Observations) -> dict[str, float]:
    """Chamfer distance, m, of the centers [F, G, 3] of all splats, in the tasks whose frames they reach.

    The released evaluation takes the first of them in storage order, which is an arbitrary part.
    """
    scores = {}
    points, visible = observations.object_points, observations.object_visibility
    for task in metrics.TASKS:
        frames = metrics.task_frames(observations.scenario, task)
        if not len(frames) or frames[-1] >= len(centers):
            continue
        values = [metrics.visible_to_surface(centers[t], points[t], visible[t], centers.shape[1]) for t in frames]
        if np.isfinite(values).any():
            scores[f"centers_chamfer_{task}"] = float(np.nanmean(values))
    return scores
