"""Stage `predict`: the model of a baseline and the controllers of all frames -> trajectory."""

from __future__ import annotations

from typing import TYPE_CHECKING

from neuspring.baselines import BASELINES, without_pictures
from neuspring.core.artifacts import Observations, SplatCenters
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.records import Before, Recorder
from neuspring.stages.stage import MayFail, Written, stage

if TYPE_CHECKING:
    import numpy as np


@stage(
    output="{scenario}/{method}/{seed}/rollout.json",
    rule="run",
    code=lambda settings, given: BASELINES[given["model"]].modules if given["model"] in BASELINES else (),
    gpu=True,
    minutes=60,
    when=lambda rows: bool(rows.method and rows.method.model),
    without=lambda rows: without_pictures(rows.method, rows.config),
    given=lambda rows: {"model": rows.method and rows.method.model},
)
def predict(
    observations: Observations,
    model: str,
    run: Recorder,
    train: MayFail | None = None,
    appearance: Before | None = None,
    device: str = "auto",
) -> Written:
    """Model of a baseline -> trajectory over all frames: trajectory.npz, and centers.npz for models with their own splats.

    A model whose training failed is also rolled out, but the run remains a failure. Raises InputError if the record of a required
    training is missing.
    """
    from neuspring.splats.model import Splats

    if model not in BASELINES:
        raise InputError("--model", f"must be one of {', '.join(BASELINES)}", model)
    if BASELINES[model].trained and train is None:
        raise InputError("--train", f"model {model} requires a training", None, "Name its train.json.")
    if train and train.record.status == "failed" and not train.has("model"):
        # A failed training may have left its last usable model.
        raise NumericalFailure(f"train: {train.record.reason}")
    splats = Splats.load(appearance.file("splats")).means if appearance else None
    prediction = BASELINES[model].predict(observations, train.file("model") if train else None, splats, device)
    trajectory = prediction.trajectory
    files = run.beside(trajectory="trajectory.npz")
    trajectory.save(files["trajectory"])
    facts = {"frames": len(trajectory.positions), **prediction.facts}
    if prediction.centers is not None:
        files |= run.beside(centers="centers.npz")
        SplatCenters(positions=prediction.centers).save(files["centers"])
        facts |= _scores_of_centers(prediction.centers, observations)
    reasons = [f"train: {train.record.reason}"] if train and train.record.reason else []
    reasons += [f"rollout: {trajectory.reason}"] if trajectory.reason else []
    return Written(files=files, facts=facts, failure="; ".join(reasons))


def _scores_of_centers(centers: np.ndarray, observations: Observations) -> dict[str, float]:
    """Chamfer distance, m, of all splat centers [F, G, 3], for tasks whose frames they cover.

    The released evaluation uses only the first centers in storage order, an arbitrary subset.
    """
    import numpy as np

    from neuspring.scores import metrics

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
