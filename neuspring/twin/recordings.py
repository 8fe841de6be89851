"""Several recordings of one object, on which one twin is judged: the pool."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from neuspring import config
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.errors import InputError
from neuspring.physics.controllers import waypoints
from neuspring.twin.losses import FrameLoss
from neuspring.twin.motion import initial_velocity
from neuspring.twin.transfer import corresponds, rebase
from neuspring.twin.trials import Outcome


@dataclass(frozen=True)
class Recording:
    """The training frames of a recording: hands and start velocities of its own, and the losses of its frames."""

    observations: Observations
    hands: torch.Tensor
    """Waypoints of the controllers (controllers.py), [train_end, C, 3], m."""
    velocity: torch.Tensor
    """Of the nodes in frame 0 [N, 3], m/s."""
    loss: FrameLoss

    @classmethod
    def of(
        cls,
        observations: Observations,
        simulation: config.Simulation,
        losses: config.Losses,
        quirks: config.ReleasedQuirks,
        device: str = "cpu",
    ) -> Recording:
        """A recording, judged with the settings of a search."""
        hands = torch.tensor(observations.controller_points, device=device)[: observations.scenario.train_end]
        velocity = initial_velocity(observations, simulation.initial_velocity)
        return cls(
            observations,
            waypoints(hands, observations.controller_valid),
            torch.tensor(velocity, dtype=torch.float32, device=device),
            FrameLoss.of(observations, losses, device, frozen_counts=quirks.frozen_loss_denominators),
        )


def require_pool(here: Observations, pool: Sequence[Observations], leave_out: bool) -> None:
    """Raise InputError unless a twin can be judged on the pool: other recordings, with as many nodes and hands."""
    name = f"pool of {here.scenario.name}"
    if leave_out and not pool:
        raise InputError(name, "at least one other recording is required where this one is left out", "none")
    counts = len(here.nodes), here.controller_points.shape[1]
    for there in pool:
        received = len(there.nodes), there.controller_points.shape[1]
        if received != counts:
            rule = f"recordings of a pool must have as many nodes and controllers: {counts[0]} and {counts[1]}"
            value = f"{received[0]} and {received[1]} in {there.scenario.name}"
            raise InputError(name, rule, value, "Sample all alike (mocap.rings).")


def on_recording(twin: Twin, observations: Observations, quirks: config.ReleasedQuirks) -> Twin:
    """The twin on the nodes of a recording of its pool, node i on node i. Raises InputError if those are others."""
    if not corresponds(twin.topology, observations):
        name = f"pool, {observations.scenario.name}"
        raise InputError(name, "recordings of a pool must have the same nodes", "others", "Sample all alike (mocap.rings).")
    return rebase(twin, observations, keep_frame_time=quirks.frame_time_667)


def mean_outcome(outcomes: Sequence[Outcome]) -> Outcome:
    """Of one candidate on several recordings: the mean cost; it left the scene if it left any."""
    if len(outcomes) == 1:
        return outcomes[0]
    left = next((one.left for one in outcomes if one.left), 0)
    cost = float(np.mean([one.cost for one in outcomes]))
    return Outcome(cost, left, sum(one.collision_overflow for one in outcomes))
