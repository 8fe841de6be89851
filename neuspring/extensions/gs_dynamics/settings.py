"""Settings of GS-Dynamics, adapted to captures with hands; defaults are those of the public code where it defines them."""

from __future__ import annotations

from dataclasses import dataclass

from neuspring.core.section import Count, Positive, SettingsSection


@dataclass(frozen=True, kw_only=True)
class GsDynamics(SettingsSection):
    """A graph network that moves particles with the hands, in steps of one centimeter of hand motion."""

    batch: Count | None = None
    """Windows per update; null: 16 for ropes, 64 for other objects, as published."""
    width: Count = 512
    """Units of all hidden layers."""
    step: Positive = 0.01
    """Tool motion per step, m."""
    epochs: Count = 50
    """Training epochs. The released predictions used 50; the public code trains 500 to 1000."""
    updates_per_epoch: Count = 100
    """Optimizer steps per epoch, each on random windows."""
    efforts = {"width": (64, 64, 512), "batch": (4, 4, None), "epochs": (25, 25, 50), "updates_per_epoch": (40, 40, 100)}
