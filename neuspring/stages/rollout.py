"""Stage `rollout`: a twin and the controllers of all frames -> trajectory."""

from __future__ import annotations

from neuspring.core.artifacts import Observations, Twin
from neuspring.core.records import Before, Recorder
from neuspring.stages.stage import Written, stage
from neuspring.twin.body import body_of, code


@stage(
    output="{scenario}/{method}/{seed}/rollout.json",
    rule="run",
    code=lambda settings, given: code(),
    gpu=True,
    minutes=60,
    when=lambda rows: rows.search is not None,
)
def rollout(observations: Observations, learned: Before, run: Recorder, device: str = "auto") -> Written:
    """Twin -> trajectory over all frames, trajectory.npz. A rollout that diverges is recorded as a failure.

    `learned` is the search.json or fit.json of the twin. The record of a twin fitted on future frames contains `oracle`. Objects
    with self-collision use more substeps (`Body.for_prediction`).
    """
    from neuspring.twin.rollout import initial_velocity, roll_out

    if learned.record.settings.get("oracle"):
        run.settings["oracle"] = True
    twin = Twin.load(learned.file("twin"))
    twin = body_of(twin).for_prediction(twin)
    velocity = initial_velocity(observations, twin.simulation.initial_velocity)
    trajectory = roll_out(twin, observations.controller_points, device, velocity=velocity, valid=observations.controller_valid)
    if trajectory.collision_overflow:
        print("warning: the collision list overflowed, so some contacts are missing; increase simulation.collision_capacity")
    files = run.beside(trajectory="trajectory.npz")
    trajectory.save(files["trajectory"])
    facts = {
        "frames": len(trajectory.positions),
        "spring_updates": (len(trajectory.positions) - 1) * twin.counts["springs"] * twin.counts["substeps"],
        "substeps": twin.simulation.substeps,
        "collision_overflow": trajectory.collision_overflow,
    }
    failure = f"rollout: {trajectory.reason}" if trajectory.diverged_frame is not None else ""
    return Written(files=files, facts=facts, failure=failure)
