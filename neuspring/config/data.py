"""Settings of the data sources that this package simulates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from neuspring.core.section import SettingsSection


@dataclass(frozen=True, kw_only=True)
class Toy(SettingsSection):
    """Analytic scenes with known stiffness, simulated by the float64 reference."""

    frames: Annotated[int, Field(ge=5)] = 60
    """Frames per scene; the first 70 % are training frames."""
