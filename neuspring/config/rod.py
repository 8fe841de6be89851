"""Settings of rods: the start of their fit, and what is fitted along the arc."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from neuspring.core.section import Positive, SettingsSection


@dataclass(frozen=True, kw_only=True)
class RodSettings(SettingsSection):
    """A long thin body as a rod (twin/rod.py): its vertices, and the stiffness that its fit starts from.

    Motion depends on stiffness over mass alone. So stiffness is given for a body of 1 kg/m; a body of another mass per length has
    as many times more.
    """

    vertices: Annotated[int, Field(ge=4)] = 24
    """Vertices of a center line that is found among nodes. One that the observations give has its own."""
    bending: Positive = 0.1
    """EI, N m^2."""
    twisting: Positive = 0.1
    """GJ, N m^2."""
    rest: Literal["straight", "first_frame"] = "straight"
    """The shape without moments: straight, or as in frame 0."""


@dataclass(frozen=True, kw_only=True)
class RodFit(SettingsSection):
    """Levenberg-Marquardt on whole recordings (twin/rod_fit.py), for methods whose `fit` is rod."""

    stiffness: Literal["constant", "knots", "free"] = "constant"
    """EI and GJ along the arc: one value each; a smooth field, cubic between `knots`; free at each joint."""
    curvature: Literal["straight", "constant", "knots", "free"] = "free"
    """Unloaded curvature along the arc: as at the start; one of all; a smooth field; free at each joint."""
    knots: Annotated[int, Field(ge=4)] = 5
    """Knots of a field along the arc."""
