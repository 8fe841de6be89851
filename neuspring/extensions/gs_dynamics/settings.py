"""Settings of GS-Dynamics, adapted to captures with hands; the defaults are those of the public code where it says anything."""

from __future__ import annotations

from dataclasses import dataclass

from neuspring.core.section import Count, Positive, SettingsSection


@dataclass(frozen=True, kw_only=True)
class GsDynamics(SettingsSection):
    """A graph network that moves particles by what the hands do next, with a step per centimeter of hand motion."""

    batch: Count | None = None
    """Windows per update; null: 16 for ropes, 64 for others, as published."""
    width: Count = 512
    """Units of all hidden layers."""
    step: Positive = 0.01
    """Motion of the tools that makes a step, m."""
    epochs: Count = 50
    """Passes of training. The released predictions are of 50; the public code trains 500 to 1000."""
    updates_per_epoch: Count = 100
    """Optimizer steps per epoch, each on windows drawn at random."""
    efforts = {"width": (64, 64, 512), "batch": (4, 4, None), "epochs": (25, 25, 50), "updates_per_epoch": (40, 40, 100)}
