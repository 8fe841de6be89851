"""What ground contact and self-collision share: an impulse with elasticity e in [0, 1] and friction mu in [0, 2].

A relative velocity u = u_n + u_t (normal, tangential) becomes

    -e u_n + a u_t,   a = max(0, 1 - mu (1 + e) |u_n| / |u_t|).
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from neuspring.physics.arrays import Buffers

APPROACH = 1e-4
"""Slower approaches do not collide (m/s for the ground; m^2/s, distance times speed, for pairs)."""
MIN_TANGENT = 1e-6
"""Tangential speeds are floored here when dividing, m/s."""
RANGES = {"elasticity": (0.0, 1.0), "friction": (0.0, 2.0)}
"""Values beyond are clamped on use, as in the released simulator."""


def pack(values: Mapping[str, torch.Tensor], kind: str) -> torch.Tensor:
    """The response (e, mu) [2] of a kind, "ground" or "contact" (between nodes), clamped to its ranges."""
    return torch.stack([values[f"{kind}_{name}"].clamp(*limits) for name, limits in RANGES.items()], dim=-1)


def fill(b: Buffers, kind: str, packed: torch.Tensor) -> None:
    """Take the responses [B, 2] of a kind."""
    for column, name in enumerate(("e", "mu")):
        b.set_numbers(f"{kind}_{name}", packed[:, column])


def gradient(b: Buffers, kind: str) -> torch.Tensor:
    """dL/d(e, mu) [B, 2] of a kind, summed over nodes."""
    return torch.stack([b.get_numbers(f"adj_{kind}_{name}").sum(dim=1) for name in ("e", "mu")], dim=-1)
