"""Curves as SVG pictures, drawn on white so that they are read on light and dark pages."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import matplotlib
from matplotlib.figure import Figure

from neuspring.report.blocks import Picture

COLORS = ("#2f7ed8", "#d9731a", "#2a9d5c", "#a05cc4", "#c94f7c", "#8a7a2e", "#1f9aa8", "#8d6a57")
"""Of methods."""
DASHES = (("-", ""), ((0, (5, 2)), "7 3"), ((0, (1.5, 1.5)), "2 2"), ((0, (6, 2, 1.5, 2)), "8 3 2 3"))
"""Line styles for matplotlib and for SVG. Each is used with all colors before the next one."""
STYLE = {
    "svg.fonttype": "none",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
}


def line_style(index: int) -> tuple[str, tuple[object, str]]:
    """Color, and line style for (matplotlib, SVG), of the i-th line."""
    return COLORS[index % len(COLORS)], DASHES[(index // len(COLORS)) % len(DASHES)]


@contextmanager
def styled() -> Iterator[None]:
    """Figures made here fit the page."""
    with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
        yield


def svg(figure: Figure, caption: str, alt: str) -> Picture:
    """The figure as a picture; equal figures have equal bytes."""
    stream = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": alt, "svg.fonttype": "none"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    data = base64.b64encode(stream.getvalue()).decode("ascii")
    return Picture(caption=caption, alt=alt, data=f"data:image/svg+xml;base64,{data}", paper=True)


def thinned(count: int, most: int = 120) -> Sequence[int]:
    """Indices of at most `most` of `count` points, the ends included."""
    if count <= most:
        return range(count)
    return [round(i * (count - 1) / (most - 1)) for i in range(most)]
