"""Settings of Spring-Gaus, adapted to captures with hands; the defaults are those of the public code where it says anything."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from neuspring.core.section import Count, SettingsSection


@dataclass(frozen=True, kw_only=True)
class SpringGaus(SettingsSection):
    """Anchors with directed springs, trained on masks, or, as a variant, on points."""

    supervision: Literal["masks", "points"] = "masks"
    """Training on silhouettes of the splats, as published, or on points. points: the Chamfer and track losses of the other
    methods, with anchors drawn from the structure points; this needs no images."""
    anchors: Count = 1024
    """Number N of anchors, drawn at random from the occupied cells of a grid of 1 cm, or of 1 mm where there are too few cells."""
    iterations: Count = 100
    """Passes over the training frames, with an optimizer step per frame."""
    efforts = {"anchors": (400, 400, 1024), "iterations": (40, 40, 100)}
