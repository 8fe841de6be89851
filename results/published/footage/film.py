"""Real color film of one camera and what was drawn in it by hand: videos, masks, points.

A folder of it has videos/combine_tracking__CASE.mp4 or combine_rendering__CASE.mp4 (the left half is the film),
masks/CASE/FRAME.png (0 nothing, 1 object, 2 hands) and tracks/CASE.json (points marked by hand, null where hidden). Marks of
frame 0 alone (tests/data/marks) are carried through the film.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from neuspring.config.perception import MarksSegmentation
from neuspring.perception.marks.carry import carry
from neuspring.perception.marks.marks import Marks

MARKS = Path(__file__).parents[3] / "tests" / "data" / "marks"


@dataclass(frozen=True, eq=False)
class Frames:
    """Images in memory; implements `Images`."""

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


@dataclass(frozen=True, eq=False)
class Points:
    """tracks/CASE.json."""

    names: list[str]
    frames: list[int]
    xy: np.ndarray
    """[K, F, 2], NaN where hidden."""
    sure: np.ndarray
    """[K, F] bool: marked to 1 to 3 pixels here and in frame 0; the others were guessed, under a fingertip for instance."""

    @classmethod
    def load(cls, path: Path) -> Points:
        values = json.loads(path.read_text())
        own = values["points"].values()
        xy = np.array([[place or (np.nan, np.nan) for place in point["xy"]] for point in own], float)
        uncertain = np.array([point["uncertain"] for point in own])
        return cls(list(values["points"]), values["frames"], xy, ~(uncertain | uncertain[:, :1]) & np.isfinite(xy[..., 0]))


VIDEOS = ("combine_tracking", "combine_rendering")
"""Videos of one case whose left half is the film, the preferred one first."""


def film(folder: Path, case: str, most: int | None = None) -> list[np.ndarray]:
    """RGB images of the left half of a video; the first `most`, all by default. Raises FileNotFoundError without a video."""
    files = [folder / "videos" / f"{kind}__{case}.mp4" for kind in VIDEOS]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        raise FileNotFoundError(files[0])
    video, colors = cv2.VideoCapture(str(file)), []
    while most is None or len(colors) < most:
        ok, frame = video.read()
        if not ok:
            break
        colors.append(np.ascontiguousarray(frame[:, : frame.shape[1] // 2, ::-1]))
    return colors


def truths(folder: Path, case: str) -> dict[int, np.ndarray]:
    """Drawn masks by frame."""
    return {int(file.stem): cv2.imread(str(file), 0) for file in sorted((folder / "masks" / case).glob("*.png"))}


def carried(colors: list[np.ndarray], case: str) -> np.ndarray:
    """Labels [T, H, W] from the committed marks of frame 0."""
    return carry(Frames(colors), Marks.load(MARKS / "phystwin_camera0" / f"{case}.json").of("0"), MarksSegmentation()).labels
