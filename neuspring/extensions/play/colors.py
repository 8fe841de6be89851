"""Colors of springs by stiffness, with a legend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex

from neuspring.draw.twin import STIFFNESS_COLORS, stiffness_limits


@dataclass(frozen=True)
class Scale:
    """Logarithmic color scale from stiffness `low` to `high`, N, shared by all shown runs."""

    low: float
    high: float

    @classmethod
    def of(cls, stiffness: Sequence[np.ndarray]) -> Scale:
        """Scale over the springs of several twins, an array [S] each."""
        return cls(*stiffness_limits(np.concatenate(stiffness)))

    def paint(self, stiffness: np.ndarray) -> np.ndarray:
        """RGB [S, 3] uint8; values outside the scale get the color of its end."""
        values, low, high = (np.log(np.maximum(value, 1e-30)) for value in (stiffness, self.low, self.high))
        share = np.clip((values - low) / (high - low), 0, 1)
        return np.asarray(255 * colormaps[STIFFNESS_COLORS](share)[:, :3] + 0.5, np.uint8)

    def legend(self) -> str:
        """Legend as HTML: a bar from low to high with values and unit."""
        stops = ", ".join(to_hex(color) for color in colormaps[STIFFNESS_COLORS](np.linspace(0, 1, 12)))
        ticks = "".join(f"<span>{float(f'{y:.3g}'):,g}</span>" for y in (self.low, np.sqrt(self.low * self.high), self.high))
        return (
            "<div style='margin:0 .6em;font-size:.8em'><b>stiffness Y</b> of springs [N], for 1 kg per node (rod: per meter)"
            f"<div style='height:.9em;margin:.2em 0;border-radius:2px;background:linear-gradient(to right, {stops})'></div>"
            f"<div style='display:flex;justify-content:space-between'>{ticks}</div></div>"
        )


def linear(rgb: np.ndarray) -> np.ndarray:
    """Convert sRGB [..., 3] uint8 to linear light (IEC 61966-2-1), which viser expects for colors of springs and nodes."""
    codes = rgb / 255
    return np.asarray(255 * np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4) + 0.5, np.uint8)
