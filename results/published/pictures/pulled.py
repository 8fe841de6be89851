"""The front page's film of a twin that is pulled: `python -m results.published.pictures.pulled OUTPUT.gif`.

The twin that travels with the package hangs from its hand, which rises, while its right arm is pulled in a circle and let go, by
the spring with which `neuspring play` pulls what the mouse holds. `neuspring draw film` draws its splats; one panel is kept.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import neuspring as ns
from neuspring.cli.main import main as neuspring
from neuspring.core.records import digest_file
from neuspring.draw.film import write_gif
from neuspring.extensions.play.simulator import Simulator

LEAST, RISE, WIDE, HIGH = 14, 0.10, 0.12, 0.07
"""Frames after the arm was let go; how far the hand rises, and the arm goes aside and up, m."""
VIEW = ("--as", "splats", "--error", "none", "--width", "640", "--azimuth", "255", "--elevation", "20")
PANEL, TOP = 322, 44
"""First column and row of the picture of the twin in the film."""


def pulled(frames: int) -> np.ndarray:
    """Nodes [F, N, 3], m."""
    twin = ns.load_run().twin
    simulator = Simulator(twin)
    rest = simulator.positions.copy()
    arm, places = int(np.argmax(rest[:, 0])), []
    for frame in range(frames):
        turn = 2 * np.pi * min(frame / (frames - LEAST), 1)
        up = np.array([0, 0, RISE * min(frame / 12, 1)])
        target = rest[arm] + up + [WIDE * np.sin(turn), 0, HIGH * (1 - np.cos(turn))]
        held = frame < 0.9 * (frames - LEAST)
        places.append(simulator.step(twin.topology.controllers + up, *((arm, target) if held else ())).copy())
    return np.stack(places)


def main(output: Path) -> None:
    """Draw, crop, write."""
    run = ns.load_run()
    assert run.trajectory is not None
    with tempfile.TemporaryDirectory() as name:
        folder, film = Path(name) / "twin", Path(name) / "film.gif"
        shutil.copytree(ns.sample_twin().parents[2], folder)
        scenario = next(path for path in folder.iterdir() if path.is_dir())
        record = next(scenario.glob("*/*/rollout.json"))
        old, path = digest_file(record.with_name("trajectory.npz")), record.with_name("trajectory.npz")
        replace(run.trajectory, positions=pulled(len(run.trajectory.positions)).astype(np.float32)).save(path)
        text = record.read_text()
        assert old in json.dumps(json.loads(text))
        record.write_text(text.replace(old, digest_file(path)))
        neuspring(["draw", "film", str(scenario), "--methods", "neuspring", *VIEW, "--output", str(film)])
        with Image.open(film) as shown:
            pictures = []
            for frame in range(shown.n_frames):
                shown.seek(frame)
                pictures.append(np.asarray(shown.convert("RGB"))[TOP:, PANEL:])
    write_gif(output, pictures, 20.0)
    print(f"{output}: {output.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
