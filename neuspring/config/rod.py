"""Settings of rods: the start of their fit, and what is fitted along the arc."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from neuspring.core.section import SettingsSection


@dataclass(frozen=True, kw_only=True)
class RodSettings(SettingsSection):
    """A long thin body as a rod (twin/rod.py)."""

    rest: Literal["straight", "first_frame"] = "straight"
    """The shape without moments: straight, or as in frame 0."""


@dataclass(frozen=True, kw_only=True)
class RodFit(SettingsSection):
    """Levenberg-Marquardt on whole recordings (twin/rod_fit.py), for methods whose `fit` is rod."""

    stiffness: Literal["constant", "knots", "free"] = "constant"
    """EI and GJ along the arc: one value each; a smooth field, cubic between 5 knots; free at each joint."""
    curvature: Literal["straight", "constant", "knots", "free"] = "free"
    """Unloaded curvature along the arc: as at the start; one of all; a smooth field; free at each joint."""
