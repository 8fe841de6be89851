"""Strips: observed frames in the first row, then each method's prediction and error; one column per frame."""

from __future__ import annotations

from matplotlib.figure import Figure

from neuspring.draw.painter import ERROR_COLORS, Painter
from neuspring.draw.sheet import BAR, EDGE, FUTURE, TEXT, TRAINING, color_bar, dark, panels

LABEL, LETTER = 0.22, 0.6
"""Margin for row labels, inches, and width of a letter as a fraction of its size."""


def rows_of(painter: Painter) -> list[tuple[str, int | None, bool]]:
    """(label, index of the run or None, is error) of each row: observed frames, then prediction and, if drawn, error per method."""
    kinds = (False, True) if painter.manner.error != "none" else (False,)
    methods = [(painter.error_name if error else take.label, k, error) for k, take in enumerate(painter.takes) for error in kinds]
    return [*[("observed", None, False)] * (not painter.manner.together), *methods]


def strip_figure(painter: Painter, width: float) -> Figure:
    """Draw the strip, `width` inches wide; the titles of frames have the colors of training and future."""
    rows, view, scenario = rows_of(painter), painter.scene.view, painter.scene.observations.scenario
    errors = painter.manner.error != "none"
    shapes = [view.width / view.height] * len(painter.frames)
    figure, axes = panels(width, shapes, len(rows), left=LABEL, right=BAR if errors else EDGE)
    for row, (label, which, error) in zip(axes, rows, strict=True):
        for axis, frame in zip(row, painter.frames, strict=True):
            painter.draw(axis, which, frame, error)
        high = 72 * row[0].get_position().height * figure.get_figheight()
        row[0].set_ylabel(label, fontsize=min(TEXT - error, high / (LETTER * len(label))), labelpad=3)
    for axis, frame in zip(axes[0], painter.frames, strict=True):
        wide = axis.get_position().width * width > 1.0
        text = f"frame {frame}" + (f", {frame / scenario.frame_rate:.2f} s" if wide and not painter.manner.together else "")
        axis.set_title(text, fontsize=TEXT - 1, pad=3, color=dark(FUTURE if frame >= scenario.train_end else TRAINING))
    if errors:
        color_bar(axes[[k for k, (_, _, error) in enumerate(rows) if error], -1], painter.norm, ERROR_COLORS, painter.error_label)
    return figure
