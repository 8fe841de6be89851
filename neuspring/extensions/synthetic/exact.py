"""Exact tracks and the true surface of a synthetic capture, with which the errors of perception are measured."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from neuspring.config.perception import PointTracking
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.results import ShapePrior
from neuspring.extensions.synthetic.scenes import place
from neuspring.extensions.synthetic.truth import truth_of, under_pixels
from neuspring.perception.track_opencv import Followed, choose

DEPTH_TOLERANCE = 0.01
"""m. Largest difference of the depth image from the depth of a visible point."""


def track(capture: Capture, camera: str, labels: np.ndarray, settings: PointTracking) -> Followed:
    """Exact pixels [T, Q, 2] of up to MOST_TRACKED points in the masks; a point is visible where depth and mask show it."""
    truth, view = truth_of(capture), capture.cameras[camera]
    start = choose(labels[0])
    x, y = start.astype(int).T
    material = under_pixels(truth, view, start)
    traceable = (labels[0, y, x] == HANDS) | (material.face >= 0)
    start, x, y = start[traceable], x[traceable], y[traceable]
    label = labels[0, y, x]
    in_hands = _with_nearest_hand(truth.hand_poses.astype(float), view.lift(start.astype(float), capture.depth(camera, 0)[y, x]))
    pixels, distance = view.project(np.where((label == OBJECT)[:, None], material.places[:, traceable], in_hands))
    visible = view.sees(pixels) & (distance > 0)
    for frame, seen in enumerate(visible):
        if capture.has(camera, frame):
            x, y = np.round(pixels[frame, seen]).astype(int).T
            near = np.abs(capture.depth(camera, frame)[y, x] - distance[frame, seen]) < DEPTH_TOLERANCE
            seen[seen] = near & (labels[frame, y, x] == label[seen])
        else:
            seen[:] = False
    pixels[0], visible[0] = start, True
    return Followed(pixels.astype(np.float32), visible)


def surface(capture: Capture) -> ShapePrior:
    """The visible surface of frame 0."""
    truth = truth_of(capture)
    return ShapePrior(vertices=truth.surface(0), faces=truth.surface_faces, backend="truth")


def carried(points: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Motion [T, n, 3], m, of points [n, 3] of frame 0 on a rigid body with poses [T, 7] (position, quaternion x y z w)."""
    local = Rotation.from_quat(poses[0, 3:]).inv().apply(points - poses[0, :3])
    return place(local, poses)


def _with_nearest_hand(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Motion [T, Q, 3], m, of points [Q, 3] of frame 0 with the nearest hand; the poses of the hands are [T, H, 7]."""
    nearest = cKDTree(poses[0, :, :3]).query(points)[1]
    places = np.zeros((len(poses), *points.shape))
    for hand in range(poses.shape[1]):
        places[:, nearest == hand] = carried(points[nearest == hand], poses[:, hand])
    return places
