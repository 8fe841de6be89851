"""Film strips of `beside_phystwin`: observed, PhysTwin's rendering and twins, each over the whitened frame, in a few frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from neuspring.report.figures.images import FUTURE, TRAINING
from tests.benchmarks.beside_data import PHYSTWIN, Case, Run

SHOWN = 6
"""Frames of a strip."""
WHITE = 0.3
"""How much white PhysTwin's video has laid over its frames."""
MARGIN = 24
"""px around object and hands."""
WIDTH = 360
"""Of a picture of the strip, px."""
BAR, GAP = 24, 3
"""Height of the bar of time and width of gaps, px."""
INK = (40, 40, 40)


def frames_shown(count: int, shown: int = SHOWN) -> list[int]:
    """Evenly spaced frames, the first and the last among them."""
    return [int(frame) for frame in np.round(np.linspace(0, count - 1, shown))]


def surroundings(masks: Sequence[np.ndarray], margin: int = MARGIN) -> tuple[slice, slice]:
    """Rows and columns of what any of the masks [H, W] covers, with a margin; the whole image where they are empty."""
    covered = np.any([mask > 0 for mask in masks], axis=0)
    if not covered.any():
        return slice(None), slice(None)
    spans = []
    for axis in (1, 0):
        places = np.flatnonzero(covered.any(axis=axis))
        spans.append(slice(max(int(places[0]) - margin, 0), int(places[-1]) + margin + 1))
    return spans[0], spans[1]


def over_white(observed: np.ndarray, rgba: np.ndarray) -> np.ndarray:
    """A picture [H, W, 4] over black, laid over the whitened observed frame [H, W, 3]; uint8."""
    pale = (1 - WHITE) * observed.astype(np.float32) + WHITE * 255
    return np.clip(np.round(rgba[..., :3] + pale * (1 - rgba[..., 3:] / 255)), 0, 255).astype(np.uint8)


def layout(rows: dict[str, list[np.ndarray]], frames: Sequence[int], train_end: int) -> np.ndarray:
    """Rows of pictures [h, w, 3] of equal size under a bar of time, their names in the first column: RGB [H, W, 3] uint8."""
    height, width = next(iter(rows.values()))[0].shape[:2]
    size = (WIDTH, round(height * WIDTH / width))
    bars = []
    for frame in frames:
        bar = np.full((BAR, WIDTH, 3), FUTURE if frame >= train_end else TRAINING, np.uint8)
        bars.append(_written(bar, f"frame {frame}" + (", future" if frame >= train_end else ""), BAR - 7))
    lines = [_beside(bars)]
    for name, pictures in rows.items():
        small = [cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures]
        lines.append(_beside([_written(small[0], name, 20, shade=True), *small[1:]]))
    gap = np.full((GAP, lines[0].shape[1], 3), 255, np.uint8)
    return np.vstack([part for line in lines for part in (line, gap)][:-1])


def write_strip(case: Case, runs: Sequence[Run], folder: Path) -> Path:
    """Write FOLDER/CASE.jpg with a row per run that has pictures; returns its path."""
    published, count = case.published, case.capture.frame_count
    count = count if published is None else min(count, published.frame_count)
    frames = frames_shown(count)
    observed = {frame: case.color(frame) for frame in frames}
    rows = {"observed": list(observed.values())}
    if published is not None:
        # Not moved: the video as it is.
        rows[PHYSTWIN] = [published.rights[frame] for frame in frames]
    for run in runs:
        drawn = {frame: over_white(observed[frame], rgba) for frame, rgba, _ in run.pictures(case.capture, set(frames))}
        if len(drawn) == len(set(frames)):
            rows[f"{run.method}, seed {run.seed}"] = [drawn[frame] for frame in frames]
    cut = surroundings([case.labels(frame) for frame in frames])
    strip = layout({name: [picture[cut] for picture in own] for name, own in rows.items()}, frames, case.capture.train_end)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{case.name}.jpg"
    ok, data = cv2.imencode(".jpg", np.ascontiguousarray(strip[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 88])
    assert ok, "a picture can be encoded"
    path.write_bytes(data.tobytes())
    return path


def _beside(pictures: Sequence[np.ndarray]) -> np.ndarray:
    gap = np.full((pictures[0].shape[0], GAP, 3), 255, np.uint8)
    return np.hstack([part for picture in pictures for part in (picture, gap)][:-1])


def _written(picture: np.ndarray, text: str, baseline: int, *, shade: bool = False) -> np.ndarray:
    """A copy with a line of text at its top left, on a light ground if asked for."""
    copy, font, scale = np.ascontiguousarray(picture).copy(), cv2.FONT_HERSHEY_SIMPLEX, 0.5
    if shade:
        (width, _), _ = cv2.getTextSize(text, font, scale, 1)
        cv2.rectangle(copy, (0, 0), (width + 10, baseline + 7), (255, 255, 255), -1)
    cv2.putText(copy, text, (5, baseline), font, scale, INK, 1, cv2.LINE_AA)
    return copy
