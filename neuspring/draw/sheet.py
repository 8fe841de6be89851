"""Style and layout of all figures: sizes, colors, the grid of panels, color bars, and writing of files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import matplotlib
import numpy as np

# Keep the backend of notebooks, which shows the user's figures.
if "inline" not in str(matplotlib.get_backend(auto_select=False)):
    matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from neuspring.core.files import write_atomically

TEXT = 8.0
"""Size of text, points, at the intended width of a figure."""
DPI = 110
"""Dots per inch of figures of runs and benchmarks."""
JPEG = 90
TRAINING, FUTURE = (110, 160, 240), (240, 150, 50)
"""RGB of training and future frames."""
WORST = 0.5
"""Color difference at the upper end of error images; colors are 0 to 1."""
EDGE, PANEL_GAP, HEAD, BAR = 0.03, 0.04, 0.2, 0.62
"""Margins in inches: at the sides, between panels, above panels for titles, and for a color bar."""
PICTURE_WIDTH = 3.2
"""Width of an image of a sheet (`picture_sheet`), inches."""
TIME_BAR = 6
"""Height of the time bar of a video, px."""
TITLE_LINE = 20
"""Height of the line of titles above the panels of a video, px."""
CONTROLLER = "tab:red"
MOST_SPRINGS = 20_000
"""Largest number of drawn springs; more lines would cover each other."""


def panels(
    width: float, shapes: Sequence[float], rows: int, *, left: float = EDGE, right: float = EDGE, head: float = HEAD
) -> tuple[Figure, np.ndarray]:
    """A figure `width` inches wide and its axes [rows, columns]: the layout of strips, videos, twins and sheets.

    All panels have the same height; `shapes` are the ratios of the columns' widths to it. `left`, `right` and `head` are margins,
    inches.
    """
    high = (width - left - right - PANEL_GAP * (len(shapes) - 1)) / sum(shapes)
    total = head + rows * (high + PANEL_GAP)
    figure = plt.figure(figsize=(width, total), facecolor="white")
    sides = {"left": left / width, "right": 1 - right / width, "top": 1 - head / total, "bottom": PANEL_GAP / total}
    gaps = {"wspace": PANEL_GAP * len(shapes) / (high * sum(shapes)), "hspace": PANEL_GAP / high, "width_ratios": shapes}
    return figure, figure.add_gridspec(rows, len(shapes), **sides, **gaps).subplots(squeeze=False)


def picture_sheet(rows: Sequence[Sequence[tuple[str, np.ndarray]]], path: Path) -> Path:
    """Write rows of titled images [H, W, 3] of the same shape; returns the file."""
    high, wide = rows[0][0][1].shape[:2]
    figure, axes = panels(PICTURE_WIDTH * len(rows[0]), [wide / (high + 0.1 * wide)] * len(rows[0]), len(rows), head=0)
    for axis, (title, picture) in zip(axes.flat, [pair for row in rows for pair in row], strict=True):
        axis.imshow(picture)
        axis.set_title(title, fontsize=TEXT)
        axis.set_anchor("S")
        axis.axis("off")
    return save(figure, path)


def time_bar(frame: int, frames: int, train_end: int, width: int) -> np.ndarray:
    """A bar [TIME_BAR, width, 3] uint8, filled up to a frame in the colors of training and future; a white line separates them."""
    bar = np.zeros((TIME_BAR, width, 3), np.uint8)
    border, now = (round(width * k / frames) for k in (train_end, frame + 1))
    for start, stop, shade in ((0, border, TRAINING), (border, width, FUTURE)):
        bar[:, start:stop] = np.array(shade) // 4
        bar[:, start : min(stop, now)] = shade
    bar[:, max(border - 1, 0) : border + 1] = 255
    return bar


def false_colors(difference: np.ndarray) -> np.ndarray:
    """Color differences [H, W] from 0 to WORST as a false-color image [H, W, 3] uint8."""
    return (255 * matplotlib.colormaps["inferno"](np.clip(difference / WORST, 0, 1))[..., :3]).astype(np.uint8)


def dark(color: Sequence[int]) -> tuple[float, ...]:
    """Darken an RGB color (0 to 255) for text on white; returns 0 to 1."""
    return tuple(0.75 * value / 255 for value in color)


def points_across(axis: Axes) -> float:
    """The width of a panel, points."""
    figure = axis.get_figure(root=True)
    assert figure is not None
    return 72 * figure.get_figwidth() * axis.get_position().width


def color_bar(axes: Iterable[Axes], norm: Normalize, colors: str, label: str, extend: str = "max") -> None:
    """Draw a color bar to the right of a column of panels."""
    axes = list(axes)
    figure, low, high = axes[0].get_figure(root=True), axes[-1].get_position(), axes[0].get_position()
    assert figure is not None
    width, total = figure.get_size_inches()
    tall = min(high.y1 - low.y0 - 0.1 / total, 2.4 / total)
    cax = figure.add_axes((low.x1 + 0.07 / width, (low.y0 + high.y1 - tall) / 2, 0.09 / width, tall))
    bar = figure.colorbar(ScalarMappable(norm, colors), cax=cax, extend=extend, extendfrac=0.03)
    bar.set_label(label, fontsize=TEXT - 1, labelpad=2)
    bar.outline.set_linewidth(0.4)
    cax.tick_params(labelsize=TEXT - 1.5, width=0.4, length=2, pad=1.5, which="both")


def sample(count: int, most: int = MOST_SPRINGS) -> np.ndarray:
    """Ascending indices of the springs or splats to draw: all, or a random but reproducible selection of `most`."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, most, replace=False))


def save(figure: Figure, path: Path, dpi: float = DPI) -> Path:
    """Write a figure in the format of the extension, atomically and reproducibly, and close it; PDF with TrueType fonts."""
    kind = path.suffix.lower().removeprefix(".")
    # With a date, the files of equal figures would differ.
    facts = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(kind)
    more = {"pil_kwargs": {"quality": JPEG}} if kind == "jpg" else {"metadata": facts} if facts else {}
    try:
        with matplotlib.rc_context({"pdf.fonttype": 42, "svg.hashsalt": "neuspring"}):
            write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=dpi, format=kind, **more))
    finally:
        plt.close(figure)
    return path
