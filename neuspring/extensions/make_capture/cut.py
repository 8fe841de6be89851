"""Some frames of a capture as a capture of their own (`neuspring cut-capture`)."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.records import digest_file
from neuspring.data.capture import CAPTURE, CONTROLLERS, NODES, POINTS, REST, TRACKS, Capture, Writer
from neuspring.data.images import make_way
from neuspring.intake import points


def cut(capture: Capture, first: int, last: int, folder: Path) -> Capture:
    """Frames `first` to `last` of a capture, both included, as a capture of its own in a new `folder`, without marks and clicks.

    Raises InputError for frames that it does not have, a first frame that a camera missed, or a folder with files.
    """
    description = capture.description
    if not 0 <= first < last - 3 or last >= capture.frame_count:
        rule = f"five frames or more of 0 to {capture.frame_count - 1} are required, as in 12-97"
        raise InputError("--frames", rule, f"{first}-{last}")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(folder, "--output must be a new or empty folder", "other files", "Choose another folder.")
    kept = range(first, last + 1)
    cameras = tuple(replace(c, missing=tuple(k - first for k in c.missing if k in kept)) for c in description.cameras)
    if late := [c.name for c in cameras if 0 in c.missing]:
        raise InputError("--frames", f"camera {late[0]} must have the first frame", f"{first}, which it missed", "Begin later.")
    if first and (body := points.given(capture.folder, NODES)) is not None:
        rule = "the nodes are those of frame 0, with which a cut must begin"
        raise InputError(body, rule, f"frame {first}", "Write nodes of that frame, or remove the file.")
    for path in [path for name in ("color", "depth", "mask") for path in (capture.folder / name).glob("*/*")]:
        if path.stem.isdigit() and int(path.stem) in kept:
            there = folder / path.relative_to(capture.folder).with_name(f"{int(path.stem) - first:05d}{path.suffix}")
            make_way(there)
            shutil.copyfile(path, there)
    source = {"cut of": f"sha256:{digest_file(capture.folder / CAPTURE)}", "frames of it": f"{first}-{last}"}
    own = replace(description, name=folder.resolve().name, frame_count=len(kept), cameras=cameras, train_end=None)
    marked = {name: capture.points(name)[kept] for name in capture.cameras} if (capture.folder / POINTS).exists() else None
    tracks = capture.tracks()[kept] if (capture.folder / TRACKS).exists() else None
    writer = Writer(folder, own)
    file, body = (points.given(capture.folder, names) for names in (CONTROLLERS, NODES))
    hands = points.read_hands(file, capture.frame_count) if file else None
    if hands is not None:
        hands = replace(hands, points=hands.points[kept], holds=hands.holds[kept] if hands.holds.size else hands.holds)
    points.write(folder, hands, points.read_nodes(body) if body else np.zeros((0, 3)))
    if (shape := capture.folder / REST).exists():
        shutil.copyfile(shape, folder / REST)
    return writer.finish(tracks, marked, **source)
