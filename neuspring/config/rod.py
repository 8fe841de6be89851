"""Settings of rods: where the fit of a rod begins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from neuspring.config.parse import Finite, Positive, Section


@dataclass(frozen=True, kw_only=True)
class RodSettings(Section):
    """A long thin body as a rod (twin/rod.py): its vertices, and the values that its fit starts from.

    Motion depends on stiffness over mass alone. So stiffness, and the mass of markers, are given for a body of 1 kg/m; a body of
    another mass per length has as many times more of each.
    """

    vertices: Annotated[int, Field(ge=4)] = 24
    """Vertices of a center line that is found among nodes. One that the observations give has its own."""
    bending: Positive = 0.1
    """EI, N m^2."""
    twisting: Positive = 0.1
    """GJ, N m^2."""
    stretching: Positive = 2e4
    """EA, N."""
    damping: Positive = 0.05
    """Time of inner damping, s."""
    marker_mass: Positive = 0.03
    """Mass of a marker at each vertex of a center line that the observations give, kg."""
    drag: Positive = 0.1
    """Linear drag, 1/s."""
    drag_quadratic: Positive = 0.05
    """Quadratic drag, 1/m."""
    rest: Literal["straight", "first_frame"] = "straight"
    """The shape without moments: straight, or as in frame 0."""
    axes: tuple[tuple[Finite, Finite, Finite], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    """Directions of the world whose projection may be the first director of clamped ends; the search chooses (twin/rod_fit.py)."""
    roll: Finite = 0.0
    """Turn of the last clamp's directors, rad."""
    substep: Positive = 0.005
    """Longest integration step with `simulation.substeps: auto`, s."""


@dataclass(frozen=True, kw_only=True)
class RodFit(Section):
    """Levenberg-Marquardt on whole recordings (twin/rod_fit.py), for methods whose `fit` is rod."""

    stiffness: Literal["constant", "knots", "free"] = "constant"
    """EI and GJ along the arc: one value each; a smooth field, cubic between `knots`; free at each joint."""
    curvature: Literal["straight", "constant", "knots", "free"] = "free"
    """Unloaded curvature along the arc: as at the start; one of all; a smooth field; free at each joint."""
    knots: Annotated[int, Field(ge=4)] = 5
    """Knots of a field along the arc."""
    markers: bool = True
    """Fit of how far markers lie beside the center line, and the lengths between them."""
    horizons: tuple[Annotated[int, Field(ge=0)], ...] = (60, 150, 0)
    """Training frames that count, one stage of the fit after the other; 0: all."""
    rounds: Annotated[int, Field(ge=1)] = 8
    """Steps per stage, at most; a stage ends where a step gains less than 0.2 %."""
    every: Annotated[int, Field(ge=1)] = 4
    """Stride of the frames that count."""
    robust: Positive = 0.02
    """Robustness b, m: errors e count as sqrt(e^2 + b^2), so that recordings that flip do not decide."""

    def __post_init__(self) -> None:
        if not self.horizons:
            raise ValueError("horizons: at least one stage is required, received none")
