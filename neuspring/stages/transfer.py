"""Stage `transfer`: a learned model -> its scores on other recordings of the same object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

from neuspring.baselines import BASELINES
from neuspring.config import Config
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.records import Recorder
from neuspring.stages.stage import MayFail, Rows, Written, stage
from neuspring.twin.body import body_of, code


def _moves(rows: Rows) -> bool:
    """True for models that can be applied to other recordings. Oracles are limited to their own recording."""
    row = rows.method
    return bool(rows.targets and row and not row.oracle and (row.search or (row.model and BASELINES[row.model].transfers)))


@stage(
    output="{scenario}/{method}/{seed}/transfer.json",
    rule="run",
    reads=("simulation",),
    code=lambda settings, given: BASELINES[given["model"]].modules if given["model"] in BASELINES else code(),
    gpu=True,
    minutes=60,
    when=_moves,
    given=lambda rows: {"model": rows.method and rows.method.model},
)
def transfer(
    targets: Sequence[Observations],
    method: str,
    settings: Config,
    run: Recorder,
    learned: MayFail | None = None,
    model: Annotated[str | None, "model of a baseline; none for twins"] = None,
    seed: int = 0,
    device: str = "auto",
) -> Written:
    """Learned model -> scores on other recordings of the object: transfer.parquet (task `transfer`), transfer_frames.parquet.

    transfer_frames.parquet contains all distances in all frames (`scenario` is the target). transfer_positions.npz contains the
    predicted nodes [F, N, 3], float32, m, by target.

    `learned` is the record of a twin (search.json, fit.json) or of a trained baseline that can be transferred (train.json);
    models that learn nothing have none. A target must have the same nodes in the same order. All of its frames except frame 0
    are scored; with `simulation.initial_velocity: observed`, frames 1 and 2 also determine the initial velocity. Targets whose
    rollout diverges are left out.
    """
    import numpy as np
    import pandas as pd

    from neuspring.core.files import write_npz, write_table
    from neuspring.scores import metrics
    from neuspring.twin.rollout import initial_velocity, roll_out
    from neuspring.twin.transfer import move

    tables, diverged = [pd.DataFrame(columns=list(metrics.SCORE_COLUMNS))], []
    courses, positions = [pd.DataFrame(columns=["scenario", "frame", "seconds", "metric", "value"])], {}
    updates, failure = 0, learned.record.reason if learned else ""
    twin = Twin.load(learned.file("twin")) if learned and learned.has("twin") else None
    if learned and twin is None and not failure:
        model = learned.record.settings["model"]
    for observations in () if failure else targets:
        if model is not None:
            file = learned.file("model") if learned else None
            trajectory = BASELINES[model].predict(observations, file, None, device).trajectory
        elif twin is not None and learned is not None:
            moved = move(
                twin,
                observations,
                safety=settings.simulation.safety,
                rest_lengths=settings.simulation.rest_lengths,
                keep_frame_time=learned.record.settings["released_quirks"]["frame_time_667"],
            )
            moved = body_of(moved).for_prediction(moved)
            velocity = initial_velocity(observations, moved.simulation.initial_velocity)
            controllers, valid = observations.controller_points, observations.controller_valid
            trajectory = roll_out(moved, controllers, device, velocity=velocity, valid=valid)
            updates += (len(trajectory.positions) - 1) * moved.counts["springs"] * moved.counts["substeps"]
        if trajectory.diverged_frame is not None:
            diverged.append(observations.scenario.name)
        frames = range(1, observations.scenario.frame_count)
        errors = metrics.errors_per_frame(trajectory.positions, observations)
        tables.append(metrics.score(trajectory, observations, method, seed, errors, {"transfer": frames}))
        course = pd.DataFrame(errors).rename_axis("frame").melt(var_name="metric", ignore_index=False).reset_index()
        course = course.assign(scenario=observations.scenario.name, seconds=course["frame"] / observations.scenario.frame_rate)
        if trajectory.diverged_frame is None:
            courses.append(course[list(courses[0])])
        positions[observations.scenario.name] = trajectory.positions.astype(np.float32)
    files = run.beside(scores="transfer.parquet", frames="transfer_frames.parquet", positions="transfer_positions.npz")
    for role, parts in (("scores", tables), ("frames", courses)):
        write_table(pd.concat([part for part in parts if len(part)] or parts), files[role])
    write_npz(files["positions"], positions, "{}", compress=True)
    facts: dict[str, Any] = {"diverged": diverged, "targets": len(targets)} | ({"spring_updates": updates} if updates else {})
    return Written(files=files, facts=facts, failure=failure)
