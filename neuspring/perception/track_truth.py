"""Perfect tracks of a synthetic capture, from its truth: to measure what perception costs, never a method's input otherwise."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from neuspring.config.perception import OpenCvTracking
from neuspring.data.capture import HANDS, OBJECT, Camera, Capture
from neuspring.data.synthetic.correspond import under_pixels
from neuspring.data.synthetic.truth import Truth, truth_of
from neuspring.perception.results import ShapePrior
from neuspring.perception.track_opencv import Followed, choose

SEEN = 0.01
"""m by which the depth image may differ from a point's depth for the point to count as seen."""


def track(capture: Capture, camera: str, labels: np.ndarray, settings: OpenCvTracking, seed: int) -> Followed:
    """Exact places [T, Q, 2] of up to `settings.points` pixels of the masks, and whether depth and mask show them there."""
    truth, of = truth_of(capture), capture.cameras[camera]
    start = choose(labels[0], settings.points, seed)
    x, y = start.astype(int).T
    own = labels[0, y, x]
    material = under_pixels(truth, of, start)
    known = (own == HANDS) | (material.face >= 0)
    start, own, x, y = start[known], own[known], x[known], y[known]
    places = np.where(
        (own == OBJECT)[:, None], material.places[:, known], _with_hands(truth, of, start, capture.depth(camera, 0)[y, x])
    )
    pixels, distance = of.project(places)
    visible = np.zeros(distance.shape, dtype=bool)
    for frame in range(capture.frame_count):
        if capture.has(camera, frame):
            visible[frame] = _seen(of, pixels[frame], distance[frame], capture.depth(camera, frame), labels[frame], own)
    pixels[0], visible[0] = start, True
    return Followed(pixels.astype(np.float32), visible)


def surface(capture: Capture) -> ShapePrior:
    """The visible surface of frame 0."""
    truth = truth_of(capture)
    return ShapePrior(vertices=truth.surface(0), faces=truth.surface_faces, backend="truth")


def _with_hands(truth: Truth, camera: Camera, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """[T, Q, 3], m: where points seen in frame 0 go with the hand that is nearest to them."""
    points = camera.lift(pixels.astype(float), depth)
    poses = truth.hand_poses.astype(float)
    nearest = cKDTree(poses[0, :, :3]).query(points)[1]
    moved = np.zeros((len(poses), *points.shape))
    for hand in range(poses.shape[1]):
        mine = nearest == hand
        local = Rotation.from_quat(poses[0, hand, 3:]).inv().apply(points[mine] - poses[0, hand, :3])
        for frame, pose in enumerate(poses[:, hand]):
            moved[frame, mine] = Rotation.from_quat(pose[3:]).apply(local) + pose[:3]
    return moved


def _seen(
    camera: Camera, pixels: np.ndarray, distance: np.ndarray, depth: np.ndarray, labels: np.ndarray, own: np.ndarray
) -> np.ndarray:
    inside = camera.sees(pixels) & (distance > 0)
    x, y = np.where(inside[:, None], np.round(pixels), 0).astype(int).T
    return np.asarray(inside & (labels[y, x] == own) & (np.abs(depth[y, x] - distance) < SEEN))
