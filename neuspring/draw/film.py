"""Short videos for a README: observed and predicted side by side, as MP4 or looping GIF of limited file size."""

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
"""Dots per inch at full width; text has the same size on a screen as on paper."""
HOLD = 0.8
"""Duration of the last frame of a GIF, s."""
CENTISECOND, SHORTEST_FRAME = 100, 2
"""Centiseconds per second, and of the shortest frame; browsers replace shorter durations by 10."""
GIF_COLORS, FILM_QUALITY = 96, 23
"""Number of colors of a GIF, and constant rate factor of an MP4 (`video.Video`)."""
PALETTE_FRAMES = 8
"""Number of frames from which the palette of a GIF is computed."""
SCALES = (1.0, 0.85, 0.7, 0.6, 0.5, 0.42, 0.35, 0.3, 0.25)
"""Fractions of the width, tried in this order until the file is small enough."""


@dataclass(frozen=True)
class WrittenFilm:
    """Size and frame rate of a written video."""

    frames: int
    width: int
    height: int
    rate: float
    bytes: int
    coarser: bool

    def __str__(self) -> str:
        text = f"{self.frames} frames of {self.width} x {self.height} pixels, {self.rate:.3g} per second, {self.bytes / 1e6:.3g} MB"
        return text + (" (coarser than requested, to fit --megabytes)" if self.coarser else "")


def write_film(painter: Painter, path: Path, width: int, megabytes: float = 2.0) -> WrittenFilm:
    """Write the video within `megabytes`: a GIF first drops every other frame, then the width is reduced (`SCALES`).

    Raises InputError if the smallest video is too large.
    """
    rate, gif = painter.scene.observations.scenario.frame_rate, path.suffix.lower() == ".gif"
    made = path.with_name(f".{path.name}.try{path.suffix}")
    tries = [(1, 1.0)] * gif + [(1 + gif, scale) for scale in SCALES]
    try:
        for every, scale in tries:
            images = list(film_pictures(painter, painter.frames[::every], max(round(scale * width), 80)))
            if gif:
                write_gif(made, images, rate / every)
            else:
                with Video(made, rate, FILM_QUALITY) as video:
                    for image in images:
                        video.add(image)
            size, (high, wide) = made.stat().st_size, images[0].shape[:2]
            if size <= 1e6 * megabytes:
                write_atomically(path, made.replace)
                return WrittenFilm(len(images), wide, high, rate / every, size, (every, scale) != tries[0])
    finally:
        made.unlink(missing_ok=True)
    remedy = f"Reduce --frames or --methods{', or write .mp4' * gif}."
    raise InputError("--megabytes", f"must be at least {size / 1e6:.2g}, the size of the smallest video", megabytes, remedy)


def film_pictures(painter: Painter, frames: Sequence[int], width: int) -> Iterator[np.ndarray]:
    """Images [H, W, 3] uint8 with even sides: observed and the methods side by side, errors below, the time bar on top."""
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
    """Write an endlessly looping GIF. Frame durations are whole centiseconds and add up to the duration of the video."""
    # One palette for all frames avoids flicker, and constant pixels need no bytes.
    palette = Image.fromarray(np.vstack(spread(pictures, PALETTE_FRAMES))).quantize(GIF_COLORS, method=Image.Quantize.MAXCOVERAGE)
    frames = [Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    ends = np.round(CENTISECOND * np.arange(len(frames) + 1) / rate).astype(int)
    times = 10 * np.maximum(np.diff(ends), SHORTEST_FRAME)
    times[-1] = max(times[-1], round(1000 * HOLD))
    more = {"duration": times.tolist(), "loop": 0, "optimize": False, "disposal": 1}
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], **more)
