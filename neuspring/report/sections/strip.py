"""The last frame of all methods beside the observed one, scenario below scenario."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from neuspring.draw.sheet import TIME_BAR, TITLE_LINE
from neuspring.report.blocks import Block, Fold, Grid, PageSection, Picture, Text
from neuspring.report.data import ReportData, ReportSection
from neuspring.report.sections.pictures import MOST_OPEN, NO_ROOM, webp
from neuspring.report.tables import several

STRIP_WIDTH = 424
"""Largest width of a picture, px."""
DARK, CUT_MARGIN = 40, 0.15
"""Brightness of 255 up to which a film's predictions and differences show nothing; room around what they show."""


def last_frame(path: Path) -> tuple[int, np.ndarray]:
    """Number of frames of a run's film, and its last one [H, W, 3] uint8, RGB, without names and time. Raises ValueError."""
    film = cv2.VideoCapture(str(path))
    count = int(film.get(cv2.CAP_PROP_FRAME_COUNT))
    film.set(cv2.CAP_PROP_POS_FRAMES, count - 1)
    good, picture = film.read()
    if not good or len(picture) <= TITLE_LINE + TIME_BAR:
        raise ValueError("damaged: no film of a run")
    return count, cv2.cvtColor(picture[TITLE_LINE + TIME_BAR :], cv2.COLOR_BGR2RGB)


def around(pictures: Sequence[np.ndarray]) -> tuple[slice, slice]:
    """Rows and columns that hold what any of these frames [H, 3 W, 3] predicts or observes, in the proportions of a panel."""
    height, width = pictures[0].shape[0], pictures[0].shape[1] // 3
    # Controllers are gray in differences, which have colors.
    bright = [picture[:, width : 2 * width].max(axis=2) > DARK for picture in pictures]
    colored = [np.ptp(picture[:, 2 * width : 3 * width], axis=2) > DARK for picture in pictures]
    shown = np.argwhere(np.any([*bright, *colored], axis=0))
    if not len(shown):
        return slice(0, height), slice(0, width)
    low, high, size = shown.min(axis=0), shown.max(axis=0) + 1, np.array([height, width])
    share = min(float(((high - low) / size).max()) * (1 + 2 * CUT_MARGIN), 1.0)
    part = np.ceil(share * size).astype(int)
    top, left = np.clip((low + high - part) // 2, 0, size - part)
    return slice(top, top + part[0]), slice(left, left + part[1])


def strip(material: ReportData) -> PageSection | None:
    """A row of pictures per scenario; None where no run has a film."""
    rows: list[Block] = []
    for scenario in material.choice.scenarios:
        films = {name: material.file(run, "images", "video") for name, run in material.first_runs(scenario).items()}
        ends = {name: end for name, path in films.items() if path and (end := material.read(path, last_frame))}
        if not ends:
            continue
        longest = max(count for count, _ in ends.values())
        # Films of one scenario have the same size unless a run was made otherwise.
        alike = len({picture.shape for _, picture in ends.values()}) == 1
        box = around([picture for _, picture in ends.values()]) if alike else (slice(None), slice(None))
        ordered = sorted(ends.items(), key=lambda pair: pair[1][0] < longest)
        shown = [(f"Observed: {scenario}, frame {longest - 1}", 0, ordered[0][1][1])]
        for name, (count, picture) in ordered:
            shown.append((f"{material.numbers.name(name)}{f', ends at frame {count - 1}' * (count < longest)}", 1, picture))
        figures = []
        for caption, panel, picture in shown:
            across = picture.shape[1] // 3
            cut = np.ascontiguousarray(picture[:, panel * across : (panel + 1) * across][box])
            alt = f"Last frame of {scenario}: {caption}"
            figures.append(Picture(caption=caption, alt=alt, data=webp(Image.fromarray(cut), STRIP_WIDTH)))
        size = sum(len(one.data) for one in figures)
        rows.append(Grid(blocks=figures, least=10) if size <= material.room else Text(text=f"{scenario}: {NO_ROOM}.", tone="mute"))
        material.room -= size * (size <= material.room)
    rest = rows[MOST_OPEN:]
    more = [Fold(summary=f"{several(len(rest), 'scenario')} more", blocks=rest)] if rest else []
    about = "What was filmed and what each method predicts, in the last frame of the future, first camera, cut out; one seed."
    return PageSection(key="strip", title="Last frame", about=about, blocks=[*rows[:MOST_OPEN], *more]) if rows else None


section = ReportSection(order=15, make=strip, phase=1)
