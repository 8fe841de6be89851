"""Captures of color alone of real footage: the input of a run on film of one calibrated camera.

    python -m results.published.footage.captures FOLDER OUTPUT [--cases ...] [--force]

FOLDER is that of `film`, with cameras.json. Of each case with a video and with marks (tests/data/marks) a
capture OUTPUT/CASE is written: the film, masks carried from the marks of frame 0, the marks, and as points.json the points that
were marked by hand and are sure. Its provenance has the processor seconds of the carrying, for the table of costs. All objects lie
in frame 0, as one sees there: `pose: lying`. A capture that is there is left alone without --force.
"""

from __future__ import annotations

import json
import shutil
import time
from argparse import ArgumentParser
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.data.camera import Camera
from neuspring.data.capture import CAPTURE, Capture, Description, Writer
from neuspring.intake.phystwin import released_cases
from neuspring.perception.marks.marks import MARKS as MARKS_FILE
from results.published.footage.film import MARKS, VIDEOS, Points, carried, film

NAME = "0"
"""The only camera."""
RATE = 30.0
"""Frames per second of the films."""
CARRYING = "carrying_seconds"
"""The entry of a capture's provenance with the processor seconds that its masks took."""
CATEGORIES = ("cloth", "rope", "sloth", "zebra")


def cases_of(folder: Path) -> list[str]:
    """The cases that have a video."""
    return sorted({file.stem.split("__", 1)[1] for kind in VIDEOS for file in (folder / "videos").glob(f"{kind}__*.mp4")})


def category_of(case: str) -> str:
    """The kind of object that a case's name says."""
    return next((kind for kind in CATEGORIES if kind in case.split("_")), "other")


def camera_of(folder: Path) -> Camera:
    """Camera 0 of cameras.json, with the principal point that stands there."""
    listed: list[dict[str, Any]] = json.loads((folder / "cameras.json").read_text())["cameras"]
    one = next(entry for entry in listed if str(entry["camera"]) == NAME)
    return Camera(NAME, one["width"], one["height"], np.array(one["K"], float), np.array(one["camera_to_world"], float))


def points_of(path: Path, frames: int) -> np.ndarray:
    """Sure points [T, K, 2], pixels, of tracks/CASE.json; NaN in frames in which they are not marked, hidden or guessed."""
    marked = Points.load(path)
    # Frame 0 decides whether any other place of a point counts, see `Points.sure`.
    kept = marked.sure.any(axis=1)
    points = np.full((frames, int(kept.sum()), 2), np.nan)
    for column, frame in enumerate(marked.frames):
        if frame < frames:
            points[frame] = np.where(marked.sure[kept, column, None], marked.xy[kept, column], np.nan)
    return points


def write_capture(folder: Path, output: Path, case: str, most: int | None = None, name: str | None = None) -> Capture:
    """Write OUTPUT/NAME (CASE by default), of the first `most` frames, all by default.

    Raises InputError for a wrong calibration or wrong marks.
    """
    name = name or case
    colors, marks = film(folder, case, most), MARKS / "phystwin_camera0" / f"{case}.json"
    row = released_cases().get(case)
    whole = row is not None and int(row["frames"]) == len(colors)
    described = Description(
        format=1,
        name=name,
        category=category_of(case),
        frame_count=len(colors),
        frame_rate=RATE,
        cameras=(camera_of(folder).entry(),),
        depth="none",
        pose="lying",
        up="-z",
        train_end=int(row["train_end"]) if row is not None and whole else None,
        masks=True,
        provenance={"source": "footage", "masks": f"carried from {marks.name}"},
    )
    writer, began = Writer(output / name, described), time.process_time()
    labels, seconds = carried(colors, case), time.process_time() - began
    for frame, (color, mask) in enumerate(zip(colors, labels, strict=True)):
        writer.frame(NAME, frame, color, None, mask)
    shutil.copyfile(marks, output / name / MARKS_FILE)
    tracks = folder / "tracks" / f"{case}.json"
    points = {NAME: points_of(tracks, len(colors))} if tracks.exists() else None
    writer.finish(points=points, **{CARRYING: f"{seconds:.1f}"})
    return Capture.load(output / name)


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--cases", nargs="+", help="all that have a video by default")
    parser.add_argument("--force", action="store_true", help="write captures anew that are there")
    a = parser.parse_args()
    for case in a.cases or cases_of(a.folder):
        if (a.output / case / CAPTURE).exists() and not a.force:
            print(f"{case}: is there", flush=True)
        elif not (MARKS / "phystwin_camera0" / f"{case}.json").exists():
            print(f"{case}: has no marks", flush=True)
        else:
            began = time.perf_counter()
            capture = write_capture(a.folder, a.output, case)
            size = sum(file.stat().st_size for file in capture.folder.rglob("*") if file.is_file())
            split = f"{capture.frame_count} frames, training before {capture.train_end}"
            points = capture.points(NAME).shape[1]
            print(f"{case}: {split}, {points} points, {size / 1e6:.0f} MB, {time.perf_counter() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
