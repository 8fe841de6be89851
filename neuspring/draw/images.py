"""Figures and video of appearance: training views and splats, observed and predicted images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from neuspring.core.artifacts import Scenario
from neuspring.draw.sheet import FUTURE, TITLE_LINE, TRAINING, WORST, false_colors, picture_sheet, time_bar
from neuspring.scores.pictures import Pair, psnr
from neuspring.splats.losses import Shot


def appearance_figure(shots: Sequence[Shot], drawn: Mapping[str, np.ndarray], around: Mapping[int, np.ndarray], path: Path) -> Path:
    """Draw observed image, splats and difference of each training view in rows; the last row shows the splats from other sides.

    `around` maps angles, degrees, to images of these sides.
    """
    rows = []
    for shot in shots:
        seen, splats = shot.color.cpu().numpy(), drawn[shot.name][..., :3] / 255
        known = splats * shot.known.cpu().numpy()[..., None]
        quality = float(psnr(*(torch.tensor(p, dtype=torch.float32).permute(2, 0, 1) for p in (known, seen))))
        rows.append(
            [
                (f"camera {shot.name}: frame 0, masked", np.clip(seen, 0, 1)),
                (f"splats ({quality:.1f} dB)", splats),
                (f"difference, 0 to {WORST:g}", false_colors(np.abs(known - seen).mean(-1))),
            ]
        )
    rows.append([(f"camera {shots[0].name}, rotated by {angle}°", image) for angle, image in around.items()])
    return picture_sheet(rows, path)


def panels(pair: Pair) -> dict[str, np.ndarray]:
    """Observed and predicted image and their difference [H, W, 3] uint8 by name; the difference is gray at hands."""
    difference = false_colors((pair.truth - pair.prediction).abs().mean(0).numpy())
    difference[pair.hands] = 70
    return {"observed": pair.observed, "predicted": pair.rendered[..., :3], f"difference, 0 to {WORST:g}": difference}


def pairs_figure(names: Mapping[int, str], pairs: Mapping[int, Pair], path: Path) -> Path:
    """Draw frames, one per row: observed, predicted, difference. `names` are those of `scene.chosen_frames`."""
    rows = []
    for frame, pair in pairs.items():
        quality = float(psnr(pair.prediction, pair.truth))
        first = f"frame {frame}: {names[frame]} ({quality:.1f} dB)"
        rows.append([(f"{name}, {first}" if name == "observed" else name, image) for name, image in panels(pair).items()])
    return picture_sheet(rows or [[("no frame was predicted", np.zeros((9, 16, 3), np.uint8))]], path)


def film_frame(scenario: Scenario, frame: int, panels: Mapping[str, np.ndarray]) -> np.ndarray:
    """One video frame [H, W, 3] uint8: panels side by side below their names and the time bar (`sheet.time_bar`)."""
    image, future = np.hstack(list(panels.values())), frame >= scenario.train_end
    width = image.shape[1]
    title = np.zeros((TITLE_LINE, width, 3), np.uint8)
    for k, name in enumerate(panels):
        text = name if k else f"{name}, frame {frame} ({'future' if future else 'training'})"
        color = (255, 255, 255) if k else FUTURE if future else TRAINING
        origin = (6 + k * width // len(panels), TITLE_LINE - 6)
        cv2.putText(title, text, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.42, color, 1, cv2.LINE_AA)
    return np.vstack([title, time_bar(frame, scenario.frame_count, scenario.train_end, width), image])
