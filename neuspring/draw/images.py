"""Pictures and film of appearance: training views beside splats, prediction beside observation over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import torch
from matplotlib import pyplot as plt

from neuspring.core.artifacts import Scenario
from neuspring.draw.sheet import FUTURE, TIME_BAR, TITLE_LINE, TRAINING, WORST, save
from neuspring.scores.pictures import Pair, psnr
from neuspring.splats.losses import Shot


def error_picture(pair: Pair) -> np.ndarray:
    """Mean absolute color difference in false colors [H, W, 3] uint8, gray behind hands."""
    difference = (pair.truth - pair.prediction).abs().mean(0).numpy() / WORST
    picture = (255 * matplotlib.colormaps["inferno"](np.clip(difference, 0, 1))[..., :3]).astype(np.uint8)
    picture[pair.hands] = 70
    return picture


def appearance_figure(shots: Sequence[Shot], drawn: Mapping[str, np.ndarray], around: Mapping[int, np.ndarray], path: Path) -> Path:
    """Rows: each training view observed, as splats, and their difference; below, the splats from three other sides (degrees)."""
    columns = 3
    height, width = shots[0].mask.shape
    figure, axes = plt.subplots(
        len(shots) + 1, columns, figsize=(2.9 * columns, 2.9 * height / width * (len(shots) + 1) + 0.9), layout="constrained"
    )
    for row, shot in zip(axes, shots, strict=False):
        seen, known = shot.color.cpu().numpy(), shot.known.cpu().numpy()[..., None]
        splats = drawn[shot.name][..., :3] / 255
        quality = float(psnr(*(torch.tensor(p, dtype=torch.float32).permute(2, 0, 1) for p in (splats * known, seen))))
        titles = (f"camera {shot.name}: frame 0, masked", f"splats ({quality:.1f} dB)", f"difference, 0 to {WORST:g}")
        for axis, picture, title in zip(row, (seen, splats, np.abs(splats * known - seen).mean(-1)), titles, strict=False):
            axis.imshow(np.clip(picture, 0, WORST if picture.ndim == 2 else 1), cmap="inferno", vmin=0, vmax=WORST)
            axis.set_title(title, fontsize=8)
    for axis, (angle, picture) in zip(axes[-1], around.items(), strict=False):
        axis.imshow(picture)
        axis.set_title(f"camera {shots[0].name}, turned by {angle}°", fontsize=8)
    for axis in axes.flat:
        axis.axis("off")
    return save(figure, path)


def panels(pair: Pair) -> dict[str, np.ndarray]:
    """Observed, predicted and their difference [H, W, 3] uint8, by name."""
    return {"observed": pair.observed, "predicted": pair.rendered[..., :3], f"difference, 0 to {WORST:g}": error_picture(pair)}


def pairs_figure(scenario: Scenario, names: Mapping[int, str], pairs: Mapping[int, Pair], path: Path) -> Path:
    """A few frames (`scene.chosen_frames`): observed, predicted and their difference below each other."""
    count = max(len(pairs), 1)
    height, width = next(iter(pairs.values())).hands.shape if pairs else (9, 16)
    size = (3.2 * count + 0.4, 3 * 3.2 * height / width + 0.9)
    figure, axes = plt.subplots(3, count, figsize=size, layout="constrained", squeeze=False)
    for column, (frame, pair) in zip(axes.T, pairs.items(), strict=False):
        quality = float(psnr(pair.prediction, pair.truth))
        column[0].set_title(f"frame {frame}: {names[frame]}\n{quality:.1f} dB", fontsize=9)
        for axis, (label, picture) in zip(column, panels(pair).items(), strict=True):
            axis.imshow(picture)
            if axis in axes[:, 0]:
                axis.set_ylabel(label, fontsize=9)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    figure.suptitle(scenario.name, fontsize=10)
    return save(figure, path)


def film_frame(scenario: Scenario, frame: int, panels: Mapping[str, np.ndarray]) -> np.ndarray:
    """A frame of a video [H, W, 3] uint8: panels side by side, below their names and a bar of time.

    The bar shows training and future in colors, their border in white.
    """
    picture = np.hstack(list(panels.values()))
    width, total, end = picture.shape[1], scenario.frame_count, scenario.train_end
    future = frame >= end
    title = np.zeros((TITLE_LINE, width, 3), np.uint8)
    for k, name in enumerate(panels):
        text = f"{name}, frame {frame} ({'future' if future else 'training'})" if k == 0 else name
        color = (FUTURE if future else TRAINING) if k == 0 else (255, 255, 255)
        place = (6 + k * width // len(panels), TITLE_LINE - 6)
        cv2.putText(title, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, color, 1, cv2.LINE_AA)
    bar = np.zeros((TIME_BAR, width, 3), np.uint8)
    border, now = (round(width * k / total) for k in (end, frame + 1))
    for start, stop, shade in ((0, border, TRAINING), (border, width, FUTURE)):
        bar[:, start:stop] = np.array(shade) // 4
        bar[:, start : min(stop, now)] = shade
    bar[:, max(border - 1, 0) : border + 1] = 255
    return np.vstack([title, bar, picture])
