"""A learned model -> its scores on other recordings of the same object."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from neuspring.baselines import BASELINES
from neuspring.config import Config
from neuspring.core.artifacts import Observations, Trajectory, Twin
from neuspring.core.records import Before, Recorder
from neuspring.stages.stage import MayFail, Written, stage

Predictor = Callable[[Observations], tuple[Trajectory, int, dict[str, float]]]
"""Another recording -> its prediction, the spring updates per frame that it took (0 for a model without springs), and how well the
shapes fit (empty where the nodes are the same)."""


@stage(
    output="{scenario}/{method}/{seed}/transfer.json",
    reads=("simulation",),
    code=lambda settings, given: BASELINES[given["model"]].modules if given.get("model") else (),
    gpu="always",
    minutes=60,
)
def transfer(
    targets: Sequence[Observations],
    learned: MayFail,
    method: str,
    settings: Config,
    run: Recorder,
    seed: int = 0,
    device: str = "auto",
) -> Written:
    """Learned model -> scores on other recordings of the object: transfer.parquet (task `transfer`).

    `learned` names a twin (search.json, fit.json), or a trained baseline that can be transferred (train.json). All frames after the
    first of a target count. With `simulation.initial_velocity: observed`, frames 1 and 2 also set the initial velocity. A twin's
    rest lengths are re-based on the target's rest shape, unless they were trained. Other nodes are registered (twin/transfer.py),
    and the record says how well they fit. A rollout that diverges leaves out its target.
    """
    import pandas as pd

    from neuspring.core.files import write_table
    from neuspring.scores import metrics

    tables, diverged = [pd.DataFrame(columns=list(metrics.COLUMNS))], []
    updates, registered = 0, {}
    if learned.record.status == "ok":
        predicts = (_baseline_predictor if learned.record.stage == "train" else _twin_predictor)(learned, settings, device)
        for observations in targets:
            trajectory, per_frame, fitted = predicts(observations)
            if fitted:
                registered[observations.scenario.name] = fitted
            updates += (len(trajectory.positions) - 1) * per_frame
            if trajectory.diverged_frame is not None:
                diverged.append(observations.scenario.name)
            frames = range(1, observations.scenario.frame_count)
            tables.append(metrics.score_tasks(trajectory, observations, method, seed, {"transfer": frames}))
    files = run.beside(scores="transfer.parquet")
    write_table(pd.concat([table for table in tables if len(table)] or tables), files["scores"])
    facts: dict[str, Any] = {"diverged": diverged, "targets": len(targets)} | ({"spring_updates": updates} if updates else {})
    facts |= {"registered": registered} if registered else {}
    return Written(files=files, facts=facts, failure=learned.record.reason)


def _baseline_predictor(learned: Before, settings: Config, device: str) -> Predictor:
    """How a baseline's model predicts another recording."""
    baseline = BASELINES[learned.record.settings["model"]]
    return lambda observations: (baseline.predict(observations, learned.file("model"), None, device).trajectory, 0, {})


def _twin_predictor(learned: Before, settings: Config, device: str) -> Predictor:
    """How a twin predicts another recording."""
    from neuspring.twin.rollout import initial_velocity, roll_out
    from neuspring.twin.transfer import move

    twin = Twin.load(learned.file("twin"))
    keep_lengths = bool(learned.record.settings.get("fit", {}).get("rest_shape", {}).get("handles"))
    keep_frame_time = learned.record.settings["released_quirks"]["frame_time_667"]

    def predict(observations: Observations) -> tuple[Trajectory, int, dict[str, float]]:
        safety = settings.simulation.safety
        moved, laid = move(twin, observations, safety=safety, keep_lengths=keep_lengths, keep_frame_time=keep_frame_time)
        velocity = initial_velocity(observations, moved.simulation.initial_velocity)
        trajectory = roll_out(moved, observations.controller_points, device, velocity=velocity, valid=observations.controller_valid)
        return trajectory, moved.counts["springs"] * moved.counts["substeps"], laid.facts if laid else {}

    return predict
