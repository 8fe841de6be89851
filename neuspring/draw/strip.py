"""Film strips: the observed frames on top, below them each method's prediction and its error; one column per frame."""

from __future__ import annotations

from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from neuspring.draw.painter import ERROR_COLORS, Painter
from neuspring.draw.sheet import FUTURE, TEXT, TRAINING, color_bar, place, rgb

LABEL, STRIP_HEAD = 0.22, 0.4
"""Room for the names of rows, and for the head of columns, inches."""
STRIP_GAP, BETWEEN = 0.03, 0.08
"""Between panels, and between methods, inches."""
STRIP_BAR, STRIP_EDGE = 0.62, 0.03
"""Room for the color bar, and at the right edge without one, inches."""
TALLEST_BAR = 2.4
"""Greatest height of the color bar, inches."""
LETTER = 0.6
"""Width of a letter, of its size."""
TIME_BAND = 0.05
"""Height of the bands that say training and future, inches."""


def rows_of(painter: Painter) -> list[tuple[str, int | None, bool]]:
    """Label, run and True for its error: the observed frames (no run), then two rows per method, or one without errors."""
    kinds = (False, True) if painter.manner.error != "none" else (False,)
    methods = [(painter.error_name if error else take.label, k, error) for k, take in enumerate(painter.takes) for error in kinds]
    return [("observed", None, False), *methods]


def strip_figure(painter: Painter, width: float) -> Figure:
    """The strip, `width` inches wide; its height follows from the panels."""
    rows, frames, view = rows_of(painter), painter.frames, painter.scene.view
    errors = painter.manner.error != "none"
    right = STRIP_BAR if errors else STRIP_EDGE
    across = (width - LABEL - right - STRIP_GAP * (len(frames) - 1)) / len(frames)
    high = across * view.height / view.width
    gaps = [STRIP_GAP if error else BETWEEN for _, _, error in rows[1:]] + [STRIP_EDGE]
    total = STRIP_HEAD + sum(gaps) + high * len(rows)
    figure = plt.figure(figsize=(width, total))
    top, bars = total - STRIP_HEAD, []
    for (label, which, error), gap in zip(rows, gaps, strict=True):
        for column, frame in enumerate(frames):
            axis = place(figure, LABEL + column * (across + STRIP_GAP), top - high, across, high)
            painter.draw(axis, which, frame, error)
        bars += [top - high, top] if error else []
        _row_label(figure, label, error, top - high / 2, high)
        top -= high + gap
    _head(figure, painter, across, total, total - STRIP_HEAD - high * len(rows) - sum(gaps[:-1]))
    if errors:
        tall = min(max(bars) - min(bars) - 0.2, TALLEST_BAR)
        cax = place(figure, width - STRIP_BAR + 0.06, 0.5 * (min(bars) + max(bars) - tall), 0.09, tall)
        color_bar(figure, cax, painter.norm, ERROR_COLORS, painter.error_label, extend="max")
    return figure


def _row_label(figure: Figure, label: str, error: bool, middle: float, high: float) -> None:
    """The name of a row, smaller where it would not fit beside it."""
    width, height = figure.get_size_inches()
    size = min(TEXT - error, 72 * high / (LETTER * len(label)))
    color = "0.35" if error else "black"
    place = ((LABEL - 0.05) / width, middle / height)
    figure.text(*place, label, rotation=90, ha="right", va="center", fontsize=size, color=color)


def _head(figure: Figure, painter: Painter, across: float, total: float, bottom: float) -> None:
    """Frames and times above the columns, bands over those of training and future, and a dashed line at their border."""
    scenario, frames = painter.scene.observations.scenario, painter.frames
    width, lefts = figure.get_figwidth(), [LABEL + k * (across + STRIP_GAP) for k in range(len(painter.frames))]
    for left, frame in zip(lefts, frames, strict=True):
        text = f"frame {frame}, {frame / scenario.frame_rate:.2f} s" if across > 1.0 else f"{frame}"
        at = (left + across / 2) / width, (total - STRIP_HEAD + 0.04) / total
        figure.text(*at, text, ha="center", va="bottom", fontsize=TEXT - 1)
    for name, color, inside in (("training", TRAINING, False), ("future", FUTURE, True)):
        own = [left for left, frame in zip(lefts, frames, strict=True) if (frame >= scenario.train_end) == inside]
        if not own:
            continue
        start, stop, high = own[0], own[-1] + across, total - 0.05 - TIME_BAND
        band = place(figure, start, high, stop - start, TIME_BAND)
        band.set(xticks=[], yticks=[], facecolor=rgb(color))
        band.spines[:].set_visible(False)
        figure.text(start / width, (high - 0.015) / total, name, ha="left", va="top", fontsize=TEXT - 1, color=rgb(color, 0.75))
    first = next((left for left, frame in zip(lefts, frames, strict=True) if frame >= scenario.train_end), None)
    if first is not None and first > lefts[0]:
        x = (first - STRIP_GAP / 2) / width
        figure.add_artist(Line2D([x, x], [bottom / total, (total - 0.05) / total], color="0.2", linewidth=0.8, linestyle="--"))
