"""Figures of perception: masks and tracks over the video, lifted points and shape prior from two sides."""

from __future__ import annotations

from pathlib import Path

import cv2
import matplotlib
import numpy as np

from neuspring.core.files import write_atomically
from neuspring.data.capture import Capture
from neuspring.data.frames import frames_of, overlay, spread, tints_of, write_png
from neuspring.data.results import LiftedTracks, Masks, PixelTracks, ShapePrior

STRIP_FRAMES = 5
"""Number of frames in a strip."""
TRAIL = 8
"""Length of the tail of a track, frames."""
MOST_TRACKS = 400


def masks_strip(capture: Capture, camera: str, masks: Masks, path: Path) -> Path:
    """Draw frames of the video side by side, with object and hands tinted. Returns the path."""
    shown = spread(frames_of(capture, camera), STRIP_FRAMES)
    tints = tints_of(capture.color(camera, shown[0]), masks.labels[shown[0]])
    tiles = [overlay(capture.color(camera, frame), masks.labels[frame], tints) for frame in shown]
    return write_png(path, np.hstack(tiles))


def tracks_strip(capture: Capture, camera: str, tracks: PixelTracks, path: Path) -> Path:
    """Draw visible points with the tails of their tracks on frames, colored by position in frame 0. Returns the path."""
    count = tracks.pixels.shape[1]
    shown = np.random.default_rng(0).permutation(count)[:MOST_TRACKS]
    hue = tracks.pixels[0, shown] @ [1.0, 0.6]
    shade = (hue - hue.min(initial=0.0)) / max(float(np.ptp(hue)) if count else 0.0, 1e-6)
    colors = (255 * matplotlib.colormaps["hsv"](0.85 * shade)[:, :3]).astype(int).tolist()
    tiles = []
    for frame in spread(frames_of(capture, camera), STRIP_FRAMES):
        image = np.ascontiguousarray(capture.color(camera, frame))
        recent = slice(max(frame - TRAIL, 0), frame + 1)
        for point, color in zip(shown, colors, strict=True):
            if tracks.visible[frame, point]:
                tail = tracks.pixels[recent, point][tracks.visible[recent, point]]
                cv2.polylines(image, [np.round(tail).astype(np.int32)[:, None]], False, color, 1, cv2.LINE_AA)
                cv2.circle(image, tuple(np.round(tail[-1]).astype(int).tolist()), 1, color, -1, cv2.LINE_AA)
        tiles.append(image)
    return write_png(path, np.hstack(tiles))


def lifted_figure(lifted: LiftedTracks, prior: ShapePrior | None, path: Path) -> Path:
    """Draw frame 0 and the last frame from the side and from above. Returns the path.

    Object points have their colors, controllers are red. The prior is gray if a camera saw it, and orange if it is invented.
    """
    from matplotlib import pyplot as plt

    last = len(lifted.object_points) - 1
    figure, axes = plt.subplots(2, 2, figsize=(9, 7), layout="constrained")
    for row, (name, across, up) in zip(axes, (("side", 0, 2), ("above", 0, 1)), strict=True):
        for axis, frame in zip(row, (0, last), strict=True):
            seen = lifted.object_visibility[frame]
            if frame == 0 and prior is not None and len(prior.vertices):
                for part, color, label in _parts(prior):
                    axis.plot(part[:, across], part[:, up], ",", color=color, zorder=0)
                    if name == "side":
                        axis.plot([], [], "s", color=color, label=label)
            points = lifted.object_points[frame, seen]
            axis.scatter(points[:, across], points[:, up], s=2, c=lifted.object_colors[seen], linewidths=0)
            hands = lifted.controller_points[frame]
            axis.plot(hands[:, across], hands[:, up], "r.", ms=4)
            axis.set_title(f"frame {frame}, from {'the ' if name == 'side' else ''}{name}: {seen.sum()} points", fontsize=9)
            axis.set_aspect("equal")
            axis.set_xlabel("x [m]")
            axis.set_ylabel("z [m]" if up == 2 else "y [m]")
    if prior is not None and len(prior.vertices):
        figure.legend(fontsize=8, loc="outside lower center", ncols=2)
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=110, format="png"))
    plt.close(figure)
    return path


def _parts(prior: ShapePrior) -> list[tuple[np.ndarray, str, str]]:
    """Parts of the prior by whether a camera saw them: vertices, color, legend text."""
    if not len(prior.seen):
        return [(prior.vertices, "0.8", f"shape: {prior.backend}")]
    share = prior.facts.get("invented_share", float((~prior.seen).mean()))
    words = f"invented ({prior.backend}): {share:.0%} of the surface"
    return [(prior.vertices[prior.seen], "0.8", "seen by a camera"), (prior.vertices[~prior.seen], "#f0b070", words)]
