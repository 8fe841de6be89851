"""Settings of the simulator, and quirks of the released code that its paper does not describe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from neuspring.core.section import Count, Finite, SettingsSection

RestLengths = Literal["recording", "twin"]


@dataclass(frozen=True, kw_only=True)
class SimulationSettings(SettingsSection):
    """Integration. The scenario defines the up direction, the ground and self-collision."""

    substeps: Count | Literal["auto"] = "auto"
    """Substeps per frame; auto: the smallest number within the stability bound, 2000 at most. The search penalizes candidates
    that require more."""
    safety: Annotated[float, Field(gt=0, le=0.95)] = 0.8
    """Fraction of the stability bound that `substeps: auto` uses. Predictions of objects with self-collision use at most 0.4."""
    gravity: Finite = 9.8
    """Downward acceleration, m/s^2."""
    collision_capacity: Count = 500
    """Self-collision candidates per node and frame; overflow is reported."""
    initial_velocity: Literal["rest", "observed", "before"] = "rest"
    """Velocity in frame 0: zero (rest, as released), from the first three frames (observed), or from the sample before frame 0
    (before). before requires a source with that sample, and uses no later frame."""
    rest_lengths: RestLengths = "recording"
    """Rest lengths of a twin on another recording: scaled with distances in its frame 0 (recording), or unchanged (twin). Frame 0
    may be a pose under load. The nodes of both recordings must be the same."""


@dataclass(frozen=True, kw_only=True)
class ReleasedQuirks(SettingsSection):
    """Behaviors of the released PhysTwin code that its paper does not describe; off by default.

    neuspring/twin/README.md explains each of them.
    """

    integer_damping: bool = False
    """Truncate drag and dashpot to integers after the search."""
    frozen_loss_denominators: bool = False
    """Divide the losses of every frame by the valid counts of frame 1."""
    frame_time_667: bool = False
    """Use 667 substeps of 5e-5 s per frame (33.35 ms), independent of the frame rate."""
    sparse_checkpoints: bool = False
    """Select the best epoch only from every 20th epoch and the last."""
