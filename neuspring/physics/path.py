"""The way of the controllers within a frame: a straight line, or a cubic through the positions of neighboring frames.

With u in (0, 1] the fraction of the frame, p0 and p1 the positions at its ends, d = p1 - p0, and m0 and m1 the tangents there in
meters per frame, the cubic is Hermite's,

    p(u) = p0 + u d + u (1 - u)^2 (m0 - d) - u^2 (1 - u) (m1 - d),

the straight line where m0 = m1 = d. Tangents are those of the parabola through three neighboring frames (Catmull and Rom 1974):
half the way from the frame before to the frame after, and one-sided in the first and the last frame.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch

from neuspring.physics.grips import BEGINS


class ChosenPath(Protocol):
    """The simulation of a twin, or the settings that it is made with."""

    @property
    def controller_path(self) -> str:
        """linear or cubic."""


def waypoints(hands: torch.Tensor, simulation: ChosenPath, valid: np.ndarray | None = None) -> torch.Tensor:
    """What a solver takes for `begin` and `end` of frames, one row per frame: hands [T, C, 3], m, or with their tangents [T, C, 6].

    Where some controller does not hold in some frame (`valid` [T', C], T' >= T; empty or none: all hold), a last column has 1 or 0,
    and 2 where it begins to hold, but in frame 0. The springs of a controller act in a frame if it holds at both ends of the frame.
    When it begins to hold they take the rest lengths of that moment (grips.py).

    A row depends on the frames next to it, so make them for all known frames before taking some.
    """
    rows = hands if simulation.controller_path == "linear" else torch.cat([hands, tangents(hands)], dim=-1)
    if valid is None or valid.all():
        return rows
    holds = torch.tensor(valid[: len(hands)], dtype=hands.dtype, device=hands.device)
    holds[1:] += (BEGINS - 1.0) * (holds[1:] - holds[:-1]).clamp(min=0.0)
    return torch.cat([rows, holds[..., None]], dim=-1)


def tangents(hands: torch.Tensor) -> torch.Tensor:
    """Change of position per frame [T, C, 3], m, in each frame of hands [T, C, 3]."""
    if len(hands) < 3:
        return (hands[-1:] - hands[:1]).expand_as(hands)
    inner = (hands[2:] - hands[:-2]) / 2
    first = 2 * (hands[1] - hands[0]) - inner[0]
    last = 2 * (hands[-1] - hands[-2]) - inner[-1]
    return torch.cat([first[None], inner, last[None]])
