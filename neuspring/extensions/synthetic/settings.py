"""Settings of synthetic scenes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from neuspring.core.section import Count, SettingsSection


@dataclass(frozen=True, kw_only=True)
class Synthetic(SettingsSection):
    """Synthetic captures: finite elements seen by a ray caster through a model of a depth sensor."""

    size: Literal["tiny", "small", "demo", "full"] = "demo"
    """Size of the images, with meshes to match: 120 x 68, 424 x 240 (small: with coarser bodies) or 848 x 480 pixels."""
    frames: Annotated[int, Field(ge=5)] | None = None
    """Number of frames that are kept, the first ones; null keeps all."""
    certified_frames: Count = 20
    """Number of first frames in which twice the substeps must not move the clip; more of them cost time and change no picture."""
    sensor: Literal["model", "clean"] = "model"
    """Depth sensor: with noise, dropouts and holes (model), or only quantized (clean)."""
    efforts = {"size": ("small", "demo", "full"), "frames": (45, 60, None), "certified_frames": (5, 5, 20)}
