"""A capture with exactly known motion: a textured square moves before a wall, at a known depth, seen by two cameras."""

import cv2
import numpy as np

from neuspring.data.capture import Writer
from tests.support.captures import describe, entry

FRAMES, SIZE = 12, (128, 96)
SHIFT = np.array([2.5, -1.25])
"""Pixels per frame."""
CORNER = np.array([30.0, 45.0])
"""Corner of the square in frame 0, px."""
SIDE = 36
NEAR, FAR = 0.6, 0.8
"""Depth of the square and of the wall, m."""
COVERED = (5, 6)
"""Frames in which a plain bar hides the square, for the camera "covered"."""


def texture(size, seed):
    """Smooth noise [size, size] uint8."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(size, size)), (0, 0), 1.6)
    return cv2.normalize(noise, None, 20, 235, cv2.NORM_MINMAX).astype(np.uint8)


def moving(folder, *, missing=(), depth=True, tint=(1.0, 1.0, 1.0)):
    """The capture, cameras "0" and "covered"; "0" lacks the frames `missing`. All is gray, but for the square's tint."""
    cameras = (entry("0", *SIZE, missing=missing), entry("covered", *SIZE))
    writer = Writer(folder, describe(frame_count=FRAMES, cameras=cameras, masks=False))
    wall, square = texture(SIZE[0], 0)[: SIZE[1]], texture(SIDE, 1)
    for frame in range(FRAMES):
        place = np.hstack([np.eye(2), (CORNER + frame * SHIFT)[:, None]])
        moved = cv2.warpAffine(square, place, SIZE)
        own = cv2.warpAffine(np.full_like(square, 255), place, SIZE) > 250
        image = np.where(own[..., None], moved[..., None] * np.array(tint), wall[..., None]).astype(np.uint8)
        distance = np.where(own, 1000 * NEAR, 1000 * FAR).astype(np.uint16)
        for camera in cameras:
            if frame in camera.missing:
                continue
            seen = image.copy()
            if camera.name == "covered" and frame in COVERED:
                seen[:, 20:100] = 128
            writer.frame(camera.name, frame, seen, distance)
            if not depth:
                writer.capture.path("depth", camera.name, frame).unlink()
    return writer.finish()


def truth(point):
    """Places [T, 2] of a point of frame 0 that lies on the square."""
    return np.array(point) + np.arange(FRAMES)[:, None] * SHIFT
