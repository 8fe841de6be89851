"""Colors of springs: by stiffness, region, strain or force, each with its range and a legend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex

from neuspring.core.artifacts import Twin
from neuspring.draw.twin import STIFFNESS_COLORS, region_colors, stiffness_limits
from neuspring.twin.body import Lines, lines_of

QUANTITIES = ("stiffness", "strain", "force", "region")
DIVERGING = "coolwarm"
LEGEND_STEPS = 12
"""Colors of a legend's bar."""
PLAIN_COLOR = np.array([150, 150, 150], np.uint8)
CROSSING_COLOR = np.array([70, 70, 70], np.uint8)
OVER_COLOR = np.array([255, 0, 0], np.uint8)
"""Springs beyond the strain that is given as the most."""
LEAST_STRAIN, LEAST_FORCE = 0.02, 0.1
"""Half of the narrowest range, 1 and N: noise must not fill the colors."""


@dataclass(frozen=True)
class Scale:
    """A range of values and its colors; `log` for a logarithmic one."""

    title: str
    low: float
    high: float
    unit: str
    colors: str
    log: bool = False

    def paint(self, values: np.ndarray) -> np.ndarray:
        """RGB [S, 3] uint8 of values [S]; beyond the ends, the color of the end."""
        low, high = self.low, self.high
        if self.log:
            values, low, high = np.log(np.maximum(values, 1e-30)), np.log(low), np.log(high)
        part = np.clip((values - low) / (high - low), 0, 1)
        return np.asarray(255 * colormaps[self.colors](part)[:, :3] + 0.5, np.uint8)

    def legend(self) -> str:
        """The legend as HTML: a bar from low to high with values and unit."""
        stops = ", ".join(to_hex(color) for color in colormaps[self.colors](np.linspace(0, 1, LEGEND_STEPS)))
        middle = np.sqrt(self.low * self.high) if self.log else 0.5 * (self.low + self.high)
        ticks = "".join(f"<span>{value:.3g}</span>" for value in (self.low, middle, self.high))
        kind = ", logarithmic" if self.log else ""
        return (
            f"<div style='margin:0 .6em;font-size:.8em'><b>{escape(self.title)}</b> [{escape(self.unit)}]{kind}"
            f"<div style='height:.9em;margin:.2em 0;border-radius:2px;background:linear-gradient(to right, {stops})'></div>"
            f"<div style='display:flex;justify-content:space-between'>{ticks}</div></div>"
        )


@dataclass(frozen=True, eq=False)
class Springs:
    """The springs that are drawn, all of a twin's or a part of them; of a rod, also the edges of its center line."""

    lines: Lines
    pairs: np.ndarray
    """[S, 2]: points of `lines`."""
    rest_lengths: np.ndarray
    stiffness: np.ndarray
    regions: np.ndarray
    """RGB [S, 3] uint8."""

    @classmethod
    def of(cls, twin: Twin, chosen: np.ndarray | None = None) -> Springs:
        """The chosen springs of a twin, or all."""
        lines = lines_of(twin)
        part = np.arange(len(lines.pairs)) if chosen is None else chosen
        return cls(lines, lines.pairs[part], lines.rest_lengths[part], lines.stiffness[part], _regions(lines)[part])

    def ends(self, nodes: np.ndarray, hands: np.ndarray) -> np.ndarray:
        """[S, 2, 3] float32, m."""
        return np.asarray(self.lines.points(nodes, hands).astype(np.float32)[self.pairs])

    def strain(self, ends: np.ndarray) -> np.ndarray:
        """l / l0 - 1 [S] of ends [S, 2, 3], m."""
        return np.asarray(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / self.rest_lengths - 1)

    def paint(self, quantity: str, scale: Scale | None, strain: np.ndarray) -> np.ndarray:
        """RGB [S, 3] uint8 at a strain [S]."""
        if scale is None:
            return self.regions.copy()
        if quantity == "stiffness":
            return scale.paint(self.stiffness)
        return scale.paint(strain if quantity == "strain" else self.stiffness * strain)


def scale_of(quantity: str, bodies: Sequence[Springs], strains: Sequence[np.ndarray]) -> Scale | None:
    """The range that all bodies share; `strains` [..., S] of each are samples over time. None for regions, or without springs."""
    if quantity == "region" or not bodies:
        return None
    if quantity == "stiffness":
        low, high = stiffness_limits(np.concatenate([body.stiffness for body in bodies]))
        return Scale("stiffness Y", low, high, "N", STIFFNESS_COLORS, log=True)
    values = [one if quantity == "strain" else body.stiffness * one for body, one in zip(bodies, strains, strict=True)]
    least = LEAST_STRAIN if quantity == "strain" else LEAST_FORCE
    far = max(float(np.quantile(np.abs(np.concatenate([one.ravel() for one in values])), 0.99)), least)
    if quantity == "strain":
        return strain_scale(far)
    return Scale("force Y (l / l0 − 1) (red: pulls)", -far, far, "N", DIVERGING)


_CODES = np.arange(256) / 255
LINEAR = np.asarray(255 * np.where(_CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** 2.4) + 0.5, np.uint8)
"""Linear light of each sRGB code (IEC 61966-2-1), of 255."""


def linear(rgb: np.ndarray) -> np.ndarray:
    """sRGB [..., 3] uint8 as viser takes the colors of single springs and nodes: it shows them as if they were linear light."""
    return np.asarray(LINEAR[rgb])


def strain_scale(far: float) -> Scale:
    """The colors of strains from -far to far."""
    return Scale("strain l / l0 − 1 (red: stretched)", -far, far, "1", DIVERGING)


def node_colors(twin: Twin) -> np.ndarray:
    """RGB [N, 3] uint8: a node's region."""
    names, region = np.unique(twin.topology.labels, return_inverse=True)
    return np.asarray(255 * region_colors(len(names))[region][:, :3] + 0.5, np.uint8)


def _regions(lines: Lines) -> np.ndarray:
    """A region's color within it; dark between regions; gray for springs of hands."""
    names, region = np.unique(lines.labels, return_inverse=True)
    ends = region[lines.pairs[: lines.inner]]
    colors = np.tile(PLAIN_COLOR, (len(lines.pairs), 1))
    colors[: lines.inner] = np.asarray(255 * region_colors(len(names))[ends[:, 0]][:, :3] + 0.5, np.uint8)
    colors[: lines.inner][ends[:, 0] != ends[:, 1]] = CROSSING_COLOR
    return colors


def region_legend(twin: Twin) -> str:
    """The legend of regions as HTML."""
    names, counts = np.unique(twin.topology.labels, return_counts=True)
    rows = [
        f"<span style='color:{to_hex(color)}'>&#9632;</span> region {name} ({count} nodes)"
        for name, count, color in zip(names, counts, region_colors(len(names)), strict=True)
    ]
    rows.append("<span style='color:#464646'>&#9632;</span> springs between regions")
    rows.append("<span style='color:#969696'>&#9632;</span> springs of hands")
    return f"<div style='margin:0 .6em;font-size:.8em'><b>region</b><br>{'<br>'.join(rows)}</div>"
