"""How well masks are carried from a few marks: IoU against drawn or rendered masks, as a table.

    python -m workflow.scripts.masks plush FOLDER                     real RGBD film, marks in tests/data/marks
    python -m workflow.scripts.masks captures FOLDER ...              synthetic captures; outlines of frame 0 stand in for a user

FOLDER of `plush` has color/NUMBER.png, depth/NUMBER.png (mm) and masks_250_335. With --pictures FOLDER, frames with masks are drawn
to look at. Real color film: `workflow.scripts.footage`.
"""

from __future__ import annotations

import time
from argparse import ArgumentParser
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from neuspring.config.perception import MarksSegmentation
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.frames import TINTS, overlap, overlay
from neuspring.perception.marks.carry import Carried, carry, carry_camera
from neuspring.perception.marks.marks import Mark, Marks

MARKS = Path(__file__).parents[2] / "tests" / "data" / "marks"
MOST_MARKS = 5
OUTLINE = 1.5
"""How far, pixels, the outline that a user draws is from the truth."""


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


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kind", choices=["plush", "captures"])
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--first", type=int, default=160, help="first frame of plush")
    parser.add_argument("--frames", type=int, help="of each film, from its first one; all by default")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument(
        "--correct", action="store_true", help="captures: outlines in the most doubtful frame too, five marks in all"
    )
    parser.add_argument("--pictures", type=Path)
    a = parser.parse_args()
    settings = MarksSegmentation(scale=a.scale)
    print(f"{'film':38s} frame  object  hands  doubt", flush=True)
    for folder in a.folders:
        if a.kind == "plush":
            _plush(folder, settings, a.first, a.frames, a.pictures)
        else:
            _capture(folder, settings, a.correct, a.pictures)


def _plush(folder: Path, settings: MarksSegmentation, first: int, most: int | None, pictures: Path | None) -> None:
    numbers = [number for number in range(first, 350) if (folder / "color" / f"{number:06d}.png").exists()][:most]
    colors = [np.ascontiguousarray(cv2.imread(str(folder / "color" / f"{number:06d}.png"))[..., ::-1]) for number in numbers]
    depths = [cv2.imread(str(folder / "depth" / f"{number:06d}.png"), -1).astype(np.float32) / 1000 for number in numbers]
    # Marks of the committed file count from frame 160.
    marks = [own for own in _shifted(Marks.load(MARKS / "rgbd_plush.json").of("0"), first - 160) if own.frame < len(numbers)]
    truth = {}
    for file in sorted((folder / "masks_250_335").rglob("*.png")):
        number = int(file.stem) + (250 if int(file.stem) < 100 else 0)
        if number in numbers:
            truth[numbers.index(number)] = cv2.imread(str(file), 0)
    began = time.perf_counter()
    carried = carry(Frames(colors, depths), marks, settings)
    _tell(f"plush {first}", carried, truth, time.perf_counter() - began, Frames(colors), pictures)


def _shifted(marks: Iterable[Mark], by: int) -> list[Mark]:
    return [replace(own, frame=own.frame - by) for own in marks if own.frame >= by]


def _capture(folder: Path, settings: MarksSegmentation, correct: bool, pictures: Path | None) -> None:
    capture = Capture.load(folder)
    for camera in capture.cameras:
        truth = {frame: capture.mask(camera, frame) for frame in range(capture.frame_count) if capture.has(camera, frame)}
        began = time.perf_counter()
        marks = outlines(truth[0])
        carried = carry_camera(capture, camera, marks, settings)
        if correct:
            frame = max(truth, key=lambda frame: float(carried.doubt[frame]))
            carried = carry_camera(capture, camera, [*marks, *corrections(marks, truth[frame], frame)], settings)
        colors = [capture.color(camera, frame) if frame in truth else np.zeros((16, 16, 3)) for frame in range(capture.frame_count)]
        _tell(f"{capture.description.name} {camera}", carried, truth, time.perf_counter() - began, Frames(colors), pictures)


def outlines(truth: np.ndarray) -> list[Mark]:
    """At most MOST_MARKS polygons that a user would draw around what frame 0 shows, the largest first."""
    found = []
    for label, name in ((OBJECT, "object"), (HANDS, "hand")):
        contours, _ = cv2.findContours((truth == label).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            coarse = cv2.approxPolyDP(contour, OUTLINE, True)[:, 0]
            if len(coarse) >= 3:
                points = tuple((float(x), float(y)) for x, y in coarse)
                found.append((cv2.contourArea(contour), Mark(frame=0, label=name, kind="polygon", points=points, radius=2.0)))  # type: ignore[arg-type]
    return [own for _, own in sorted(found, key=lambda pair: -pair[0])[:MOST_MARKS]]


def corrections(marks: Sequence[Mark], truth: np.ndarray, frame: int) -> list[Mark]:
    """Outlines of what a later frame shows, as many as `marks` leave of MOST_MARKS."""
    return [replace(own, frame=frame) for own in outlines(truth)[: MOST_MARKS - len(marks)]]


def _tell(
    name: str, carried: Carried, truth: Mapping[int, np.ndarray], seconds: float, images: Frames, pictures: Path | None
) -> None:
    known = [frame for frame in truth if frame < len(carried.labels)]
    rows = {frame: [overlap(carried.labels[frame] == label, truth[frame] == label) for label in (OBJECT, HANDS)] for frame in known}
    shown = known if len(known) < 8 else [known[k] for k in np.linspace(0, len(known) - 1, 5).astype(int)]
    for frame in shown:
        print(f"{name:38s} {frame:5d}  {rows[frame][0]:6.3f}  {rows[frame][1]:5.3f}  {carried.doubt[frame]:5.2f}")
    means = np.nanmean(list(rows.values()), axis=0) if rows else (np.nan, np.nan)
    least = np.nanmin(list(rows.values()), axis=0) if rows else (np.nan, np.nan)
    print(f"{name:38s}  mean  {means[0]:6.3f}  {means[1]:5.3f}")
    print(f"{name:38s} least  {least[0]:6.3f}  {least[1]:5.3f}  {seconds:.0f} s for {len(carried.labels)} frames", flush=True)
    if pictures:
        pictures.mkdir(parents=True, exist_ok=True)
        frames = shown or np.linspace(0, len(carried.labels) - 1, 8).astype(int).tolist()
        tiles = [overlay(images.color(frame), carried.labels[frame], TINTS) for frame in frames]
        cv2.imwrite(str(pictures / f"{name.replace(' ', '_')}.png"), np.hstack(tiles)[..., ::-1])


if __name__ == "__main__":
    main()
