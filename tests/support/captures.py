"""Small captures: their cameras and descriptions."""

from dataclasses import replace

import numpy as np

from neuspring.data.camera import CameraEntry
from neuspring.data.capture import Description, Writer

FRAMES = 5
POSE = ((1.0, 0.0, 0.0, 0.1), (0.0, -1.0, 0.0, 0.2), (0.0, 0.0, -1.0, 0.9), (0.0, 0.0, 0.0, 1.0))
K = np.array([[100.0, 0, 59.5], [0, 100.0, 33.5], [0, 0, 1]])
"""Intrinsics of a camera of 120 x 68 pixels."""


def entry(name="0", width=32, height=24, missing=()):
    """A camera at POSE, its principal point in the middle."""
    intrinsics = ((40.0, 0.0, (width - 1) / 2), (0.0, 40.0, (height - 1) / 2), (0.0, 0.0, 1.0))
    return CameraEntry(name=name, width=width, height=height, intrinsics=intrinsics, camera_to_world=POSE, missing=missing)


def describe(**changes):
    """The description of a capture of one camera with masks."""
    plain = Description(
        format=1, name="thing", category="rope", frame_count=FRAMES, frame_rate=30.0, cameras=(entry(),), masks=True
    )
    return replace(plain, **changes)


def write(folder, description=None, tracks=None):
    """A capture of random images: depth of 500 to 900 mm, every label."""
    description = description or describe()
    writer, rng = Writer(folder, description), np.random.default_rng(0)
    for camera in description.cameras:
        for frame in set(range(description.frame_count)) - set(camera.missing):
            size = (camera.height, camera.width)
            depth = rng.integers(500, 900, size).astype(np.uint16)
            writer.frame(camera.name, frame, rng.integers(0, 256, (*size, 3), np.uint8), depth, rng.integers(0, 3, size, np.uint8))
    return writer.finish(tracks)
