"""Hands of one camera without depth: position, rotation and apparent size of each grasp in the image, and controllers in 3D.

**Image.** Pyramidal Lucas-Kanade with a forward-backward check tracks corners near the grasp. It reads images in which all pixels
outside the hands' mask are gray. RANSAC fits a similarity to the remaining corners between a key frame and the present frame. If
too few corners remain, the present frame becomes the key frame, and errors accumulate. Therefore each frame is also compared with
frame 0: if enough of its corners are found again, their similarity is the pose, and the accumulated error is distributed linearly
over the frames since the last such frame. Sizes and angles are smoothed over time.

**Depth.** The distance of a hand is not observed. A hand is assumed to move in the upright plane that faces the camera, through
its grasp in frame 0, and above a table not below the level of that grasp. With the grasp in the image at u(t), its depth z(t)
along the optical axis is

    z(t) / z(0) = min(p(t), l(t)),   p(t) without a table

p and l are the depths at which the ray through u(t) meets the upright and the level plane, relative to frame 0. The hand is a
rigid patch, which rotates about the ray by its angle in the image and moves with u(t) and z(t).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count

import cv2
import numpy as np
from scipy import ndimage
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from neuspring.core.artifacts import ImageObservations
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.frames import frames_of, gray, spread
from neuspring.extensions.color_alone.pixels import away_from, disc, pixels_of
from neuspring.perception.figures import STRIP_FRAMES

CORNERS, LEAST_CORNERS, CORNERS_KEPT = 120, 6, 0.5
"""Number of corners of a key frame, fewest for a fit, and fraction below which a new key frame starts."""
CORNER_EDGE = 2
"""px: distance of corners from the border of the mask, whose outline must not be tracked."""
CORNERS_AGAIN = 0.4
"""Fraction of the corners of frame 0, and at least 2 LEAST_CORNERS, that must agree to compare a frame with frame 0."""
STEADY = 5
"""Number of compared frames in the median of the accumulated error."""
CORNER_BACKWARD = 0.7
"""Largest forward-backward error of a corner, px."""
CORNER_WINDOW = 15
GRAY = 128
SMOOTH = 9
"""Window of the second-order Savitzky-Golay filter of sizes and angles, frames."""
LARGEST_STEP = 1.15
"""Largest credible change of size between frames, as a factor."""
NEAREST_HAND, FARTHEST_HAND = 0.5, 2.0
"""Range of the depth of a hand relative to frame 0; beyond, the plane is edge-on and undetermined."""


@dataclass(frozen=True)
class HandMotion:
    """Motion of H hands in the image."""

    centers: np.ndarray
    """Grasp [T, H, 2], px."""
    angles: np.ndarray
    """[T, H] rad, from x to y, since frame 0."""
    sizes: np.ndarray
    """[T, H], relative to frame 0."""
    lost: int
    """Number of frames in which a hand was not tracked and its motion was continued."""


def grips(labels: np.ndarray, filled: np.ndarray, reach: float, apart: float, length: float = np.inf) -> list[np.ndarray]:
    """Pixels (x, y) [n, 2] of each hand that grasp the object in frame 0; distances in pixels.

    Pixels of the hands' mask grasp if they are within `reach` of the object; if there are none, the nearest ones do. Groups of
    them at least `apart` from each other are different hands. If an arm enters the image, only pixels within `length` of the
    hand's tip grasp; the tip is the pixel farthest along the arm.
    """
    away = away_from((labels == OBJECT) | filled)
    hands = labels == HANDS
    if not hands.any():
        return []
    near = hands & (away <= max(reach, float(away[hands].min()) + 2.0))
    count, pieces = cv2.connectedComponents(cv2.dilate(near.astype(np.uint8), disc(max(round(apart / 2), 1))))
    grasps = [pixels_of(near & (pieces == piece)) for piece in range(1, count)]
    largest = max(len(pixels) for pixels in grasps)
    # Specks of a mask are not hands.
    grasps = [pixels for pixels in grasps if len(pixels) >= 0.1 * largest]
    if np.isinf(length):
        return grasps
    held, distance = [], along_arms(hands)
    for pixels in grasps:
        along = distance[pixels[:, 1], pixels[:, 0]]
        from_tip = np.linalg.norm(pixels - pixels[int(along.argmax())], axis=1)
        held.append(pixels[from_tip <= length] if along.any() else pixels)
    return held


def along_arms(hands: np.ndarray) -> np.ndarray:
    """Distance [H, W] within the mask [H, W] bool from the pixels at which arms enter the image, px; 0 without an arm.

    Alternating dilations by a square and a cross give it with at most 12 % error.
    """
    distance, reached = np.zeros(hands.shape), hands.copy()
    reached[1:-1, 1:-1] = False
    for step in count(1):
        kernel = cv2.getStructuringElement(cv2.MORPH_RECT if step % 2 else cv2.MORPH_CROSS, (3, 3))
        new = (cv2.dilate(reached.astype(np.uint8), kernel) > 0) & hands & ~reached
        if step % 2 and not new.any():
            break
        distance[new], reached = step, reached | new
    return distance


def follow_hands(capture: Capture, camera: str, labels: np.ndarray, held: list[np.ndarray], radius: float) -> HandMotion:
    """Track the grasps `held` of frame 0 through all frames; labels [T, H, W]. Corners are within `radius` px of a grasp."""
    hands = [_follow(capture, camera, labels, grip.mean(axis=0), radius) for grip in held]
    poses = np.stack([pose for pose, _ in hands], axis=1)
    angles, sizes = np.unwrap(poses[..., 2], axis=0), poses[..., 3]
    if len(poses) > SMOOTH:
        angles = savgol_filter(angles, SMOOTH, 2, axis=0)
        sizes = np.exp(savgol_filter(np.log(sizes), SMOOTH, 2, axis=0))
    angles, sizes = angles - angles[:1], sizes / sizes[:1]
    return HandMotion(poses[..., :2], angles, sizes, sum(lost for _, lost in hands))


def _follow(capture: Capture, camera: str, labels: np.ndarray, center: np.ndarray, radius: float) -> tuple[np.ndarray, int]:
    """Pose (x, y, angle, size) of one hand in all frames [T, 4], and the number of frames in which it was lost."""
    frames, lost = capture.frame_count, 0
    poses = np.zeros((frames, 4))
    poses[0] = [*center, 0.0, 1.0]
    first = before = _hand_image(capture, camera, labels, 0)
    key, corners = poses[0], _corners(before, labels[0], center, radius)
    start = points = corners
    missed, known = np.zeros_like(poses), [0]
    for frame in range(1, frames):
        # A lost hand continues its motion at half speed.
        step = poses[frame - 1] - poses[frame - 2] if frame > 1 else np.zeros(4)
        poses[frame] = poses[frame - 1] + 0.5 * step * [1.0, 1.0, 0.0, 0.0]
        if not capture.has(camera, frame):
            continue
        now = _hand_image(capture, camera, labels, frame)
        if len(points):
            points, ok = _flow(before, now, points)
            start, points = start[ok], points[ok]
        pose = _similarity(key, start, points)
        if pose is not None and 1 / LARGEST_STEP < pose[3] / poses[frame - 1, 3] < LARGEST_STEP:
            poses[frame] = pose
        else:
            lost += 1
            start = points = np.zeros((0, 2), np.float32)
        if len(points) < max(LEAST_CORNERS, CORNERS_KEPT * CORNERS / 2):
            key, start = poses[frame], _corners(now, labels[frame], poses[frame, :2], radius)
            points = start
        before = now
        if not len(corners):
            continue
        x, y, angle, size = poses[frame] + missed[known[-1]]
        offsets = (corners - center) @ np.array([1, 1j]) * size * np.exp(1j * angle)
        again, ok = _flow(first, now, corners, np.stack([x + offsets.real, y + offsets.imag], axis=1))
        pose = _similarity(poses[0], corners[ok], again[ok], max(2 * LEAST_CORNERS, CORNERS_AGAIN * len(corners)))
        if pose is not None:
            missed[frame] = pose - poses[frame]
            known.append(frame)
    # A comparison with few corners may be wrong.
    steady = ndimage.median_filter(missed[known], (STEADY, 1))
    spread = [np.interp(np.arange(frames), known, column) for column in steady.T]
    return poses + np.stack(spread, axis=1), lost


def _hand_image(capture: Capture, camera: str, labels: np.ndarray, frame: int) -> np.ndarray:
    """Gray image [H, W] uint8 that shows only the hands."""
    if not capture.has(camera, frame):
        return np.full(labels.shape[1:], GRAY, np.uint8)
    return np.where(labels[frame] == HANDS, gray(capture, camera, frame), GRAY).astype(np.uint8)


def _corners(image: np.ndarray, labels: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    """Corners (x, y) [n, 2] of hands around a pixel, inside their mask; the radius grows if there are few."""
    inside = cv2.erode((labels == HANDS).astype(np.uint8), np.ones((2 * CORNER_EDGE + 1,) * 2, np.uint8))
    for factor in (1.0, 1.6, 2.5):
        around = np.zeros_like(inside)
        cv2.circle(around, tuple(np.round(center).astype(int).tolist()), int(factor * radius), 1, -1)
        corners = cv2.goodFeaturesToTrack(image, CORNERS, 0.003, 2.0, mask=inside & around, blockSize=3)  # type: ignore[operator]
        if corners is not None and len(corners) >= 3 * LEAST_CORNERS:
            return corners.reshape(-1, 2)
    return np.zeros((0, 2), np.float32) if corners is None else np.asarray(corners.reshape(-1, 2))


def _flow(
    before: np.ndarray, now: np.ndarray, points: np.ndarray, guess: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Present positions of points [n, 2] and whether each is found; `guess` [n, 2]: initial positions, by default `points`."""
    start = np.ascontiguousarray(points, np.float32)
    guess = start.copy() if guess is None else guess.astype(np.float32)
    options = {"winSize": (CORNER_WINDOW, CORNER_WINDOW), "maxLevel": 3, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    moved, there, _ = cv2.calcOpticalFlowPyrLK(before, now, start, guess, **options)  # type: ignore[call-overload]
    back, again, _ = cv2.calcOpticalFlowPyrLK(now, before, moved, moved + start - guess, **options)  # type: ignore[call-overload]
    ok = (there.ravel() > 0) & (again.ravel() > 0) & (np.linalg.norm(back - start, axis=1) < CORNER_BACKWARD)
    return np.asarray(moved), ok


def _similarity(key: np.ndarray, start: np.ndarray, points: np.ndarray, least: float = LEAST_CORNERS) -> np.ndarray | None:
    """Pose [4] of the key frame after the similarity of its corners to `points`; None if fewer than `least` agree."""
    if len(start) < least:
        return None
    # Deterministic: OpenCV's RANSAC uses the same seed in each call.
    matrix, agree = cv2.estimateAffinePartial2D(start, points, method=cv2.RANSAC, ransacReprojThreshold=1.5)
    if matrix is None or agree.sum() < least:
        return None
    angle, size = float(np.arctan2(matrix[1, 0], matrix[0, 0])), float(np.hypot(matrix[0, 0], matrix[1, 0]))
    return np.array([*(matrix[:, :2] @ key[:2] + matrix[:, 2]), key[2] + angle, key[3] * size])


def place(image: ImageObservations, first: np.ndarray, *, ground: bool = True) -> np.ndarray:
    """Controllers [T, C, 3], m, from their positions in frame 0 [C, 3]; `ground`: above a table.

    In camera axes, with the grasp g(t) at depth z(t) on the ray through u(t):

        x(t) = g(t) + R(a(t)) (x(0) - g(0))

    R rotates by the hand's angle a about that ray.
    """
    pose = image.camera_to_world
    local = (first - pose[:3, 3]) @ pose[:3, :3]
    axis = pose[:3, 2] * [1.0, 1.0, 0.0]
    if np.linalg.norm(axis) < 1e-3:
        # For a camera that looks straight down, up in the image replaces the viewing direction.
        axis = -pose[:3, 1] * [1.0, 1.0, 0.0]
    depths = plane_depths(image, axis / np.linalg.norm(axis))
    if ground:
        depths = np.minimum(depths, plane_depths(image, np.array([0.0, 0.0, 1.0])))
    result = np.empty((len(depths), *local.shape))
    directions = rays(image)
    for hand in range(image.hands):
        members = np.flatnonzero(image.hand_of == hand)
        center = directions[0, hand] * local[members, 2].mean()
        grasp = directions[:, hand] * (depths[:, hand] * center[2])[:, None]
        axes = directions[:, hand] / np.linalg.norm(directions[:, hand], axis=1, keepdims=True)
        rotations = Rotation.from_rotvec(axes * image.hand_angles[:, hand, None].astype(np.float64))
        for frame in range(len(depths)):
            result[frame, members] = grasp[frame] + rotations[frame].apply(local[members] - center)
    result[0] = local
    return np.asarray(result @ pose[:3, :3].T + pose[:3, 3])


def plane_depths(image: ImageObservations, normal: np.ndarray) -> np.ndarray:
    """Depths [T, H] relative to frame 0 at which the rays of grasps meet a plane with a normal [3] in the world.

    With rays r(t) and the normal n in camera axes: (n . r(0)) / (n . r(t)).
    """
    along = rays(image) @ (normal @ image.camera_to_world[:3, :3])
    facing = along[0] * along > 0
    ratio = np.divide(np.broadcast_to(along[0], along.shape), along, out=np.full(along.shape, FARTHEST_HAND), where=facing)
    return np.clip(ratio, NEAREST_HAND, FARTHEST_HAND)  # type: ignore[no-any-return]


def rays(image: ImageObservations) -> np.ndarray:
    """Rays K^-1 [x, y, 1] through the grasps [T, H, 3]: points at depth 1 in camera axes."""
    pixels = image.hand_centers.astype(np.float64)
    ones = np.ones((*pixels.shape[:-1], 1))
    return np.concatenate([pixels, ones], axis=-1) @ np.linalg.inv(image.intrinsics).T


def hands_strip(capture: Capture, image: ImageObservations, controllers: np.ndarray) -> np.ndarray:
    """Draw the position, rotation, size and path of each grasp on frames of the video.

    For hands that the capture contains, draw their controllers [T, C, 3], m.
    """
    tiles, camera = [], next(iter(capture.cameras))
    for frame in spread(frames_of(capture, camera), STRIP_FRAMES):
        tile = np.ascontiguousarray(capture.color(camera, frame))
        if not image.hands:
            pixels, depth = capture.cameras[camera].project(controllers[frame].astype(float))
            for pixel in np.round(pixels[depth > 0]).astype(int).tolist():
                cv2.circle(tile, tuple(pixel), 2, (255, 60, 60), -1, cv2.LINE_AA)
        for hand in range(image.hands):
            way = np.round(image.hand_centers[: frame + 1, hand]).astype(np.int32)
            cv2.polylines(tile, [way[:, None]], False, (255, 210, 0), 1, cv2.LINE_AA)
            angle, size = float(image.hand_angles[frame, hand]), 40.0 * float(image.hand_sizes[frame, hand])
            tip = way[-1] + np.round(size * np.array([np.cos(angle), np.sin(angle)])).astype(int)
            cv2.arrowedLine(tile, tuple(way[-1].tolist()), tuple(tip.tolist()), (255, 60, 60), 2, cv2.LINE_AA)
        tiles.append(tile)
    return np.hstack(tiles)
