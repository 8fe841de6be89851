"""A learned model -> its scores on other recordings of the same object."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd

from neuspring.baselines import BASELINES
from neuspring.config import Config
from neuspring.core.artifacts import Observations, Trajectory, Twin
from neuspring.core.device import resolve_device
from neuspring.core.files import write_table
from neuspring.core.records import Recorder, StageRecord
from neuspring.scores import metrics
from neuspring.stages import options as shared
from neuspring.twin.motion import initial_velocity
from neuspring.twin.rollout import roll_out
from neuspring.twin.transfer import move

Predictor = Callable[[Observations], tuple[Trajectory, int, dict[str, float]]]
"""Another recording -> its prediction, the spring updates per frame that it took (0 for a model without springs), and how well the
shapes fit (empty where the nodes are the same)."""


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring transfer`."""
    shared.add_record(parser, "twin", "search.json or fit.json that names the twin, or train.json of a baseline")
    about = "observations.npz of the other recordings"
    parser.add_argument("--targets", type=Path, nargs="+", required=True, help=about)
    parser.add_argument("--method", required=True)
    shared.add_seed(parser)
    shared.add_settings(parser)
    shared.add_device(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring transfer`."""
    run(a.targets, a.twin, a.method, a.seed, shared.read_settings(a.settings), a.device, a.output)


def run(targets: Sequence[Path], learned_record: Path, method: str, seed: int, settings: Config, device: str, output: Path) -> None:
    """Write transfer.parquet (task `transfer`) and the record `output`.

    `learned_record` names a twin, or a trained baseline that can be transferred. All frames after the first of a target count. With
    `simulation.initial_velocity: observed`, frames 1 and 2 also set the initial velocity. A twin's rest lengths are
    re-based on the target's rest shape, unless they were trained. Other nodes are registered (twin/resample.py), and the record
    says how well they fit. A rollout that diverges leaves out its target.
    """
    before, device = StageRecord.load(learned_record), resolve_device(device)
    inputs = {before.stage: learned_record} | {f"target{index}": path for index, path in enumerate(targets)}
    record = Recorder("transfer", output, inputs=inputs, device=device)
    tables, diverged = [pd.DataFrame(columns=list(metrics.COLUMNS))], []
    updates, registered = 0, {}
    if before.status == "ok":
        predict = _baseline_predictor if before.stage == "train" else _twin_predictor
        predicts = predict(before, learned_record, settings, device)
        for path in targets:
            observations = Observations.load(path)
            trajectory, per_frame, fitted = predicts(observations)
            if fitted:
                registered[observations.scenario.name] = fitted
            updates += (len(trajectory.positions) - 1) * per_frame
            if trajectory.diverged_frame is not None:
                diverged.append(observations.scenario.name)
            frames = range(1, observations.scenario.frame_count)
            tables.append(metrics.score_tasks(trajectory, observations, method, seed, {"transfer": frames}))
    files = record.beside(scores="transfer.parquet")
    write_table(pd.concat([table for table in tables if len(table)] or tables), files["scores"])
    facts = {"diverged": diverged, "targets": len(targets)} | ({"spring_updates": updates} if updates else {})
    facts |= {"registered": registered} if registered else {}
    record.save(files, facts, failure=before.reason)


def _baseline_predictor(record: StageRecord, path: Path, settings: Config, device: str) -> Predictor:
    """How a baseline's model predicts another recording."""
    baseline = BASELINES[record.settings["model"]]
    return lambda observations: (baseline.predict(observations, record.file("model", path), None, device).trajectory, 0, {})


def _twin_predictor(record: StageRecord, path: Path, settings: Config, device: str) -> Predictor:
    """How a twin predicts another recording."""
    twin = Twin.load(record.file("twin", path))
    settings_of_fit = record.settings.get("fit", {})
    trained = settings_of_fit.get("rest_length_bound") or settings_of_fit.get("rest_shape", {}).get("handles")
    keep_lengths = bool(trained)
    keep_frame_time = record.settings["released_quirks"]["frame_time_667"]

    def predict(observations: Observations) -> tuple[Trajectory, int, dict[str, float]]:
        safety = settings.simulation.safety
        result = move(twin, observations, safety=safety, keep_lengths=keep_lengths, keep_frame_time=keep_frame_time)
        moved = result.twin
        velocity = initial_velocity(observations, moved.simulation.initial_velocity)
        trajectory = roll_out(moved, observations.controller_points, device, velocity=velocity, valid=observations.controller_valid)
        return trajectory, moved.counts["springs"] * moved.counts["substeps"], result.facts

    return predict
