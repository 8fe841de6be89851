"""The last frame of every scenario: observed and predicted by all methods, side by side."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from neuspring.draw.sheet import TIME_BAR, TITLE_LINE
from neuspring.report.blocks import Block, Fold, Grid, Picture, Text
from neuspring.report.data import NO_ROOM, ReportData, ReportSection, webp
from neuspring.report.sections.pictures import MOST_OPEN
from neuspring.report.tables import several

STRIP_WIDTH = 424
"""Maximum width of an image, px."""
DARK, CUT_MARGIN = 40, 0.15
"""Brightness (0 to 255) up to which a pixel counts as background; margin around the cropped content, as a fraction of its size."""


def last_frame(path: Path) -> tuple[int, np.ndarray]:
    """Number of frames of a run's video, and the panels [3, H, W, 3] uint8, RGB, of its last frame.

    Raises ValueError if the last frame cannot be read.
    """
    film = cv2.VideoCapture(str(path))
    count = int(film.get(cv2.CAP_PROP_FRAME_COUNT))
    film.set(cv2.CAP_PROP_POS_FRAMES, count - 1)
    good, picture = film.read()
    if not good or len(picture) <= TITLE_LINE + TIME_BAR:
        raise ValueError("the video of this run is damaged")
    across = picture.shape[1] // 3
    rgb = cv2.cvtColor(picture[TITLE_LINE + TIME_BAR :, : 3 * across], cv2.COLOR_BGR2RGB)
    return count, rgb.reshape(len(rgb), 3, across, 3).swapaxes(0, 1)


def around(panels: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of panels [methods, 3, H, W, 3] that contain all predictions and all colored differences."""
    # Controllers are gray in the difference panel; differences of the object are colored.
    shown = (panels[:, 1].max(axis=-1) > DARK) | (np.ptp(panels[:, 2], axis=-1) > DARK)
    where = np.argwhere(shown.any(axis=0))
    size = np.array(shown.shape[1:])
    low, high = (where.min(axis=0), where.max(axis=0) + 1) if len(where) else (0 * size, size)
    margin = round(CUT_MARGIN * float((high - low).max()))
    (top, left), (bottom, right) = np.maximum(low - margin, 0), np.minimum(high + margin, size)
    return slice(top, bottom), slice(left, right)


def strip(material: ReportData) -> list[Block]:
    """One row of images per scenario; scenarios without videos have no row."""
    rows = []
    for scenario in material.choice.scenarios:
        films = {name: material.file(run, "images", "video") for name, run in material.first_runs(scenario).items()}
        ends = {name: end for name, path in films.items() if path and (end := material.read(path, last_frame))}
        if not ends:
            continue
        longest = max(count for count, _ in ends.values())
        ordered = sorted(ends.items(), key=lambda pair: pair[1][0] < longest)
        # Videos of one scenario can differ in size if their runs have different settings; then nothing is cropped.
        same_size = [panels for _, (_, panels) in ordered if panels.shape == ordered[0][1][1].shape]
        box = around(np.stack(same_size)) if len(same_size) == len(ordered) else (slice(None), slice(None))
        shown = [(f"Observed: {scenario}, frame {longest - 1}", ordered[0][1][1][0])]
        for name, (count, panels) in ordered:
            shown.append((f"{material.numbers.name(name)}{f', ends at frame {count - 1}' * (count < longest)}", panels[1]))
        figures = [
            Picture(
                caption=text,
                alt=f"Last frame of {scenario}: {text}",
                data=webp(Image.fromarray(np.ascontiguousarray(panel[box])), STRIP_WIDTH),
            )
            for text, panel in shown
        ]
        fits = material.take(sum(len(figure.data) for figure in figures))
        rows.append(Grid(blocks=figures, least=10) if fits else Text(text=f"{scenario}: {NO_ROOM}.", tone="mute"))
    rest = rows[MOST_OPEN:]
    more = [Fold(summary=f"{several(len(rest), 'more scenario')}", blocks=rest)] if rest else []
    return [*rows[:MOST_OPEN], *more]


section = ReportSection(
    order=15,
    title="Last frame",
    make=strip,
    about="The last future frame of the first camera: observed and predicted by each method, one seed, cropped to the object.",
    phase=1,
)
