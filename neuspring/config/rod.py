"""Settings of rods: where the fit of a rod begins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from neuspring.config.parse import Finite, NonNegative, Positive, Section


@dataclass(frozen=True, kw_only=True)
class Rod(Section):
    """A long thin body as a rod (twin/rod.py): its vertices, and the values that its fit starts from.

    Motion depends on stiffness over mass alone. So stiffness, and the mass of markers, are given for a body of 1 kg/m; a body of
    another mass per length has as many times more of each.
    """

    vertices: Annotated[int, Field(ge=4)] = 24
    """Vertices of a center line that is found among nodes. One that the observations give has its own."""
    bending: Positive = 0.03
    """EI, N m^2."""
    twisting: Positive = 0.03
    """GJ, N m^2."""
    stretching: Positive = 2e4
    """EA, N."""
    damping: NonNegative = 0.01
    """Time of inner damping, s."""
    marker_mass: NonNegative = 0.01
    """Mass of a marker at each vertex of a center line that the observations give, kg."""
    drag: NonNegative = 0.3
    """Linear drag, 1/s."""
    drag_quadratic: NonNegative = 0.1
    """Quadratic drag, 1/m."""
    rest: Literal["straight", "first_frame"] = "straight"
    """The shape without moments: straight, or as in frame 0."""
    axis: tuple[Finite, Finite, Finite] = (0.0, 0.6, 0.8)
    """Direction of the world whose projection is the first director of clamped ends in frame 0."""
    roll: Finite = 0.0
    """Turn of the last clamp's directors in frame 0, rad."""
    substep: Positive = 0.002
    """Longest integration step with `simulation.substeps: auto`, s."""
