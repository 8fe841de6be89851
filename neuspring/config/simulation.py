"""Settings of the simulator, and of the released code's departures from its own description."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from neuspring.config.parse import Count, Finite, Section


@dataclass(frozen=True, kw_only=True)
class Simulation(Section):
    """Integration. Which way is up, the ground and self-collision come with the scenario."""

    substeps: Count | Literal["auto"] = "auto"
    """Integration steps per frame; `auto` takes the smallest count that the stability bound allows."""
    safety: Annotated[float, Field(gt=0, le=0.95)] = 0.8
    """Fraction of the stability bound that `auto` uses. Predictions of a body that can meet itself use at most 0.4."""
    max_substeps: Count = 2000
    """Upper limit of `auto`; the search penalizes a candidate that would need more."""
    gravity: Finite = 9.8
    """Acceleration downwards, m/s^2."""
    collision_capacity: Count = 500
    """Candidate partners for self-collision, per node and frame; overflow is reported."""
    controller_velocity: bool = False
    """Dashpots use the controllers' velocity (finite differences); false: zero velocity, as in the released simulator."""
    initial_velocity: Literal["rest", "observed", "before"] = "rest"
    """Velocity in frame 0. rest: zero, as released. observed: from the first three frames, for captures that begin in motion.
    before: from the sample before frame 0, where a recording has one (`mocap.start` of at least 1); no later frame is used."""


@dataclass(frozen=True, kw_only=True)
class ReleasedQuirks(Section):
    """Behaviors of the released PhysTwin code that differ from its description; all are off by default.

    Each is explained in neuspring/twin/README.md.
    """

    integer_damping: bool = False
    """Truncate drag and dashpot to integers after the search."""
    frozen_loss_denominators: bool = False
    """Divide the losses of every frame by the valid counts of frame 1."""
    frame_time_667: bool = False
    """Let a frame last 667 x 5e-5 s = 33.35 ms in 667 substeps, whatever the frame rate."""
    sparse_checkpoints: bool = False
    """Look for the best epoch only among every 20th epoch and the last."""
