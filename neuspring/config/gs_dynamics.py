"""Settings of GS-Dynamics, as adapted to captures with hands; the defaults are those of the public code where it says anything."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from neuspring.config.types import Count, NonNegative, Positive, Section


@dataclass(frozen=True, kw_only=True)
class GsDynamics(Section):
    """A graph network that moves particles by what the hands do next, with a step per centimeter of hand motion."""

    preset: Literal["auto", "rope", "animals", "cloth"] = "auto"
    """Public configuration from which keys that are null take their values. auto: by the scenario's category: rope and DLO cables
    take rope, cloth and package take cloth, all others take animals."""
    radius: Positive | None = None
    """Distance below which nodes feel each other, m. rope 0.08, animals 0.08, cloth 0.075."""
    neighbors: Count | None = None
    """Number k of nearest particles that a particle feels, itself included. rope 5, animals 6, cloth 6."""
    particles: Count | None = None
    """Largest number of particles of a graph. rope 100, animals 100, cloth 150."""
    noise: NonNegative | None = None
    """Half width of the uniform noise that training adds to positions in the history, m. rope 0.003, animals 0.003, cloth 0.002."""
    length_weight: NonNegative | None = None
    """Weight lambda of the length loss. rope 0.1, animals 0.05, cloth 0.1."""
    batch: Count | None = None
    """Windows per update. rope 16, animals 64, cloth 64."""
    width: Count = 512
    """Units of all hidden layers."""
    future: Count = 5
    """Steps that training predicts in a row."""
    step: Positive = 0.01
    """Motion of the tools that makes a step, m."""
    coverage: NonNegative = 0.03
    """Distance, m: no more particles are added once every point lies within it of a particle."""
    dense_points: Count = 1000
    """Largest number of tracks from which particles are drawn."""
    smoothing_passes: Annotated[int, Field(ge=0)] = 10
    """Passes of a moving average over three frames on the visible part of tracks, within the training frames."""
    outlier_deviations: NonNegative = 3.0
    """Median absolute deviations by which the path length of a track may differ from the median before the track is dropped; 0
    drops none."""
    min_visible: Count = 20
    """Smallest number of tracks that must be seen in all frames of a window. Where fewer are, the window takes the tracks seen in
    its history, and the losses leave out what is not seen."""
    yaw: bool = True
    """Turn each training window by a random angle about the vertical."""
    epochs: Count = 50
    """Passes of training. The released predictions are of 50; the public code trains 500 to 1000."""
    updates_per_epoch: Count = 100
    """Optimizer steps per epoch, each on windows drawn at random."""
    learning_rate: Positive = 1e-3
    """Adam's learning rate."""
    checkpoint_every: Count = 5
    """Epochs between checkpoints from which a killed job continues."""

    def __post_init__(self) -> None:
        if self.min_visible > self.dense_points:
            raise ValueError(f"min_visible: at most dense_points ({self.dense_points}), received {self.min_visible}")
