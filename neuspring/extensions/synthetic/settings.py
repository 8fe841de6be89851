"""Settings of synthetic scenes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from neuspring.core.section import Count, SettingsSection


@dataclass(frozen=True, kw_only=True)
class Synthetic(SettingsSection):
    """Synthetic captures: finite elements, rendered by a ray caster with a model of a depth sensor."""

    size: Literal["tiny", "small", "demo", "full"] = "demo"
    """Size of images, with matching meshes: 120 x 68, 424 x 240 (small: with coarser meshes) or 848 x 480 pixels."""
    frames: Annotated[int, Field(ge=5)] | None = None
    """Number of first frames to keep; null keeps all."""
    certified_frames: Count = 20
    """Number of first frames in which twice the substeps must not move the clip. More frames cost time and change no image."""
    sensor: Literal["model", "clean"] = "model"
    """Depth with noise, dropouts and holes (model), or only quantized (clean)."""
    efforts = {"size": ("small", "demo", "full"), "frames": (45, 60, None), "certified_frames": (5, 5, 20)}
