"""Toy scenes as one camera without depth sees them, and painted captures of color alone."""

import functools
from dataclasses import replace

import cv2
import numpy as np

from neuspring.core.artifacts import ImageObservations
from neuspring.data.camera import Camera
from neuspring.data.capture import HANDS, OBJECT, Writer
from tests.support import small
from tests.support.captures import describe

WIDTH, HEIGHT, FOCAL = 160, 120, 180.0
UP = np.array([0.0, 0.0, 1.0])


def camera(target, distance=0.8, elevation=40.0):
    """A camera that looks at a point from `distance`, m, `elevation` degrees above the table, along y."""
    angle = np.deg2rad(elevation)
    forward = np.array([0.0, np.cos(angle), -np.sin(angle)])
    right = np.array([1.0, 0.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = target - distance * forward
    intrinsics = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return Camera("0", WIDTH, HEIGHT, intrinsics, pose)


def silhouettes(labels):
    """60 pixels inside the object per frame, and the distance of cells of 4 x 4 pixels from object and hands."""
    rng = np.random.default_rng(0)
    inside, outside = [], []
    for label in labels:
        y, x = np.nonzero(label == OBJECT)
        inside.append(np.stack([x, y], axis=1)[rng.choice(len(x), 60)])
        away = cv2.distanceTransform((label == 0).astype(np.uint8), cv2.DIST_L2, 5)
        outside.append(away.reshape(HEIGHT // 4, 4, WIDTH // 4, 4).mean(axis=(1, 3)))
    return {"inside": np.array(inside, np.float32), "outside": np.array(outside, np.float32)}


@functools.cache
def observed(path="rope/lift/smooth"):
    """A toy scene without depth: exact tracks and hands, silhouettes of discs around the nodes."""
    scene = small.scene(path)
    seen, truth = scene.observations, scene.motion
    view = camera(seen.nodes.mean(axis=0).astype(float))
    end, frames = seen.scenario.train_end, seen.scenario.frame_count
    pixels, depth = view.project(seen.object_points.astype(float))
    hands, hand_depth = view.project(seen.controller_points.astype(float).mean(axis=1, keepdims=True))
    labels = np.zeros((end, HEIGHT, WIDTH), np.uint8)
    for frame in range(end):
        for x, y in view.project(np.asarray(truth[frame], float))[0]:
            cv2.circle(labels[frame], (round(x), round(y)), 4, OBJECT, -1)
    visible = np.ones(seen.object_visibility.shape, bool)
    visible[end:] = False
    known = np.zeros_like(visible)
    known[0] = True
    image = ImageObservations(
        width=WIDTH,
        height=HEIGHT,
        intrinsics=view.intrinsics,
        camera_to_world=view.camera_to_world,
        pixel_size=float(np.median(depth[0])) / FOCAL,
        pixels=np.where(visible[..., None], pixels, 0.0),
        visible=visible,
        **silhouettes(labels),
        cell=4,
        hand_of=np.zeros(seen.controller_points.shape[1], int),
        hand_centers=hands,
        hand_angles=np.zeros((frames, 1)),
        hand_sizes=hand_depth[:1] / hand_depth,
        marked=np.zeros((frames, 0, 2)),
    )
    points = np.where(known[..., None], seen.object_points, 0.0)
    return replace(seen, object_points=points, object_visibility=known, object_motion_valid=np.zeros_like(known), image=image)


def paint(folder, category="cloth", frames=8, spoiled=False):
    """A capture of color alone: a speckled square on the table, and a speckled hand at its far edge that rises.

    `spoiled`: all that is not hand is another color in future frames, and the object's masks are empty there.
    """
    view = camera(np.zeros(3))
    rng = np.random.default_rng(0)
    speckles = cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8), (0, 0), 1.0)
    cloth = cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8), (0, 0), 1.5)
    own = {"name": "painted", "category": category, "frame_count": frames, "train_end": frames - 3}
    description = describe(**own, cameras=(view.entry(),), depth="none")
    writer = Writer(folder, description)
    corners = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
    for frame in range(frames):
        image, labels = np.full((HEIGHT, WIDTH, 3), 90, np.uint8), np.zeros((HEIGHT, WIDTH), np.uint8)
        cv2.fillPoly(labels, [np.round(view.project(corners)[0]).astype(np.int32)], OBJECT)
        hand = np.zeros_like(labels)
        middle = view.project(np.array([[0.0, 0.1, 0.004 * frame]]))[0][0]
        cv2.rectangle(hand, (round(middle[0]) - 16, round(middle[1]) - 26), (round(middle[0]) + 16, round(middle[1]) + 3), 1, -1)
        shift = np.float32([[1, 0, 0], [0, 1, round(middle[1])]])
        moved = cv2.warpAffine(speckles, shift, (WIDTH, HEIGHT), borderMode=cv2.BORDER_WRAP)
        labels[hand > 0] = HANDS
        image[labels == OBJECT] = cloth[labels == OBJECT]
        if spoiled and frame >= description.train_end:
            image[:] = 255 - image
            labels[labels == OBJECT] = 0
        image[labels == HANDS] = moved[labels == HANDS]
        image[0, 0] = frame  # Images equal to the bit would show nothing new.
        writer.frame("0", frame, image, None, labels)
    return writer.finish()
