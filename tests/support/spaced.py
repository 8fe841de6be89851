"""A small capture of points alone: a block of nodes on the table, a hand of four points that lifts it, annotated points on top."""

import json

import numpy as np

from neuspring.data.capture import CAPTURE, Capture, Writer
from neuspring.intake.points import Hands, write
from tests.support.captures import describe

NODES = np.stack(np.meshgrid(*[np.arange(n) * 0.02 for n in (6, 4, 2)], indexing="ij"), axis=-1).reshape(-1, 3)
MARKED = np.array([[0.01, 0.01, 0.03], [0.09, 0.01, 0.03], [0.05, 0.05, 0.03], [0.09, 0.05, 0.03]])
"""Annotated points of frame 0."""
GRIP = np.array([[0.0, 0.0, 0.03], [0.0, 0.06, 0.03], [0.02, 0.0, 0.04], [0.02, 0.06, 0.04]])


def risen(points, frames):
    """Points [T, n, 3] that rise by 5 mm a frame."""
    return points + np.arange(frames)[:, None, None] * np.array([0.0, 0.0, 0.005])


def spaced(folder, frames=8, *, up=1.0, **changes):
    """The capture, written; `changes` are of its description."""
    kept = {"cameras": (), "depth": "none", "tracks": "train", "masks": False, "frame_count": frames, "train_end": 5}
    described = describe(**(kept | {"name": folder.name, "up": "+z" if up > 0 else "-z"} | changes))
    writer, mirror = Writer(folder, described), np.array([1.0, up, up])
    tracks = risen(MARKED, frames) * mirror
    tracks[2, 1] = np.nan
    tracks[0, 3] = np.nan
    write(folder, Hands(risen(GRIP, frames) * mirror, np.zeros((0, 0), bool), np.array([0, 1, 0, 1])), NODES * mirror)
    return writer.finish(tracks)


def describe_as(capture, **changes):
    """The capture with changed entries of capture.json."""
    path = capture.folder / CAPTURE
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    return Capture.load(capture.folder)
