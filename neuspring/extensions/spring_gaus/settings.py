"""Settings of Spring-Gaus, adapted to captures with hands; defaults are those of the public code where it defines them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from neuspring.core.section import Count, SettingsSection


@dataclass(frozen=True, kw_only=True)
class SpringGaus(SettingsSection):
    """Anchors with directed springs, trained on masks or, as a variant, on points."""

    supervision: Literal["masks", "points"] = "masks"
    """masks: silhouettes of the splats, as published. points: the Chamfer and track losses of the other methods, with anchors
    sampled from the structure points; this needs no images."""
    anchors: Count = 1024
    """Number N of anchors, sampled from the occupied cells of a grid of 1 cm, or of 1 mm if there are too few cells."""
    iterations: Count = 100
    """Passes over the training frames, with one optimizer step per frame."""
    efforts = {"anchors": (400, 400, 1024), "iterations": (40, 40, 100)}
