"""Settings of rods: the start of their fit, and what is fitted along the arc."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from neuspring.core.section import Count, SettingsSection


@dataclass(frozen=True, kw_only=True)
class RodSettings(SettingsSection):
    """A long thin body as a rod (rods/made.py)."""

    rest: Literal["straight", "first_frame"] = "straight"
    """The shape without moments: straight, or as in frame 0; with `lay_out` the unloaded one that the recording knows."""
    lay_out: Annotated[int, Field(ge=4)] | None = None
    """Number of vertices that are laid evenly along the unloaded shape of a line of which few places are observed. They begin at a
    hand, which clamps them with its pose, and in frame 0 they rest under gravity. null: the observed places are the vertices."""


@dataclass(frozen=True, kw_only=True)
class RodFit(SettingsSection):
    """Levenberg-Marquardt on whole recordings (twin/rod_fit.py), for methods whose `fit` is rod."""

    stiffness: Literal["constant", "knots", "free"] = "constant"
    """EI and GJ along the arc: one value each; a smooth field, cubic between `knots`; free at each joint."""
    curvature: Literal["straight", "constant", "knots", "free"] = "free"
    """Unloaded curvature along the arc: as at the start; one of all; a smooth field; free at each joint."""
    slip: Annotated[int, Field(ge=0)] = 0
    """Branches that slip in bending and twist, friction inside the rod, which are fitted; 0: none."""
    knots: Annotated[int, Field(ge=4)] = 5
    """Knots of a smooth field along the arc."""
    horizons: tuple[Annotated[int, Field(ge=0)], ...] = (60, 150, 0)
    """Training frames that count, one stage of the fit after the other; 0: all. The search has the first."""
    every: Count = 4
    """Stride of the frames that count."""
