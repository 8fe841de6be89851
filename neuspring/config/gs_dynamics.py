"""Settings of GS-Dynamics, as adapted to captures with hands; the defaults are those of the public code where it says anything."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from neuspring.config.types import STRICT, Count, NonNegative, Positive

NodeInput = Literal["full", "short"]
Tools = Literal["points", "centroids"]
Propagation = Literal["all", "nearest"]


@dataclass(frozen=True, kw_only=True)
class GsDynamics:
    """A graph network that moves particles by what the hands do next, a step per centimetre of hand motion."""

    __pydantic_config__ = STRICT
    preset: Literal["auto", "rope", "animals", "cloth"] = "auto"
    """Which public configuration the keys that are null take their values from. auto: by the scenario's category; rope and DLO
    cables: rope, cloth and package: cloth, all others: animals."""
    radius: Positive | None = None
    """Nodes nearer than this feel each other, m. rope 0.08, animals 0.08, cloth 0.075."""
    neighbours: Count | None = None
    """k: a particle feels its k nearest particles, the first of which is itself. rope 5, animals 6, cloth 6."""
    particles: Count | None = None
    """Most particles of a graph. rope 100, animals 100, cloth 150."""
    noise: NonNegative | None = None
    """Uniform noise of positions in the history while training, +- m. rope 0.003, animals 0.003, cloth 0.002."""
    length_weight: NonNegative | None = None
    """Lambda of the length loss. rope 0.1, animals 0.05, cloth 0.1."""
    batch: Count | None = None
    """Windows per update. rope 16, animals 64, cloth 64."""
    connect_all: bool | None = None
    """Edges between each tool and each particle, not only within the radius; null: with `tools: centroids` only."""
    node_input: NodeInput | None = None
    """full: kind, heights, displacements and action of a node. short: kind and action. rope short, others full."""
    tools: Tools = "points"
    """points: every controller is a tool node. centroids: one tool node per hand, at the mean of its controllers."""
    width: Count = 512
    """Of all hidden layers."""
    rounds: Count = 3
    """Of message passing, with the same weights."""
    history: Count = 3
    """Steps that the network sees, the present one included."""
    future: Count = 5
    """Steps that training predicts in a row."""
    step: Positive = 0.01
    """Motion of the tools that makes a step, m."""
    last_accepted: Annotated[float, Field(gt=0, le=1)] = 0.75
    """Part of a step at which the last training frame ends one."""
    coverage: NonNegative = 0.03
    """No more particles are added once all points lie within this of one, m."""
    dense_points: Count = 1000
    """Most tracks that particles are drawn from."""
    smoothing_passes: Annotated[int, Field(ge=0)] = 10
    """Moving averages of tracks over three frames, within the training frames, of what is seen."""
    outlier_deviations: NonNegative = 3.0
    """Tracks are dropped whose path length differs by so many median absolute deviations from the median; 0 drops none."""
    min_visible: Count = 20
    """Where fewer tracks are seen in all frames of a window, it takes those seen in its history, and losses leave out what is not
    seen."""
    yaw: bool = True
    """Turn each training window by a random angle about the vertical."""
    epochs: Count = 50
    """Passes; the released predictions are of so many, the public code trains 500 to 1000."""
    updates_per_epoch: Count = 100
    """Optimiser steps per epoch, each on windows drawn at random."""
    learning_rate: Positive = 1e-3
    """Adam's."""
    faithful_length_loss: bool = False
    """As published: edges to tools count in the length loss as the distance of the particle from the world's origin, which
    penalises motion; off: they are left out."""
    padded_mean: bool = False
    """As published: the mean of squared errors counts unused particles, up to `particles` per window; off: particles that are
    there."""
    propagation: Propagation = "all"
    """How structure points follow particles: by all of them, as published, or by the nearest."""
    nearest: Count = 16
    """Particles that a structure point follows with `propagation: nearest`."""
    interpolate: bool = True
    """Between steps structure points move on straight lines, which needs the next step, so offline only; off: they wait."""
    checkpoint_every: Count = 5
    """Epochs between checkpoints from which a killed job continues."""

    def __post_init__(self) -> None:
        if self.min_visible > self.dense_points:
            raise ValueError(f"min_visible: at most dense_points ({self.dense_points}), received {self.min_visible}")
