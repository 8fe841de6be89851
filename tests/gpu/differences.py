"""Numbers of two devices side by side."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch


@dataclass(frozen=True)
class Difference:
    """How far a device is from the CPU in one quantity, and how far it may be."""

    what: str
    unit: str
    found: float
    allowed: float

    @property
    def ok(self) -> bool:
        """Whether the difference is allowed; NaN is not."""
        return self.found <= self.allowed

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self) | {"ok": self.ok}


def array(values: Any) -> np.ndarray:
    """In float64 on the CPU."""
    return np.asarray(values.detach().cpu() if isinstance(values, torch.Tensor) else values, np.float64)


def largest(what: str, unit: str, received: Any, wanted: Any, allowed: float) -> Difference:
    """The largest difference of two arrays of one shape."""
    a, b = array(received), array(wanted)
    assert a.shape == b.shape, f"{what}: shape {a.shape} against {b.shape}"
    return Difference(what, unit, float(np.abs(a - b).max()), allowed)


def relative(what: str, received: Any, wanted: Any, allowed: float) -> Difference:
    """The largest difference of two arrays of one shape, of the largest entry on the CPU."""
    scale = float(np.abs(array(wanted)).max())
    return largest(what, "of the largest", array(received) / scale, array(wanted) / scale, allowed)
