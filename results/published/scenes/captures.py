"""Captures of PhysTwin scenes with controllers in space: points only, video with controllers, and both.

    python -m results.published.scenes.captures FOLDER OUTPUT [--films FOLDER] [--cases ...] [--force]

A case is any folder below FOLDER with these files, in integers of 0.1 mm:

    controller.txt, landmarks.txt   one line per frame: its number, then points x y z; landmark 0 0 0: not visible
    rest.txt                        one line x y z per node of frame 0

Each case becomes

    OUTPUT/CASE_points   controllers, nodes and annotated points; points of training frames are used for fits
    OUTPUT/CASE_film     color of camera 0 and controllers; annotated points are only for scores
    OUTPUT/CASE_both     color, controllers, nodes and annotated points

The last two require a video in the folder of --films (as in `results.published.film22.films`) and annotations in
tests/data/marks. The world is that of the cameras: z = 0 is the table, up is -z. The split is the released one. Existing captures
are kept unless --force is given.
"""

from __future__ import annotations

import json
import shutil
from argparse import ArgumentParser
from pathlib import Path

import numpy as np

from neuspring.core.files import write_text
from neuspring.data.capture import CAPTURE, Capture, Description, Writer, write_tracks
from neuspring.intake.phystwin import released_cases
from neuspring.intake.points import Hands, read, write
from results.published.film22.films import CALIBRATED, RATE, cases_of, category_of, marks_of, write_capture

UNIT = 1e-4
"""m per count."""
FILES = ("controller.txt", "landmarks.txt", "rest.txt")
NO_BOOLS, NO_INTS = np.zeros((0, 0), bool), np.zeros(0, int)


def folders_of(folder: Path) -> dict[str, Path]:
    """Case -> its folder."""
    return {
        path.parent.name: path.parent for path in sorted(folder.rglob(FILES[0])) if all((path.parent / n).exists() for n in FILES)
    }


def moving(path: Path) -> np.ndarray:
    """Points [T, n, 3], counts, of a file with a line per frame. Raises ValueError if frames are not 0, 1, 2, ..."""
    rows = np.loadtxt(path, dtype=int, ndmin=2)
    if not np.array_equal(rows[:, 0], np.arange(len(rows))) or (rows.shape[1] - 1) % 3:
        raise ValueError(f"{path}: each line must contain the frame number, from 0, and points x y z")
    return rows[:, 1:].reshape(len(rows), -1, 3)


def read_case(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Controllers [T, C, 3], annotated points [T, K, 3] (NaN: not visible) and nodes [N, 3] of a case, m."""
    hands, marked = moving(folder / FILES[0]), moving(folder / FILES[1])
    tracks = np.where((marked != 0).any(axis=2, keepdims=True), UNIT * marked, np.nan)
    nodes = np.unique(np.loadtxt(folder / FILES[2], dtype=int, ndmin=2), axis=0)
    return UNIT * hands, tracks, UNIT * nodes


def described(case: str, name: str, frames: int) -> Description:
    """Description of a capture with points only."""
    row = released_cases().get(case)
    split = int(row["train_end"]) if row is not None and int(row["frames"]) == frames else None
    return Description(
        format=1,
        name=name,
        category=category_of(case),
        frame_count=frames,
        frame_rate=RATE,
        cameras=(),
        depth="none",
        tracks="train",
        up="-z",
        train_end=split,
        provenance={"source": "hands in space"},
    )


def write_points(folder: Path, output: Path, case: str) -> Capture:
    """Write OUTPUT/CASE_points. Raises InputError or ValueError for unreadable files."""
    hands, tracks, nodes = read_case(folder)
    name = f"{case}_points"
    writer = Writer(output / name, described(case, name, len(hands)))
    write(output / name, Hands(hands, NO_BOOLS, NO_INTS), nodes)
    made = writer.finish(tracks)
    read(made)
    return made


def add_hands(film: Path, folder: Path, *, both: bool) -> Capture:
    """Add controllers and annotated points to a capture of video; with `both` also nodes, and the points are used for fits."""
    made = Capture.load(film)
    hands, tracks, nodes = read_case(folder)
    if made.frame_count > len(hands):
        raise ValueError(f"{folder}: must have at least {made.frame_count} frames, like the video; received {len(hands)}")
    kept = slice(made.frame_count)
    write(made.folder, Hands(hands[kept], NO_BOOLS, NO_INTS), nodes if both else nodes[:0])
    write_tracks(made.folder, tracks[kept])
    path = made.folder / CAPTURE
    values = json.loads(path.read_text()) | {"name": made.folder.name, "tracks": "train" if both else "score"}
    write_text(path, json.dumps(values, indent=1) + "\n")
    capture = Capture.load(made.folder)
    read(capture)
    return capture


def summary_line(capture: Capture) -> str:
    """One line that describes a capture."""
    space, tracks = read(capture), capture.tracks()
    assert space.hands is not None
    words = f"{space.hands.points.shape[1]} controllers, {len(space.nodes)} nodes, {tracks.shape[1]} annotated points"
    return f"{capture.folder.name}: {capture.frame_count} frames, training before {capture.train_end}, {words}"


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--films", type=Path, help="folder with videos and cameras.json")
    parser.add_argument("--cases", nargs="+", help="default: all")
    parser.add_argument("--force", action="store_true", help="write existing captures again")
    a = parser.parse_args()
    found = folders_of(a.folder)
    if not found or (missing := set(a.cases or ()) - set(found)):
        parser.error(f"{a.folder}: must contain a case {' '.join(sorted(missing)) if found else ''} with {', '.join(FILES)}")
    films = cases_of(a.films) if a.films else []
    for case in a.cases or found:
        marked = bool(marks_of(case, CALIBRATED))
        if a.films and not (case in films and marked):
            print(f"{case}: no {'annotations' if case in films else 'video'}, so points only", flush=True)
        for row in ("points", *(("film", "both") if case in films and marked else ())):
            folder = a.output / f"{case}_{row}"
            if (folder / CAPTURE).exists() and not a.force:
                print(f"{folder.name}: exists, kept", flush=True)
            elif row == "points":
                print(summary_line(write_points(found[case], a.output, case)), flush=True)
            elif row == "film":
                write_capture(a.films, a.output, case, name=folder.name)
                print(summary_line(add_hands(folder, found[case], both=False)), flush=True)
            else:
                shutil.rmtree(folder, ignore_errors=True)
                shutil.copytree(a.output / f"{case}_film", folder)
                print(summary_line(add_hands(folder, found[case], both=True)), flush=True)


if __name__ == "__main__":
    main()
