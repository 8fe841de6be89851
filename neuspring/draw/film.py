"""Short films for a README: observed beside predicted, as MP4 or as GIF that loops, within a size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from neuspring.core.errors import InputError
from neuspring.core.files import write_atomically
from neuspring.data.frames import spread
from neuspring.draw.painter import ERROR_COLORS, Painter
from neuspring.draw.sheet import BAR, EDGE, TEXT, color_bar, panels, time_bar
from neuspring.draw.video import Video

DOTS = 110
"""Dots per inch at full width, so that text is as tall on a screen as on paper."""
HOLD = 0.8
"""Time for which a GIF shows its last frame before it begins again, s."""
CENTISECOND, SHORTEST_FRAME = 100, 2
"""Centiseconds of a second, and of the shortest frame; browsers take a shorter time of a frame for 10."""
GIF_COLORS, FILM_QUALITY = 96, 23
"""Colors of a GIF, and rate factor of an MP4 (`video.Video`)."""
PALETTE_FRAMES = 8
"""Frames from which the colors of a GIF are chosen."""
SCALES = (1.0, 0.85, 0.7, 0.6, 0.5, 0.42, 0.35, 0.3, 0.25)
"""Parts of the width that are tried until a film fits."""


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
        text = f"{self.frames} frames of {self.width} x {self.height} pixels, {self.rate:.3g} per second, {self.bytes / 1e6:.3g} MB"
        return text + (" (coarser than asked for, to fit --megabytes)" if self.coarser else "")


def write_film(painter: Painter, path: Path, width: int, megabytes: float = 2.0) -> WrittenFilm:
    """Write the film; if it does not fit, a GIF of every other frame, then fewer pixels until it does.

    Raises InputError where nothing fits.
    """
    rate, gif = painter.scene.observations.scenario.frame_rate, path.suffix.lower() == ".gif"
    made = path.with_name(f".{path.name}.try{path.suffix}")
    tries = [(1, 1.0)] * gif + [(1 + gif, scale) for scale in SCALES]
    try:
        for every, scale in tries:
            pictures = list(film_pictures(painter, painter.frames[::every], max(round(scale * width), 80)))
            if gif:
                write_gif(made, pictures, rate / every)
            else:
                with Video(made, rate, FILM_QUALITY) as video:
                    for picture in pictures:
                        video.add(picture)
            size, (high, wide) = made.stat().st_size, pictures[0].shape[:2]
            if size <= 1e6 * megabytes:
                write_atomically(path, made.replace)
                return WrittenFilm(len(pictures), wide, high, rate / every, size, (every, scale) != tries[0])
    finally:
        made.unlink(missing_ok=True)
    remedy = f"Name fewer --frames or methods{', or write .mp4' * gif}."
    raise InputError("--megabytes", f"the coarsest film has {size / 1e6:.2g} MB", megabytes, remedy)


def film_pictures(painter: Painter, frames: Sequence[int], width: int) -> Iterator[np.ndarray]:
    """Pictures [H, W, 3] uint8, both sides even: observed and the methods side by side, errors below, the bar of time on top."""
    view, scenario, first = painter.scene.view, painter.scene.observations.scenario, int(not painter.manner.together)
    names = ["observed"] * first + [take.label for take in painter.takes]
    inches, errors = max(width / DOTS, 1.5), painter.manner.error != "none"
    figure, axes = panels(inches, [view.width / view.height] * len(names), 1 + errors, right=BAR if errors else EDGE)
    figure.set_dpi(width / inches)
    canvas = FigureCanvasAgg(figure)
    if errors:
        color_bar(axes[1:, -1], painter.norm, ERROR_COLORS, painter.error_label)
    try:
        for frame in frames:
            for row, error in zip(axes, (False, True), strict=False):
                for column, axis in enumerate(row):
                    axis.clear()
                    if error and column < first:
                        axis.axis("off")
                    else:
                        painter.draw(axis, column - first if column >= first else None, frame, error)
            for axis, name in zip(axes[0], names, strict=True):
                time = f", {frame / scenario.frame_rate:.2f} s" if axis is axes[0, 0] else ""
                axis.set_title(name + time, fontsize=TEXT, pad=3)
            canvas.draw()
            shown = np.asarray(canvas.buffer_rgba())[..., :3]
            shown = shown[: shown.shape[0] // 2 * 2, : shown.shape[1] // 2 * 2]
            yield np.vstack([time_bar(frame, scenario.frame_count, scenario.train_end, shown.shape[1]), shown])
    finally:
        plt.close(figure)


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
