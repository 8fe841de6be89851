"""Curves as SVG inside the page: text and axes take the page's colour, so that they are read on light and dark grounds."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import matplotlib
from markupsafe import Markup
from matplotlib.figure import Figure

INK = "#010203"
"""Becomes the page's text colour."""
COLOURS = ("#2f7ed8", "#d9731a", "#2a9d5c", "#a05cc4", "#c94f7c", "#8a7a2e", "#1f9aa8", "#8d6a57")
"""Of methods; seen on white and on black."""
DASHES = (("-", ""), ((0, (5, 2)), "7 3"), ((0, (1.5, 1.5)), "2 2"), ((0, (6, 2, 1.5, 2)), "8 3 2 3"))
"""Line styles for matplotlib and for SVG; they change when the colours are used up."""
STYLE = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "axes.titlecolor", "xtick.color", "ytick.color"), INK),
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
}


def line_style(index: int) -> tuple[str, tuple[object, str]]:
    """Colour, and line style for (matplotlib, SVG), of the i-th line."""
    return COLOURS[index % len(COLOURS)], DASHES[(index // len(COLOURS)) % len(DASHES)]


@contextmanager
def styled() -> Iterator[None]:
    """Figures made here fit the page."""
    with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
        yield


def svg(figure: Figure, name: str, alt: str) -> Markup:
    """The figure as SVG for a page, and nothing left open. `name` keeps its ids apart from those of other figures."""
    stream = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    # A style element would reach the whole page; the first patch is an empty background.
    text = re.sub(r"<!--.*?-->|<defs>\s*<style.*?</style>\s*</defs>", "", text, flags=re.DOTALL)
    text = re.sub(r"<path [^>]*style=\"fill: none\"/>", "", text)
    used = set(re.findall(r'url\(#([^)]+)\)|xlink:href="#([^"]+)"', text))
    kept = {first or second for first, second in used}
    text = re.sub(r' id="([^"]+)"', lambda match: match[0] if match[1] in kept else "", text)
    text = re.sub(r"font: (\d+\.?\d*)px [^;\"]*", r"font-size: \1px", text)
    text = re.sub(r" ?font-family: [^;\"]*;?", "", text)
    text = text.replace(INK, "currentColor")
    # Coordinates need no more digits; labels do.
    text = re.sub(r"<[^>]*>", lambda match: re.sub(r"(\d+\.\d\d)\d+", r"\1", match[0]), text)
    text = re.sub(r"\s*\n\s*", "\n", text)
    opened = re.sub(r' (width|height)="[^"]*"', "", text[: text.index(">")])
    return Markup('{} role="img" aria-label="{}"{}').format(Markup(opened), alt, Markup(text[text.index(">") :]))


def thinned(count: int, most: int = 120) -> Sequence[int]:
    """Indices of at most `most` of `count` points, the ends included."""
    if count <= most:
        return range(count)
    return [round(i * (count - 1) / (most - 1)) for i in range(most)]
