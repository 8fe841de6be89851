"""Twin and controllers of all frames -> trajectory."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.config import Carry, Config
from neuspring.config.select import select
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.device import resolve_device
from neuspring.core.records import Recorder, StageRecord
from neuspring.stages import STAGES
from neuspring.stages import options as shared
from neuspring.twin.carry import carry_over
from neuspring.twin.hand_paths import with_hands
from neuspring.twin.motion import initial_velocity
from neuspring.twin.rollout import mean_trajectory, roll_out


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring rollout`."""
    shared.add_observations(parser)
    twins = "search.json or fit.json that names the twin; of several, the mean of the trajectories"
    parser.add_argument("--twin", type=Path, nargs="+", required=True, help=twins)
    carry = "correct the state at the last training frame by what was observed until then, where training frames say that it helps"
    kinds = {"choices": ("residuals", "state"), "nargs": "?", "const": "residuals", "default": None}
    parser.add_argument("--carry-over", help=carry, **kinds)  # type: ignore[arg-type]
    shared.add_settings(parser)
    shared.add_device(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring rollout`."""
    run(a.observations, a.twin, a.carry_over, a.device, a.output, shared.read_settings(a.settings))


def run(
    observations_path: Path,
    twin_records: Sequence[Path],
    carry: Carry | None,
    device: str,
    output: Path,
    settings: Config | None = None,
) -> None:
    """Write trajectory.npz and the record `output`. A rollout that diverges is recorded as a failure.

    With several records, the result is the mean of their trajectories. `carry` corrects the state at the last training frame by
    what was observed until then, where training frames say that it helps. A twin that saw the future is called `oracle`.
    """
    settings = settings or Config()
    device = resolve_device(device)
    before = {path: StageRecord.load(path) for path in twin_records}
    inputs = {f"{record.stage}{index or ''}": path for index, (path, record) in enumerate(before.items())}
    own: dict[str, Any] = {"carry_over": carry or False}
    if carry == "state":
        own |= {"task": "prediction from the last frame"} | select(settings, STAGES["rollout"].reads)
    if any(record.settings.get("oracle") for record in before.values()):
        own["oracle"] = True
    record = Recorder(
        "rollout",
        output,
        inputs={"observations": observations_path} | inputs,
        settings=own,
        device=device,
    )
    failed = next((stage for stage in before.values() if stage.status == "failed"), None)
    if failed:
        record.save(failure=f"{failed.stage}: {failed.reason}")
        return
    seen = Observations.load(observations_path)
    trajectories, corrections, updates = [], [], 0
    for path, stage in before.items():
        twin = Twin.load(stage.file("twin", path))
        observations = with_hands(seen, twin)
        velocity = initial_velocity(observations, twin.simulation.initial_velocity)
        trajectory = roll_out(twin, observations.controller_points, device, velocity=velocity, valid=observations.controller_valid)
        updates += (len(trajectory.positions) - 1) * twin.counts["springs"] * twin.counts["substeps"]
        if carry:
            trajectory, correction = carry_over(trajectory, twin, observations, velocity, device, carry, settings.last_frame)
            corrections.append(correction)
        trajectories.append(trajectory)
    # A diverged rollout ends earlier; the mean would hide that.
    diverged = next((one for one in trajectories if one.diverged_frame is not None), None)
    trajectory = diverged or mean_trajectory(trajectories)
    facts: dict[str, Any] = {"frames": len(trajectory.positions), "averaged": len(trajectories)}
    if corrections:
        facts |= {f"carry_over_{name}": float(np.mean([one[name] for one in corrections])) for name in corrections[0]}
    else:
        # Carrying over simulates more, which nobody counts.
        facts["spring_updates"] = updates
    facts["collision_overflow"] = trajectory.collision_overflow
    if trajectory.collision_overflow:
        print("warning: collision candidates did not fit the list; raise simulation.collision_capacity")
    files = record.beside(trajectory="trajectory.npz")
    trajectory.save(files["trajectory"])
    record.save(files, facts, failure=f"rollout: {trajectory.reason}" if diverged else "")
