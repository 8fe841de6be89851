"""The animation of a pulled twin: `python -m results.published.pictures.pulled OUTPUT.gif`.

The sample twin of the package hangs from its controllers, which rise. A spring pulls its head in a circle and releases it, as the
mouse does in `neuspring play`. `neuspring draw film` draws its splats; one panel is kept, with a line from the head to the mouse.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

import neuspring as ns
from neuspring.cli.main import main as neuspring
from neuspring.core.records import digest_file
from neuspring.draw.film import write_gif
from neuspring.draw.scene import ShownRun, ShownScene
from neuspring.extensions.play.simulator import Simulator

LEAST, RISE, WIDE, HIGH = 14, 0.10, 0.12, 0.07
"""Frames after the release; rise of the controllers, and motion of the mouse sideways and up, m."""
AZIMUTH, ELEVATION = 255.0, 20.0
VIEW = ("--as", "splats", "--error", "none", "--width", "640", "--azimuth", str(AZIMUTH), "--elevation", str(ELEVATION))
LINE = (220, 60, 30)
PANEL, TOP = 322, 44
"""First column and row of the panel of the twin in the video."""


def pulled(frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [F, N, 3], m, and the ends of the line from the head to the mouse [F, 2, 3], NaN after the release."""
    twin = ns.load_run().twin
    simulator = Simulator(twin)
    rest = simulator.positions.copy()
    head, places, lines = int(np.argmax(rest[:, 0])), [], []
    for frame in range(frames):
        turn = 2 * np.pi * min(frame / (frames - LEAST), 1)
        up = np.array([0, 0, RISE * min(frame / 12, 1)])
        target = rest[head] + up + [WIDE * np.sin(turn), 0, HIGH * (1 - np.cos(turn))]
        held = frame < 0.9 * (frames - LEAST)
        places.append(simulator.step(twin.topology.controllers + up, *((head, target) if held else ())).copy())
        lines.append(np.stack([places[-1][head], target]) if held else np.full((2, 3), np.nan))
    return np.stack(places), np.stack(lines)


def pixels_of(positions: np.ndarray, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Pixels of points [..., 3] in the panel of the video of positions [F, N, 3]."""
    observations, frames = ns.load_run().observations, range(len(positions))
    scene = ShownScene.from_side(observations, [ShownRun("twin", positions)], frames, AZIMUTH, ELEVATION)
    left, top, right, bottom = scene.box
    pixels, _ = scene.camera.project(points.reshape(-1, 3))
    return ((pixels - [left, top]) / [right - left, bottom - top] * size).reshape(*points.shape[:-1], 2)


def main() -> None:
    """Draw the video, crop it and write OUTPUT."""
    output, run = Path(sys.argv[1]), ns.load_run()
    assert run.trajectory is not None
    with tempfile.TemporaryDirectory() as name:
        folder, film = Path(name) / "twin", Path(name) / "film.gif"
        shutil.copytree(ns.sample_twin().parents[2], folder)
        scenario = next(path for path in folder.iterdir() if path.is_dir())
        record = next(scenario.glob("*/*/rollout.json"))
        old, path = digest_file(record.with_name("trajectory.npz")), record.with_name("trajectory.npz")
        positions, lines = pulled(len(run.trajectory.positions))
        replace(run.trajectory, positions=positions.astype(np.float32)).save(path)
        text = record.read_text()
        assert old in json.dumps(json.loads(text))
        record.write_text(text.replace(old, digest_file(path)))
        neuspring(["draw", "film", str(scenario), "--methods", "neuspring", *VIEW, "--output", str(film)])
        with Image.open(film) as shown:
            pictures = []
            for frame in range(shown.n_frames):
                shown.seek(frame)
                picture = np.ascontiguousarray(np.asarray(shown.convert("RGB"))[TOP:, PANEL:])
                ends = pixels_of(positions, lines, picture.shape[1::-1])[frame]
                if np.isfinite(ends).all():
                    first, last = (tuple(map(int, end.round())) for end in ends)
                    cv2.line(picture, first, last, LINE, 2, cv2.LINE_AA)
                    cv2.circle(picture, last, 6, LINE, -1, cv2.LINE_AA)
                pictures.append(picture)
    write_gif(output, pictures, 20.0)
    print(f"{output}: {output.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
