"""Twin and controllers of all frames -> trajectory."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from neuspring.core.artifacts import Observations, Twin
from neuspring.core.device import resolve_device
from neuspring.core.records import Recorder, StageRecord
from neuspring.stages import options as shared
from neuspring.twin.hand_paths import with_hands
from neuspring.twin.motion import initial_velocity
from neuspring.twin.rollout import roll_out


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring rollout`."""
    shared.add_observations(parser)
    shared.add_record(parser, "twin", "search.json or fit.json that names the twin")
    shared.add_device(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring rollout`."""
    run(a.observations, a.twin, a.device, a.output)


def run(observations_path: Path, twin_record: Path, device: str, output: Path) -> None:
    """Write trajectory.npz and the record `output`. A rollout that diverges is recorded as a failure.

    A twin that saw the future is called `oracle`.
    """
    device, before = resolve_device(device), StageRecord.load(twin_record)
    record = Recorder(
        "rollout",
        output,
        inputs={"observations": observations_path, before.stage: twin_record},
        settings={"oracle": True} if before.settings.get("oracle") else {},
        device=device,
    )
    if before.status == "failed":
        record.save(failure=f"{before.stage}: {before.reason}")
        return
    twin = Twin.load(before.file("twin", twin_record))
    observations = with_hands(Observations.load(observations_path), twin)
    velocity = initial_velocity(observations, twin.simulation.initial_velocity)
    trajectory = roll_out(twin, observations.controller_points, device, velocity=velocity, valid=observations.controller_valid)
    facts = {
        "frames": len(trajectory.positions),
        "spring_updates": (len(trajectory.positions) - 1) * twin.counts["springs"] * twin.counts["substeps"],
        "collision_overflow": trajectory.collision_overflow,
    }
    if trajectory.collision_overflow:
        print("warning: collision candidates did not fit the list; raise simulation.collision_capacity")
    files = record.beside(trajectory="trajectory.npz")
    trajectory.save(files["trajectory"])
    record.save(files, facts, failure=f"rollout: {trajectory.reason}" if trajectory.diverged_frame is not None else "")
