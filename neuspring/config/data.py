"""Settings of the sources of data that this package makes or samples itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from neuspring.core.section import SettingsSection


@dataclass(frozen=True, kw_only=True)
class Toy(SettingsSection):
    """Analytic scenes simulated by the float64 reference, with known stiffness."""

    frames: Annotated[int, Field(ge=5)] = 60
    """Frames per scene; the first 70 % are for training."""
