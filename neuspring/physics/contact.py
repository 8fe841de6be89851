"""What ground contact and self-collision share: an impulse with elasticity e in [0, 1] and friction mu in [0, 2].

A relative velocity u = u_n + u_t (normal, tangential) becomes

    -e u_n + a u_t,   a = max(0, 1 - mu (1 + e) |u_n| / |u_t|).
"""

from __future__ import annotations

import torch

APPROACH = 1e-4
"""Slower approaches do not collide (m/s for the ground; m^2/s, distance times speed, for pairs)."""
MIN_TANGENT = 1e-6
"""Tangential speeds are floored here when dividing, m/s."""
RANGES = {"elasticity": (0.0, 1.0), "friction": (0.0, 2.0)}
"""Values beyond are clamped on use, as in the released simulator."""


def pack(elasticity: torch.Tensor, friction: torch.Tensor) -> torch.Tensor:
    """The response (e, mu) [2], clamped to its ranges."""
    return torch.stack([elasticity.clamp(*RANGES["elasticity"]), friction.clamp(*RANGES["friction"])])
