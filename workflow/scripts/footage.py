"""Masks and tracks on real color film against what was drawn by hand: tables of IoU and of pixel errors.

    python -m workflow.scripts.footage FOLDER [--cases ...] [--masks FOLDER] [--trackers ...]

FOLDER has videos/combine_tracking__CASE.mp4 or combine_rendering__CASE.mp4 (the left half is the film), masks/CASE/FRAME.png
(0 nothing, 1 object, 2 hands) and tracks/CASE.json (points marked by hand, null where hidden). Marks of frame 0 alone
(tests/data/marks) are carried through the film. Then points are followed from where they were marked in frame 0, and compared in
the other frames. With --masks, carried masks are kept in a folder, and read from there by the next call.
"""

from __future__ import annotations

import json
import time
from argparse import ArgumentParser
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from neuspring.config.perception import MarksSegmentation, OpenCvTracking
from neuspring.data.capture import HANDS, OBJECT
from neuspring.data.frames import overlap
from neuspring.extensions.annotate.clicks import Click, GrayImages
from neuspring.extensions.annotate.clicks import follow as follow_click
from neuspring.perception import track_opencv
from neuspring.perception.marks.carry import carry
from neuspring.perception.marks.marks import Marks
from workflow.scripts.masks import MARKS, Frames

RIM = 3.0
"""How far beside its mask a point may lie, pixels: points were marked at tips and corners."""


@dataclass(frozen=True, eq=False)
class Film:
    """Colors in memory; stands in for a capture where trackers read images."""

    colors: list[np.ndarray]

    @property
    def frame_count(self) -> int:
        return len(self.colors)

    @property
    def cameras(self) -> dict[str, SimpleNamespace]:
        height, width = self.colors[0].shape[:2]
        return {"0": SimpleNamespace(width=width, height=height)}

    def has(self, camera: str, frame: int) -> bool:
        return True

    def color(self, camera: str, frame: int) -> np.ndarray:
        return self.colors[frame]


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


def overlaps(labels: np.ndarray, truth: dict[int, np.ndarray]) -> np.ndarray:
    """IoU of object and hands [F, 2] in the drawn frames."""
    return np.array([[overlap(labels[k] == label, mask == label) for label in (OBJECT, HANDS)] for k, mask in truth.items()])


def newly_covered(labels: np.ndarray, truth: dict[int, np.ndarray]) -> list[float]:
    """IoU of the object in the drawn frames but the first, over pixels that it does not cover there; NaN where it moves to none."""
    first = truth[min(truth)] != OBJECT
    return [overlap((labels[k] == OBJECT) & first, (truth[k] == OBJECT) & first) for k in sorted(truth)[1:]]


def stepwise(colors: list[np.ndarray], labels: np.ndarray, start: np.ndarray, **settings: Any) -> tuple[np.ndarray, np.ndarray]:
    """The tracker of the workflow: places [T, K, 2] and whether they are visible [T, K], among its own random points."""
    chosen = replace(OpenCvTracking(rim=RIM), **settings)
    points = np.concatenate([start, track_opencv.choose(labels[0], chosen.points, 0)]).astype(np.float32)
    found = track_opencv.follow(Film(colors), "0", labels, points, chosen)  # type: ignore[arg-type]
    return found.pixels[:, : len(start)], found.visible[:, : len(start)]


def clicked(colors: list[np.ndarray], labels: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The tracker of `neuspring annotate`, from one click in frame 0, without masks."""
    images = GrayImages(Film(colors))  # type: ignore[arg-type]
    places = [follow_click(images, "0", [Click(frame=0, x=float(x), y=float(y))]).places for x, y in start]
    return np.stack(places, axis=1), np.isfinite(np.stack(places, axis=1)[..., 0])


TRACKERS: dict[str, Callable[..., tuple[np.ndarray, np.ndarray]]] = {
    "lucas_kanade": stepwise,
    "dis": lambda colors, labels, start: stepwise(colors, labels, start, method="dis"),
    "click": clicked,
}


@dataclass(frozen=True)
class Errors:
    """Of the points that are marked in later frames."""

    shown: int
    """Places that were marked and are sure."""
    lost: float
    """Share of them without a place."""
    median: float
    """Pixels, of the others."""
    most: float
    """90th percentile, pixels."""
    hidden: str
    """Of the places where a point is hidden, how many the tracker shows."""

    @classmethod
    def of(cls, points: Points, places: np.ndarray, visible: np.ndarray) -> Errors:
        at = points.frames[1:]
        place, seen = places[at].transpose(1, 0, 2), visible[at].T
        sure, away = points.sure[:, 1:], np.isnan(points.xy[:, 1:, 0])
        errors = np.linalg.norm(place - points.xy[:, 1:], axis=2)[sure & seen]
        median, most = np.percentile(errors, [50, 90]) if len(errors) else (np.nan, np.nan)
        lost = 1 - (sure & seen).sum() / max(sure.sum(), 1)
        return cls(int(sure.sum()), float(lost), float(median), float(most), f"{(away & seen).sum()} of {away.sum()}")


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cases", nargs="+", help="all that have marks and drawn masks by default")
    parser.add_argument("--masks", type=Path, help="folder in which carried masks are kept")
    parser.add_argument("--trackers", nargs="*", choices=list(TRACKERS), default=list(TRACKERS))
    a = parser.parse_args()
    drawn = (path.stem for path in (MARKS / "phystwin_camera0").glob("*.json") if (a.folder / "masks" / path.stem).is_dir())
    for case in a.cases or sorted(drawn):
        colors, kept = film(a.folder, case), a.masks / f"{case}.npz" if a.masks else None
        began = time.perf_counter(), time.process_time()
        if kept and kept.exists():
            labels = np.load(kept)["labels"]
        else:
            labels = carried(colors, case)
            if kept:
                a.masks.mkdir(parents=True, exist_ok=True)
                np.savez_compressed(kept, labels=labels)
        rows = overlaps(labels, truths(a.folder, case))
        cells = [f"{' '.join(f'{value:.3f}' for value in rows[:, k])}: {rows[:, k].mean():.3f}" for k in range(2)]
        cells.append(" ".join(f"{value:.3f}" for value in newly_covered(labels, truths(a.folder, case))))
        print(
            f"{case}: {len(colors)} frames, object {cells[0]}, newly covered {cells[2]}, hands {cells[1]}, {_spent(*began)}",
            flush=True,
        )
        if (a.folder / "tracks" / f"{case}.json").exists():
            points = Points.load(a.folder / "tracks" / f"{case}.json")
            for name in a.trackers:
                began = time.perf_counter(), time.process_time()
                found = Errors.of(points, *TRACKERS[name](colors, labels, points.xy[:, 0]))
                print(
                    f"  {name:14s} places {found.shown:3d}  lost {found.lost:4.0%}  median {found.median:5.1f} px  "
                    f"90 % {found.most:5.1f} px  shown though hidden {found.hidden}, {_spent(*began)}",
                    flush=True,
                )


def _spent(wall: float, processor: float) -> str:
    return f"{time.perf_counter() - wall:.0f} s ({time.process_time() - processor:.0f} s of processor time)"


if __name__ == "__main__":
    main()
