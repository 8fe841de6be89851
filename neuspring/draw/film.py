"""Short films for a README: observed beside predicted, as MP4 or as GIF that loops, within a size."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from neuspring.core.errors import InputError
from neuspring.core.files import write_atomically
from neuspring.data.frames import spread
from neuspring.draw.painter import ERROR_COLORS, Painter
from neuspring.draw.sheet import FUTURE, TEXT, TRAINING, color_bar, place, rgb
from neuspring.draw.video import Video

DOTS = 110
"""Dots per inch at full width, so that text is as tall on a screen as on paper."""
FILM_HEAD, FILM_GAP, FILM_EDGE, FILM_BAR, CLOCK = 0.24, 0.04, 0.03, 0.62, 0.15
"""Room for names, between panels, at the edges, for the color bar, and for the bar of time, inches."""
HOLD = 0.8
"""Time for which a GIF shows its last frame before it begins again, s."""
CENTISECOND, SHORTEST_FRAME = 100, 2
"""Centiseconds of a second, and of the shortest frame; browsers take a shorter time of a frame for 10."""
GIF_COLORS, FILM_QUALITY = 96, 23
"""Colors of a GIF, and rate factor of an MP4 (`video.Video`)."""
PALETTE_FRAMES = 8
"""Frames from which the colors of a GIF are chosen."""
LEAST_SCALE = 0.25
"""A film that is still too large at this part of its width is refused."""


@dataclass(frozen=True)
class WrittenFilm:
    """Size and rate of a film that was written."""

    frames: int
    width: int
    height: int
    rate: float
    bytes: int
    coarser: bool

    def __str__(self) -> str:
        size = f"{self.bytes / 1e6:.2f} MB" if self.bytes >= 1e5 else f"{self.bytes / 1e3:.0f} kB"
        text = f"{self.frames} frames of {self.width} x {self.height} pixels, {self.rate:.3g} per second, {size}"
        return text + (" (coarser than asked for, to fit --megabytes)" if self.coarser else "")


def write_film(
    painter: Painter, path: Path, width: int, speed: float = 1.0, megabytes: float = 2.0, beside: Sequence[Painter] = ()
) -> WrittenFilm:
    """Write the film; if it does not fit, a GIF of every other frame, then fewer pixels until it does.

    Painters `beside` the first one, of other scenes, paint the same frames at its side. Raises InputError where nothing
    fits.
    """
    rate = painter.scene.observations.scenario.frame_rate * speed
    gif = path.suffix.lower() == ".gif"
    made, every, scale = path.with_name(f".{path.name}.try{path.suffix}"), 1, 1.0
    try:
        while True:
            across = max(round(scale * width / (1 + len(beside))), 80)
            films = [film_pictures(each, painter.frames[::every], across) for each in (painter, *beside)]
            pictures = [_beside(each) for each in zip(*films, strict=True)]
            if gif:
                write_gif(made, pictures, rate / every)
            else:
                with Video(made, rate / every, FILM_QUALITY) as video:
                    for picture in pictures:
                        video.add(picture)
            size, (high, wide) = made.stat().st_size, pictures[0].shape[:2]
            if size <= 1e6 * megabytes:
                write_atomically(path, made.replace)
                return WrittenFilm(len(pictures), wide, high, rate / every, size, scale < 1 or every > 1)
            if scale <= LEAST_SCALE:
                remedy = "Name fewer --frames or methods, or write .mp4." if gif else "Name fewer --frames or methods."
                raise InputError("--megabytes", f"the coarsest film has {size / 1e6:.2g} MB", megabytes, remedy)
            if gif and every == 1:
                every = 2
            else:
                # A film has about as many bytes as pixels.
                scale = max(0.95 * scale * math.sqrt(1e6 * megabytes / size), LEAST_SCALE)
    finally:
        made.unlink(missing_ok=True)


def _beside(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures [H, W, 3] side by side, with white below the lower ones."""
    high = max(map(len, pictures))
    return np.hstack([np.pad(each, ((0, high - len(each)), (0, 0), (0, 0)), constant_values=255) for each in pictures])


