"""Settings of the simulator, and of the released code's departures from its own description."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from neuspring.core.section import Count, Finite, SettingsSection

RestLengths = Literal["recording", "twin"]


@dataclass(frozen=True, kw_only=True)
class SimulationSettings(SettingsSection):
    """Integration. Which way is up, the ground and self-collision come with the scenario."""

    substeps: Count | Literal["auto"] = "auto"
    """Integration steps per frame; `auto` takes the smallest count that the stability bound allows, 2000 at most: the
    search penalizes a candidate that would need more."""
    safety: Annotated[float, Field(gt=0, le=0.95)] = 0.8
    """Fraction of the stability bound that `auto` uses. Predictions of a body that can meet itself use at most 0.4."""
    gravity: Finite = 9.8
    """Acceleration downwards, m/s^2."""
    collision_capacity: Count = 500
    """Candidate partners for self-collision, per node and frame; overflow is reported."""
    initial_velocity: Literal["rest", "observed", "before"] = "rest"
    """Velocity in frame 0: zero (rest), from the first three frames (observed), or from the sample before it (before). rest is as
    released; before needs a source that knows that sample, and uses no later frame."""
    rest_lengths: RestLengths = "recording"
    """Rest lengths of a twin on another recording with the same nodes: scaled with distances in that recording's frame 0, though
    frame 0 is a pose under load (recording), or as they are (twin)."""


@dataclass(frozen=True, kw_only=True)
class ReleasedQuirks(SettingsSection):
    """Behaviors of the released PhysTwin code that differ from its description; all are off by default.

    Each is explained in neuspring/twin/README.md.
    """

    integer_damping: bool = False
    """Truncation of drag and dashpot to integers after the search."""
    frozen_loss_denominators: bool = False
    """Divide the losses of every frame by the valid counts of frame 1."""
    frame_time_667: bool = False
    """Let a frame last 667 x 5e-5 s = 33.35 ms in 667 substeps, whatever the frame rate."""
    sparse_checkpoints: bool = False
    """Look for the best epoch only among every 20th epoch and the last."""
