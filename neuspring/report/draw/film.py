"""Short films for a README: observed beside predicted, as MP4 or as GIF that loops, within a size."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from neuspring.core.artifacts import Scenario
from neuspring.core.errors import InputError
from neuspring.core.files import write_atomically
from neuspring.report.draw.painter import ERRORS, Painter
from neuspring.report.draw.sheet import FUTURE, TEXT, TRAINING, color_bar, place, rgb
from neuspring.report.video import Video

DOTS = 110
"""Dots per inch at full width, so that text is as tall on a screen as on paper."""
HEAD, GAP, EDGE, BAR, CLOCK = 0.24, 0.04, 0.03, 0.62, 0.15
"""Room for names, between panels, at the edges, for the color bar, and for the bar of time, inches."""
PIXELS, SLOWEST, FASTEST = (160, 1920), 0.05, 8.0
"""Least and greatest width, and speed."""
HOLD = 0.8
"""How long a GIF shows its last frame before it begins again, s."""
CENTISECOND, SHORTEST = 100, 2
"""Of a second; browsers take a shorter time of a frame for 10."""
LARGEST = 100.0
"""Megabytes."""
COLORS, QUALITY = 96, 23
"""Colors of a GIF, and rate factor of an MP4 (`video.Video`)."""
KEYS = 8
"""Frames from which the colors of a GIF are chosen."""
LEAST_SCALE = 0.25
"""A film that is still too large at this part of its width is refused."""


@dataclass(frozen=True)
class Made:
    """What was written."""

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


def write_film(painter: Painter, path: Path, width: int, speed: float = 1.0, megabytes: float = 2.0) -> Made:
    """Write the film; if it does not fit, a GIF of every other frame, then fewer pixels until it does.

    Raises InputError for a bad size or speed, and where nothing fits.
    """
    _require(width, speed, megabytes)
    rate = painter.scene.observations.scenario.frame_rate * speed
    return _write_pictures(partial(film_pictures, painter), painter.frames, rate, path, width, megabytes)


def write_clips(painters: Sequence[Painter], path: Path, width: int, megabytes: float = 2.0) -> Made:
    """Write a film of several clips side by side, each with its observed points and its first prediction in one view.

    All painters have the same frames, in real time, equally spaced. Sizes as `write_film`.
    """
    _require(width, 1.0, megabytes)
    frames = painters[0].frames
    rate = painters[0].scene.observations.scenario.frame_rate / max(frames[1] - frames[0], 1)
    return _write_pictures(partial(clip_pictures, painters), frames, rate, path, width, megabytes)


def _write_pictures(
    draw: Callable[[Sequence[int], int], Iterator[np.ndarray]],
    frames: Sequence[int],
    rate: float,
    path: Path,
    width: int,
    megabytes: float,
) -> Made:
    """Write what `draw` (frames, width) gives, coarser until it fits."""
    gif = path.suffix.lower() == ".gif"
    made, every, scale = path.with_name(f".{path.name}.try{path.suffix}"), 1, 1.0
    try:
        while True:
            pictures = list(draw(frames[::every], max(round(scale * width), 80)))
            (_write_gif if gif else _write_mp4)(made, pictures, rate / every)
            size, (high, wide) = made.stat().st_size, pictures[0].shape[:2]
            if size <= 1e6 * megabytes:
                write_atomically(path, made.replace)
                return Made(len(pictures), wide, high, rate / every, size, scale < 1 or every > 1)
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


def _require(width: int, speed: float, megabytes: float) -> None:
    for name, value, least, most in (
        ("--width", width, *PIXELS),
        ("--speed", speed, SLOWEST, FASTEST),
        ("--megabytes", megabytes, 0.0, LARGEST),
    ):
        if not (least <= value <= most and value > 0):
            raise InputError(name, f"must be {least:g} to {most:g}" if least else f"must be above 0, at most {most:g}", value)


def film_pictures(painter: Painter, frames: Sequence[int], width: int) -> Iterator[np.ndarray]:
    """Pictures [H, W, 3] uint8, both sides even: observed and the methods side by side, errors below, time on top."""
    figure, panels, clock = _layout(painter, max(width / DOTS, 1.5))
    scenario = painter.scene.observations.scenario
    parts = [(0, scenario.train_end, TRAINING, "training"), (scenario.train_end, scenario.frame_count, FUTURE, "future")]

    def fill(frame: int) -> None:
        _fill(painter, panels, frame)
        _tell(scenario, clock, frame, parts)

    yield from _drawn(figure, width, frames, fill)


def clip_pictures(painters: Sequence[Painter], frames: Sequence[int], width: int) -> Iterator[np.ndarray]:
    """As `film_pictures`, of several clips: a panel for each, named by the label of its prediction."""
    inches = max(width / DOTS, 1.5)
    across = (inches - 2 * EDGE - GAP * (len(painters) - 1)) / len(painters)
    highs = [across * painter.scene.view.height / painter.scene.view.width for painter in painters]
    total = EDGE + CLOCK + HEAD + max(highs) + EDGE
    figure = plt.figure(figsize=(inches, total), facecolor="white")
    top, axes = total - EDGE - CLOCK - HEAD, []
    for column, (painter, high) in enumerate(zip(painters, highs, strict=True)):
        left = EDGE + column * (across + GAP)
        axes.append(place(figure, left, top - high, across, high))
        _name(figure, left + across / 2, top, painter.takes[0].label)
    clock = place(figure, EDGE, total - EDGE - CLOCK, inches - 2 * EDGE, CLOCK)
    scenario = painters[0].scene.observations.scenario

    def fill(frame: int) -> None:
        for painter, axis in zip(painters, axes, strict=True):
            axis.clear()
            painter.draw_predicted(axis, 0, frame)
        _tell(scenario, clock, frame, [(0, scenario.frame_count, FUTURE, "observed: blue; predicted: dark; held: red")])

    yield from _drawn(figure, width, frames, fill)


def _drawn(figure: Figure, width: int, frames: Sequence[int], fill: Callable[[int], None]) -> Iterator[np.ndarray]:
    """Pictures of a figure, `width` pixels wide, that `fill` draws frame by frame; the figure is closed at the end."""
    figure.set_dpi(width / figure.get_figwidth())
    canvas = FigureCanvasAgg(figure)
    try:
        for frame in frames:
            fill(frame)
            canvas.draw()
            shown = np.asarray(canvas.buffer_rgba())[..., :3]
            yield np.ascontiguousarray(shown[: shown.shape[0] // 2 * 2, : shown.shape[1] // 2 * 2])
    finally:
        plt.close(figure)


def _layout(painter: Painter, width: float) -> tuple[Figure, list[list[Axes]], Axes]:
    """The figure, its panels (observed and methods; below, errors of methods), and the bar of time."""
    view, columns, errors = painter.scene.view, 1 + len(painter.takes), painter.manner.error != "none"
    right = BAR if errors else EDGE
    across = (width - EDGE - right - GAP * (columns - 1)) / columns
    high = across * view.height / view.width
    total = EDGE + CLOCK + HEAD + high * (1 + errors) + GAP * errors + EDGE
    figure = plt.figure(figsize=(width, total), facecolor="white")
    top = total - EDGE - CLOCK - HEAD
    lefts = [EDGE + k * (across + GAP) for k in range(columns)]
    panels = [[place(figure, left, top - high, across, high) for left in lefts]]
    for left, name in zip(lefts, ["observed", *(take.label for take in painter.takes)], strict=True):
        _name(figure, left + across / 2, top, name)
    if errors:
        panels.append([place(figure, left, top - 2 * high - GAP, across, high) for left in lefts[1:]])
        cax = place(figure, width - BAR + 0.06, top - 2 * high - GAP + 0.04, 0.09, high - 0.08)
        color_bar(figure, cax, painter.norm, ERRORS, painter.error_label, extend="max")
    clock = place(figure, EDGE, total - EDGE - CLOCK, width - 2 * EDGE, CLOCK)
    return figure, panels, clock


def _name(figure: Figure, middle: float, top: float, text: str) -> None:
    """The name of a panel, above it, inches."""
    width, total = figure.get_size_inches()
    figure.text(middle / width, (top + 0.05) / total, text, ha="center", va="bottom", fontsize=TEXT)


def _fill(painter: Painter, panels: list[list[Axes]], frame: int) -> None:
    for row, axes in enumerate(panels):
        for column, axis in enumerate(axes):
            axis.clear()
            if row:
                painter.draw_error(axis, column, frame)
            elif column:
                painter.draw_predicted(axis, column - 1, frame)
            else:
                painter.draw_observed(axis, frame)


def _tell(scenario: Scenario, clock: Axes, frame: int, parts: Sequence[tuple[int, int, Sequence[int], str]]) -> None:
    """The bar of time, filled up to the frame: parts (start, stop, color, word), their borders in black."""
    clock.clear()
    clock.set(xticks=[], yticks=[], xlim=(0, scenario.frame_count), ylim=(0, 1))
    style: dict[str, Any] = {"height": 1.0, "align": "center", "linewidth": 0}
    words: dict[str, Any] = {"fontsize": TEXT - 1.5, "va": "center_baseline"}
    margin = 0.006 * scenario.frame_count
    for start, stop, color, word in parts:
        clock.barh(0.5, stop - start, left=start, color=rgb(color), alpha=0.25, **style)
        if frame >= start:
            clock.barh(0.5, min(stop, frame + 1) - start, left=start, color=rgb(color), **style)
        if start:
            clock.axvline(start, color="black", linewidth=1.0)
        if start < stop:
            clock.text(start + margin, 0.5, word, ha="left", **words)
    clock.text(scenario.frame_count - margin, 0.5, f"{frame / scenario.frame_rate:.2f} s", ha="right", **words)
    for side in clock.spines.values():
        side.set_visible(False)


def _write_mp4(path: Path, pictures: Sequence[np.ndarray], rate: float) -> None:
    with Video(path, rate, QUALITY) as video:
        for picture in pictures:
            video.add(picture)


def _write_gif(path: Path, pictures: Sequence[np.ndarray], rate: float) -> None:
    """A GIF that begins again for ever. Its times are whole hundredths of a second; they add up to those of the film."""
    # One palette for all frames: colors that change from frame to frame flicker, and pixels that stay need no bytes.
    keys = np.unique(np.linspace(0, len(pictures) - 1, KEYS).astype(int))
    palette = Image.fromarray(np.vstack([pictures[k] for k in keys])).quantize(COLORS, method=Image.Quantize.MAXCOVERAGE)
    frames = [Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    ends = np.round(CENTISECOND * np.arange(len(frames) + 1) / rate).astype(int)
    times = 10 * np.maximum(np.diff(ends), SHORTEST)
    times[-1] = max(times[-1], round(1000 * HOLD))
    more = {"duration": times.tolist(), "loop": 0, "optimize": False, "disposal": 1}
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], **more)
