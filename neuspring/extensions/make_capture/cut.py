"""Copy some frames of a capture to a new capture (`neuspring cut-capture`)."""

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
    """Copy frames `first` to `last` of a capture, both included, to a capture in a new `folder`, without annotations of masks.

    Raises InputError for missing frames, a first frame that a camera missed, nodes of another frame, or a folder with files.
    """
    description = capture.description
    if not 0 <= first < last - 3 or last >= capture.frame_count:
        rule = f"at least five frames of 0 to {capture.frame_count - 1} are required, like 12-97"
        raise InputError("--frames", rule, f"{first}-{last}")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(folder, "--output must be a new or empty folder", "other files", "Choose another folder.")
    kept = range(first, last + 1)
    cameras = tuple(replace(c, missing=tuple(k - first for k in c.missing if k in kept)) for c in description.cameras)
    if late := [c.name for c in cameras if 0 in c.missing]:
        raise InputError(
            "--frames", f"camera {late[0]} must have the first frame", f"{first}, which it missed", "Start at a later frame."
        )
    if first and (nodes_file := points.given(capture.folder, NODES)) is not None:
        rule = "nodes belong to frame 0, so the cut must start there"
        raise InputError(nodes_file, rule, f"frame {first}", "Write nodes of that frame, or remove the file.")
    for path in [path for name in ("color", "depth", "mask") for path in (capture.folder / name).glob("*/*")]:
        if path.stem.isdigit() and int(path.stem) in kept:
            target = folder / path.relative_to(capture.folder).with_name(f"{int(path.stem) - first:05d}{path.suffix}")
            make_way(target)
            shutil.copyfile(path, target)
    source = {"cut of": f"sha256:{digest_file(capture.folder / CAPTURE)}", "frames of it": f"{first}-{last}"}
    cut_description = replace(description, name=folder.resolve().name, frame_count=len(kept), cameras=cameras, train_end=None)
    marked = {name: capture.points(name)[kept] for name in capture.cameras} if (capture.folder / POINTS).exists() else None
    tracks = capture.tracks()[kept] if (capture.folder / TRACKS).exists() else None
    writer = Writer(folder, cut_description)
    controllers_file, nodes_file = (points.given(capture.folder, names) for names in (CONTROLLERS, NODES))
    hands = points.read_hands(controllers_file, capture.frame_count) if controllers_file else None
    if hands is not None:
        hands = replace(hands, points=hands.points[kept], holds=hands.holds[kept] if hands.holds.size else hands.holds)
    points.write(folder, hands, points.read_nodes(nodes_file) if nodes_file else np.zeros((0, 3)))
    if (shape := capture.folder / REST).exists():
        shutil.copyfile(shape, folder / REST)
    return writer.finish(tracks, marked, **source)
