"""Captures of color only, from real videos of one calibrated camera: camera 0 of PhysTwin's scenarios.

    python -m results.published.film22.films FOLDER OUTPUT [--cases ...] [--force]

FOLDER contains observation_30fps/CASE.mp4, whose left third is the video, or videos/combine_tracking__CASE.mp4 (or
combine_rendering__), whose left half is the video. cameras.json is in FOLDER or in phystwin_camera0 next to it; its camera 0
recorded all videos. Each case with annotations of frame 0 (tests/data/marks) becomes a capture OUTPUT/film_CASE: the video, masks
propagated from the annotations, and the released split. Existing captures are kept unless --force is given.
"""

from __future__ import annotations

import json
from argparse import ArgumentParser
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from neuspring.data.camera import Camera
from neuspring.data.capture import CAPTURE, THIN, Capture, Description, Writer
from neuspring.intake.phystwin import released_cases
from neuspring.perception.marks import MARKS as MARKS_FILE
from neuspring.perception.marks import Mark, Marks

MARKS = Path(__file__).parents[3] / "tests" / "data" / "marks"
DRAWN = {"phystwin22_films": (640, 362), "phystwin_camera0": (848, 480)}
"""Folders of annotations, and the size of the annotated videos, px."""
CALIBRATED = (848, 480)
"""Image size in cameras.json, px."""
FILMS = {"observation_30fps/{}.mp4": 3, "videos/combine_tracking__{}.mp4": 2, "videos/combine_rendering__{}.mp4": 2}
"""File patterns, preferred first, and their number of panes; the leftmost pane is the video."""
NAME = "0"
"""The only camera."""
PREFIX = "film_"
"""Prefix of a case in the name of its scenario."""
RATE = 30.0
"""Frames per second."""
WORDS = {"twine": "rope", "toy": "zebra", "dinosor": "dinosaur"}
"""The paper's words for categories of the released table."""
SCALE = 0.66
"""Scale for compressed videos of 640 pixels: as close to drawn masks as at full size (three known scenes), at half the cost."""
IN_THE_AIR = ("rope_double_hand", "weird_package")
"""Cases whose object is above the table in frame 0, as its shadow shows: they have no ground."""


@dataclass(frozen=True, eq=False)
class Frames:
    """Images in memory; implements `Film` of neuspring/perception/film.py."""

    colors: list[np.ndarray]
    depths: list[np.ndarray] | None = None

    @property
    def count(self) -> int:
        return len(self.colors)

    def color(self, frame: int, /) -> np.ndarray:
        return self.colors[frame]

    def depth(self, frame: int, /) -> np.ndarray | None:
        return None if self.depths is None else self.depths[frame]

    def height(self, frame: int, /) -> None:
        return None


def pane(path: Path, place: int, count: int, most: int | None = None) -> list[np.ndarray]:
    """RGB images of pane number `place` of `count` side by side panes of a video; of the first `most` frames, default all."""
    video, colors = cv2.VideoCapture(str(path)), list[np.ndarray]()
    while (most is None or len(colors) < most) and (read := video.read())[0]:
        width = read[1].shape[1] // count
        colors.append(np.ascontiguousarray(read[1][:, place * width : (place + 1) * width, ::-1]))
    return colors


def film(folder: Path, case: str, most: int | None = None) -> list[np.ndarray]:
    """RGB images of a case, of the first `most` frames, default all. Raises FileNotFoundError without a video."""
    for pattern, count in FILMS.items():
        if (file := folder / pattern.format(case)).is_file():
            return pane(file, 0, count, most)
    raise FileNotFoundError(folder / next(iter(FILMS)).format(case))


def cases_of(folder: Path) -> list[str]:
    """The released cases that have a video."""
    return [case for case in sorted(released_cases()) if any((folder / pattern.format(case)).is_file() for pattern in FILMS)]


def scaled(points: np.ndarray, size: tuple[int, int], to: tuple[int, int]) -> np.ndarray:
    """Pixels (x, y) [..., 2] of images of size (width, height) in images of size `to`; pixel centers have integer coordinates."""
    return np.asarray((points + 0.5) * np.divide(to, size) - 0.5)


