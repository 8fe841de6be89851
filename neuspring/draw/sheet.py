"""Common parts of all pictures: sizes of text, colors, panels placed in inches, color bars, and how files are written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np

# A notebook's own backend stays: it shows the user's figures.
if "inline" not in str(matplotlib.get_backend(auto_select=False)):
    matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from neuspring.core.files import write_atomically

TEXT = 8.0
"""Size of text, points, at the width that the picture is made for."""
DPI = 110
"""Dots per inch of pictures of runs and benchmarks."""
JPEG = 90
TRAINING, FUTURE = (110, 160, 240), (240, 150, 50)
"""Colors of the two parts of the time."""
WORST = 0.5
"""Color difference, of 1, at the end of error pictures."""
TIME_BAR = 6
"""Height of the bar that shows the time in a run's film, px."""
TITLE_LINE = 20
"""Height of the line of names above its panels, px."""
CONTROLLER = "tab:red"
MOST_SPRINGS = 20_000
"""More springs than this are not drawn: lines would cover each other."""


def rgb(color: Sequence[int], shade: float = 1.0) -> tuple[float, float, float]:
    """A color of 0 to 255 as matplotlib takes it, darker by a factor."""
    red, green, blue = (shade * value / 255 for value in color)
    return red, green, blue


def place(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """New axes in a figure; all in inches from the lower left corner."""
    across, high = figure.get_size_inches()
    return figure.add_axes((left / across, bottom / high, width / across, height / high))


def points_across(axis: Axes) -> float:
    """Width of a panel, points."""
    figure = axis.get_figure(root=True)
    assert figure is not None
    return 72 * figure.get_figwidth() * axis.get_position().width


def color_bar(figure: Figure, axis: Axes, norm: Normalize, colors: str, label: str, extend: str = "neither") -> None:
    """A color bar with thin lines and small numbers."""
    bar = figure.colorbar(ScalarMappable(norm, colors), cax=axis, extend=extend, extendfrac=0.03)
    bar.set_label(label, fontsize=TEXT - 1, labelpad=2)
    bar.outline.set_linewidth(0.4)
    axis.tick_params(labelsize=TEXT - 1.5, width=0.4, length=2, pad=1.5, which="both")


def sample(count: int, most: int = MOST_SPRINGS) -> np.ndarray:
    """Indices, ascending, of the springs to draw: all of them, or a random `most` that is the same every time."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, most, replace=False))


def save(figure: Figure, path: Path, dpi: float = DPI) -> Path:
    """Write a figure as its ending says, atomically and the same each time, and close it; PDF with TrueType text."""
    kind = path.suffix.lower().removeprefix(".")
    # A date would make two equal pictures differ.
    facts = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(kind)
    more = {"pil_kwargs": {"quality": JPEG}} if kind == "jpg" else {"metadata": facts} if facts else {}
    try:
        with matplotlib.rc_context({"pdf.fonttype": 42, "svg.hashsalt": "neuspring"}):
            write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=dpi, format=kind, **more))
    finally:
        plt.close(figure)
    return path