def film_pictures(painter: Painter, frames: Sequence[int], width: int) -> Iterator[np.ndarray]:
    """Pictures [H, W, 3] uint8, both sides even: observed and the methods side by side, errors below, time on top."""
    inches = max(width / DOTS, 1.5)
    figure, panels, clock = _layout(painter, inches)
    figure.set_dpi(width / inches)
    canvas = FigureCanvasAgg(figure)
    try:
        for frame in frames:
            _fill(painter, panels, frame)
            _tell(painter, clock, frame)
            canvas.draw()
            shown = np.asarray(canvas.buffer_rgba())[..., :3]
            yield np.ascontiguousarray(shown[: shown.shape[0] // 2 * 2, : shown.shape[1] // 2 * 2])
    finally:
        plt.close(figure)


def _layout(painter: Painter, width: float) -> tuple[Figure, list[list[Axes]], Axes]:
    """The figure, its panels (observed and methods; below, errors of methods), and the bar of time."""
    names = ["observed"][painter.manner.together :] + [take.label for take in painter.takes]
    view, columns, errors = painter.scene.view, len(names), painter.manner.error != "none"
    right = FILM_BAR if errors else FILM_EDGE
    across = (width - FILM_EDGE - right - FILM_GAP * (columns - 1)) / columns
    high = across * view.height / view.width
    total = FILM_EDGE + CLOCK + FILM_HEAD + high * (1 + errors) + FILM_GAP * errors + FILM_EDGE
    figure = plt.figure(figsize=(width, total), facecolor="white")
    top = total - FILM_EDGE - CLOCK - FILM_HEAD
    lefts = [FILM_EDGE + k * (across + FILM_GAP) for k in range(columns)]
    panels = [[place(figure, left, top - high, across, high) for left in lefts]]
    for left, name in zip(lefts, names, strict=True):
        figure.text((left + across / 2) / width, (top + 0.05) / total, name, ha="center", va="bottom", fontsize=TEXT)
    if errors:
        panels.append([place(figure, left, top - 2 * high - FILM_GAP, across, high) for left in lefts[1:]])
        cax = place(figure, width - FILM_BAR + 0.06, top - 2 * high - FILM_GAP + 0.04, 0.09, high - 0.08)
        color_bar(figure, cax, painter.norm, ERROR_COLORS, painter.error_label, extend="max")
    return figure, panels, place(figure, FILM_EDGE, total - FILM_EDGE - CLOCK, width - 2 * FILM_EDGE, CLOCK)


def _fill(painter: Painter, panels: list[list[Axes]], frame: int) -> None:
    first = 0 if painter.manner.together else 1
    for row, axes in enumerate(panels):
        for column, axis in enumerate(axes):
            axis.clear()
            painter.draw(axis, None if column < first and not row else column - first * (not row), frame, error=bool(row))


def _tell(painter: Painter, clock: Axes, frame: int) -> None:
    """The bar of time, filled up to the frame: training and future in their colors, the border in black."""
    scenario = painter.scene.observations.scenario
    # A recording of its own, which was not trained on.
    train_end = 0 if painter.manner.together else scenario.train_end
    clock.clear()
    clock.set(xticks=[], yticks=[], xlim=(0, scenario.frame_count), ylim=(0, 1))
    style: dict[str, Any] = {"height": 1.0, "align": "center", "linewidth": 0}
    for start, stop, color in ((0, train_end, TRAINING), (train_end, scenario.frame_count, FUTURE)):
        clock.barh(0.5, stop - start, left=start, color=rgb(color), alpha=0.25, **style)
        if frame >= start:
            clock.barh(0.5, min(stop, frame + 1) - start, left=start, color=rgb(color), **style)
    clock.axvline(train_end, color="black", linewidth=1.0)
    words: dict[str, Any] = {"fontsize": TEXT - 1.5, "va": "center_baseline"}
    margin = 0.006 * scenario.frame_count
    if train_end:
        clock.text(margin, 0.5, "training", ha="left", **words)
    if train_end < scenario.frame_count:
        clock.text(train_end + margin, 0.5, "future" if train_end else "predicted", ha="left", **words)
    clock.text(scenario.frame_count - margin, 0.5, f"{frame / scenario.frame_rate:.2f} s", ha="right", **words)
    clock.spines[:].set_visible(False)


def write_gif(path: Path, pictures: Sequence[np.ndarray], rate: float) -> None:
    """A GIF that begins again for ever. Its times are whole hundredths of a second; they add up to those of the film."""
    # One palette for all frames: colors that change from frame to frame flicker, and pixels that stay need no bytes.
    palette = Image.fromarray(np.vstack(spread(pictures, PALETTE_FRAMES))).quantize(GIF_COLORS, method=Image.Quantize.MAXCOVERAGE)
    frames = [Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    ends = np.round(CENTISECOND * np.arange(len(frames) + 1) / rate).astype(int)
    times = 10 * np.maximum(np.diff(ends), SHORTEST_FRAME)
    times[-1] = max(times[-1], round(1000 * HOLD))
    more = {"duration": times.tolist(), "loop": 0, "optimize": False, "disposal": 1}
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], **more)