def camera_of(folder: Path, size: tuple[int, int]) -> Camera:
    """Camera 0 of cameras.json, for images of size (width, height)."""
    path = next(path for place in (folder, folder.parent / "phystwin_camera0") if (path := place / "cameras.json").is_file())
    listed: list[dict[str, Any]] = json.loads(path.read_text())["cameras"]
    camera = next(entry for entry in listed if str(entry["camera"]) == NAME)
    matrix = np.array(camera["K"], float)
    matrix[:2, 2] = scaled(matrix[:2, 2], CALIBRATED, size)
    matrix[[0, 1], [0, 1]] *= np.divide(size, CALIBRATED)
    return Camera(NAME, *size, matrix, np.array(camera["camera_to_world"], float))


def marks_of(case: str, size: tuple[int, int]) -> tuple[Mark, ...]:
    """Committed annotations of frame 0 of a case, for images of size (width, height); empty if there are none."""
    for folder, drawn in DRAWN.items():
        if (path := MARKS / folder / f"{case}.json").is_file():
            marks = Marks.load(path).of(NAME)
            ratio = size[0] / drawn[0]
            return tuple(
                replace(mark, points=tuple(map(tuple, scaled(np.array(mark.points), drawn, size))), radius=ratio * mark.radius)
                for mark in marks
            )
    return ()


def carried(colors: list[np.ndarray], case: str, scale: float = 1.0) -> np.ndarray:
    """Labels [T, H, W] propagated from the annotations of frame 0, on images of `scale` times the size of the video."""
    from neuspring.extensions.color_alone.segment import carry_film

    return carry_film(Frames(colors), marks_of(case, colors[0].shape[1::-1]), scale=scale).labels


def category_of(case: str) -> str:
    """The kind of object of a case, in the paper's words."""
    return WORDS.get(word := released_cases()[case]["category"], word) if case in released_cases() else "other"


def write_capture(
    folder: Path, output: Path, case: str, most: int | None = None, name: str | None = None, scale: float = 1.0
) -> Capture:
    """Write OUTPUT/NAME (default film_CASE) from the first `most` frames, default all.

    Objects lie on the table in frame 0: `pose: lying`. Raises InputError for a wrong calibration or wrong annotations.
    """
    name, colors = name or f"{PREFIX}{case}", film(folder, case, most)
    size = colors[0].shape[1], colors[0].shape[0]
    row, marks = released_cases().get(case), marks_of(case, size)
    whole = row is not None and int(row["frames"]) == len(colors)
    described = Description(
        format=1,
        name=name,
        category=category_of(case),
        frame_count=len(colors),
        frame_rate=RATE,
        cameras=(camera_of(folder, size).entry(),),
        depth="none",
        pose="lying",
        up="-z",
        train_end=int(row["train_end"]) if row is not None and whole else None,
        self_collision=category_of(case) in THIN,
        ground=case not in IN_THE_AIR,
        masks=True,
        provenance={"source": "film of PhysTwin's camera 0", "masks": "carried from marks of frame 0"},
    )
    writer = Writer(output / name, described)
    for frame, (color, mask) in enumerate(zip(colors, carried(colors, case, scale), strict=True)):
        writer.frame(NAME, frame, color, None, mask)
    Marks(cameras={NAME: marks}).save(output / name / MARKS_FILE)
    return writer.finish()


def write_captures(folder: Path, output: Path, cases: list[str], *, force: bool = False) -> None:
    """Write captures of all cases with annotations; existing captures are kept without `force`."""
    for case in cases:
        if (output / f"{PREFIX}{case}" / CAPTURE).exists() and not force:
            print(f"{case}: exists, kept", flush=True)
        elif not marks_of(case, CALIBRATED):
            print(f"{case}: has no annotations", flush=True)
        else:
            capture = write_capture(folder, output, case, scale=SCALE)
            print(f"{case}: {capture.frame_count} frames, training before {capture.train_end}", flush=True)


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--cases", nargs="+", help="default: all with a video")
    parser.add_argument("--force", action="store_true", help="write existing captures again")
    a = parser.parse_args()
    write_captures(a.folder, a.output, a.cases or cases_of(a.folder), force=a.force)


if __name__ == "__main__":
    main()
